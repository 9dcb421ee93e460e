"""Vehicles in lanes: the probability of each lane from the covariances of vehicle and lane, and the leader."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.types import Lane, Lanes, Leader, VehicleLane

Floats = NDArray[np.float64]

LEAST_LEADER = 0.5  # probability of the ego's lane
FARTHEST_M = 120.0
AGAINST = -0.3  # cosine of a vehicle's heading to the lane's, below which it comes towards
SLOW_MPS = 1.0  # below it a vehicle may stand, and a time gap is no number
BEND_SIGMA_PER_M = 0.002  # 1-sigma of a lane's curvature beyond where it was seen


@dataclass(frozen=True)
class VehicleInEgo:
    """A vehicle in ego: its pose, covariance (3, 3), length, speed along its heading, probability that it stands."""

    vehicle: int
    T_ego_vehicle: SE2
    cov: Floats
    length_m: float
    speed_mps: float
    standing: float = 0.0


def with_vehicles(lanes: Lanes, vehicles: Sequence[VehicleInEgo], ego_mps: float) -> Lanes:
    """The lanes with who is in them; `ego_mps` is the ego's own speed."""
    if not lanes.lanes or not vehicles:
        return lanes
    placed = [(v, _placed(v, lanes)) for v in vehicles if abs(v.T_ego_vehicle.x_m) < FARTHEST_M]
    ahead = [
        (v, where) for v, where in placed if v.T_ego_vehicle.x_m > 0.5 * v.length_m and where.ego_lane > LEAST_LEADER
    ]
    leader = min(ahead, key=lambda item: item[0].T_ego_vehicle.x_m, default=None)
    return msgspec.structs.replace(
        lanes,
        vehicles=tuple(where for _, where in placed),
        leader=None if leader is None else _leader(*leader, lanes.ego, ego_mps),
    )


def _placed(v: VehicleInEgo, lanes: Lanes) -> VehicleLane:
    x, y = v.T_ego_vehicle.x_m, v.T_ego_vehicle.y_m
    at_m = min(max(x, 0.0), FARTHEST_M)
    shares = [_share(lane, at_m, y, float(v.cov[1, 1])) for lane in lanes.lanes]
    total = sum(shares)
    if total > 1.0:  # neighbours' bounds need not meet
        shares = [share / total for share in shares]
    index = lanes.ego_index
    ego = 0.0 if index is None else shares[index]
    left = sum(shares[:index] if index is not None else (), 0.0)
    right = sum(shares[index + 1 :] if index is not None else (), 0.0)
    off = max(0.0, 1.0 - ego - left - right)
    oncoming = 0.0
    drives = 1.0 if abs(v.speed_mps) > SLOW_MPS else 1.0 - v.standing
    if math.cos(v.T_ego_vehicle.yaw_rad) * (-1.0 if v.speed_mps < -SLOW_MPS else 1.0) < AGAINST:
        # Who comes towards us drives on a road, also beyond the lanes that are known
        oncoming = drives * (left + right + off)
        left, right, off = ((1.0 - drives) * share for share in (left, right, off))
    ego, left, right, oncoming, off = (min(share, 1.0) for share in (ego, left, right, oncoming, off))  # of rounding
    return VehicleLane(vehicle=v.vehicle, ego_lane=ego, left=left, right=right, oncoming=oncoming, off_road=off)


def _share(lane: Lane, x_m: float, y_m: float, variance: float) -> float:
    """The probability that a point at y, known to `variance`, lies between the lane's bounds at x."""
    beyond_m = max(0.0, x_m - lane.to_m)
    known_m = min(x_m, lane.to_m)
    bend = 0.5 * BEND_SIGMA_PER_M * beyond_m * beyond_m
    sigma = math.sqrt(variance + lane.sigma_m(known_m) ** 2 + bend * bend + 1e-6)
    slope = lane.slope + known_m * (lane.curvature_per_m + 0.5 * known_m * lane.curvature_rate_per_m2)
    centre = lane.centre_m(known_m) + slope * beyond_m
    half = 0.5 * max(0.0, lane.width_m + lane.width_slope * known_m)
    return _normal((centre + half - y_m) / sigma) - _normal((centre - half - y_m) / sigma)


def _normal(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _leader(v: VehicleInEgo, where: VehicleLane, lane: Lane | None, ego_mps: float) -> Leader:
    assert lane is not None
    # Along the lane's centre; the arc over the chord, to second order
    x = v.T_ego_vehicle.x_m
    slope = lane.slope + 0.5 * min(x, lane.to_m) * lane.curvature_per_m
    gap_m = x * math.hypot(1.0, slope) - 0.5 * v.length_m
    return Leader(
        vehicle=v.vehicle,
        gap_m=gap_m,
        gap_sigma_m=math.sqrt(max(0.0, float(v.cov[0, 0]))),
        time_gap_s=max(gap_m, 0.0) / ego_mps if ego_mps > SLOW_MPS else None,
        probability=where.ego_lane,
    )
