"""Assigns road users to lanes by the covariances of both, and finds the leader."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.lanes.traffic import Crossings, Traffic, TrafficPrior, crossings, lines_between
from birdslam.lanes.users import SLOW_MPS, UserInEgo
from birdslam.types import Lane, Lanes, Leader, VehicleLane

MIN_LEADER_PROBABILITY = 0.5  # min. probability of being in the ego's lane
MAX_DISTANCE_M = 120.0
BEND_SIGMA_PER_M = 0.002  # 1-sigma of a lane's curvature beyond its known range


def with_users(lanes: Lanes, users: Sequence[UserInEgo], ego_mps: float, traffic: Traffic) -> Lanes:
    """Returns the lanes with their road users and directions; `ego_mps` is the ego's speed."""
    near = [user for user in users if abs(user.T_ego_vehicle.x_m) < MAX_DISTANCE_M]
    if not lanes.lanes or not near:
        return traffic.with_directions(lanes)
    at, lines = crossings([*lanes.lines, *lanes.lanes], near), len(lanes.lines)
    between = lines_between(lanes.lines, at.select(slice(lines)))
    traffic.observe(near, between)
    probabilities = _lane_probabilities(lanes.lanes, at.select(slice(lines, None)))
    placed = [
        (user, _place_user(user, lanes.ego_index, shares, traffic.estimate_prior(user, line, ego_mps)))
        for user, shares, line in zip(near, probabilities, between, strict=True)
    ]
    ahead = [
        (user, where)
        for user, where in placed
        if not user.is_pedestrian
        and user.T_ego_vehicle.x_m > 0.5 * user.length_m
        and where.ego_lane > MIN_LEADER_PROBABILITY
    ]
    leader = min(ahead, key=lambda item: item[0].T_ego_vehicle.x_m, default=None)
    return msgspec.structs.replace(
        traffic.with_directions(lanes),
        vehicles=tuple(where for _, where in placed),
        leader=None if leader is None else _leader(*leader, lanes.ego, ego_mps),
    )


def _place_user(user: UserInEgo, index: int | None, shares: list[float], prior: TrafficPrior) -> VehicleLane:
    """`shares`: the probability of each lane; `index` is the ego's lane."""
    total = sum(shares)
    if total > 1.0:  # the bounds of neighbouring lanes may overlap
        shares = [probability / total for probability in shares]
    ego = 0.0 if index is None else shares[index]
    left = sum(shares[:index] if index is not None else (), 0.0)
    right = sum(shares[index + 1 :] if index is not None else (), 0.0)
    off = max(0.0, 1.0 - ego - left - right)
    # An oncoming vehicle is on the road, also beyond the known lanes
    at_left, at_right = prior.moving * prior.left[0], prior.moving * prior.right[0]
    beyond = prior.moving * (prior.left if user.T_ego_vehicle.y_m > 0.0 else prior.right)[1]
    oncoming = at_left * left + at_right * right + beyond * off
    left, right, off = (1.0 - at_left) * left, (1.0 - at_right) * right, (1.0 - beyond) * off
    ego, left, right, oncoming, off = (
        min(probability, 1.0) for probability in (ego, left, right, oncoming, off)
    )  # rounding
    return VehicleLane(vehicle=user.vehicle, ego_lane=ego, left=left, right=right, oncoming=oncoming, off_road=off)


def _lane_probabilities(lanes: Sequence[Lane], at: Crossings) -> list[list[float]]:
    """The probability of each user (outer list) to be between the bounds of each lane (inner list).

    The user's covariance counts across the lane's direction: where the lane bends aside, a longitudinal error moves the
    user across it. Vectorized over all pairs, since this runs in each frame.
    """
    width_m, growth = np.array([(lane.width_m, lane.width_slope) for lane in lanes]).T
    beyond_m = np.maximum(at.x_m - at.known_m, 0.0)  # (users, lanes)
    bend = 0.5 * BEND_SIGMA_PER_M * beyond_m * beyond_m
    slope = at.curves[:, 1] + at.known_m * (at.curves[:, 2] + 0.5 * at.known_m * at.curves[:, 3])
    xx, xy, yy = at.covs[:, 0, 0, None], at.covs[:, 0, 1, None], at.covs[:, 1, 1, None]
    variance = np.maximum(yy - slope * (2.0 * xy - slope * xx), 0.0)  # lateral: of y - slope x
    sigma = np.sqrt(variance + at.variance + bend * bend + 1e-6)
    off_m = at.curve_m + slope * beyond_m - at.y_m
    half = 0.5 * np.maximum(width_m + growth * at.known_m, 0.0)
    left, right = ((off_m + half) / sigma).tolist(), ((off_m - half) / sigma).tolist()
    return [
        [_normal_cdf(a) - _normal_cdf(b) for a, b in zip(above, below, strict=True)]
        for above, below in zip(left, right, strict=True)
    ]


def _normal_cdf(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _leader(v: UserInEgo, where: VehicleLane, lane: Lane | None, ego_mps: float) -> Leader:
    assert lane is not None
    # Along the lane's centre: arc length over the chord, to second order
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
