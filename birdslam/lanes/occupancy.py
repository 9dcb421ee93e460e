"""Road users in lanes: the probability of each lane from the covariances of road user and lane, and the leader."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.lanes.curves import across_sigma_m, basis, slope_basis
from birdslam.lanes.traffic import Traffic, Way, lines_between
from birdslam.lanes.users import SLOW_MPS, UserInEgo
from birdslam.types import Lane, Lanes, Leader, VehicleLane

MIN_LEADER = 0.5  # probability of the ego's lane
MAX_DISTANCE_M = 120.0
BEND_SIGMA_PER_M = 0.002  # 1-sigma of a lane's curvature beyond where it was seen


def with_users(lanes: Lanes, users: Sequence[UserInEgo], ego_mps: float, traffic: Traffic) -> Lanes:
    """The lanes with who is in them and which way they run; `ego_mps` is the ego's own speed."""
    near = [user for user in users if abs(user.T_ego_vehicle.x_m) < MAX_DISTANCE_M]
    if not lanes.lanes or not near:
        return traffic.with_directions(lanes)
    between = lines_between(lanes, near)
    traffic.observe(near, between)
    shares = _shares(lanes.lanes, near)
    placed = [
        (user, _placed(user, lanes.ego_index, share, traffic.way(user, seen, ego_mps)))
        for user, share, seen in zip(near, shares, between, strict=True)
    ]
    ahead = [
        (user, where)
        for user, where in placed
        if not user.walks and user.T_ego_vehicle.x_m > 0.5 * user.length_m and where.ego_lane > MIN_LEADER
    ]
    leader = min(ahead, key=lambda item: item[0].T_ego_vehicle.x_m, default=None)
    return msgspec.structs.replace(
        traffic.with_directions(lanes),
        vehicles=tuple(where for _, where in placed),
        leader=None if leader is None else _leader(*leader, lanes.ego, ego_mps),
    )


def _placed(user: UserInEgo, index: int | None, shares: list[float], way: Way) -> VehicleLane:
    """`shares`: the probability of each lane, of which `index` is the ego's."""
    total = sum(shares)
    if total > 1.0:  # neighbours' bounds need not meet
        shares = [share / total for share in shares]
    ego = 0.0 if index is None else shares[index]
    left = sum(shares[:index] if index is not None else (), 0.0)
    right = sum(shares[index + 1 :] if index is not None else (), 0.0)
    off = max(0.0, 1.0 - ego - left - right)
    # Who comes towards us drives on a road, also beyond the lanes that are known
    at_left, at_right = way.drives * way.left[0], way.drives * way.right[0]
    beyond = way.drives * (way.left if user.T_ego_vehicle.y_m > 0.0 else way.right)[1]
    oncoming = at_left * left + at_right * right + beyond * off
    left, right, off = (1.0 - at_left) * left, (1.0 - at_right) * right, (1.0 - beyond) * off
    ego, left, right, oncoming, off = (min(share, 1.0) for share in (ego, left, right, oncoming, off))  # of rounding
    return VehicleLane(vehicle=user.vehicle, ego_lane=ego, left=left, right=right, oncoming=oncoming, off_road=off)


def _shares(lanes: Sequence[Lane], users: Sequence[UserInEgo]) -> list[list[float]]:
    """The probability that a user, known to its covariance, lies between a lane's bounds: for each user and lane.

    Where a lane leads aside, an error ahead moves a user across it too; where it leads along the line of sight, none.
    All at once: there are as many pairs as users times lanes in each frame.
    """
    rows = [(u.T_ego_vehicle.x_m, u.T_ego_vehicle.y_m, u.cov[0, 0], u.cov[0, 1], u.cov[1, 1]) for u in users]
    x_m, y_m, xx, xy, yy = (column[:, None] for column in np.array(rows).T)  # (users, 1)
    shapes = [(n.offset_m, n.slope, n.curvature_per_m, n.curvature_rate_per_m2) for n in lanes]
    curves, covs = np.array(shapes), np.array([lane.cov for lane in lanes]).reshape(-1, 4, 4)
    to_m, width_m, growth = np.array([(lane.to_m, lane.width_m, lane.width_slope) for lane in lanes]).T
    at_m = np.clip(x_m, 0.0, MAX_DISTANCE_M)
    known_m, beyond_m = np.minimum(at_m, to_m), np.maximum(at_m - to_m, 0.0)  # (users, lanes)
    at, bend = basis(known_m), 0.5 * BEND_SIGMA_PER_M * beyond_m * beyond_m
    slope = (slope_basis(known_m) * curves).sum(axis=2)
    variance = np.maximum(yy - slope * (2.0 * xy - slope * xx), 0.0)  # of the place across the lane: of y - slope x
    sigma = np.sqrt(variance + across_sigma_m(at, covs) ** 2 + bend * bend + 1e-6)
    centre = (at * curves).sum(axis=2) + slope * beyond_m
    half = 0.5 * np.maximum(width_m + growth * known_m, 0.0)
    left, right = ((centre + half - y_m) / sigma).tolist(), ((centre - half - y_m) / sigma).tolist()
    return [
        [_normal(a) - _normal(b) for a, b in zip(above, below, strict=True)]
        for above, below in zip(left, right, strict=True)
    ]


def _normal(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _leader(v: UserInEgo, where: VehicleLane, lane: Lane | None, ego_mps: float) -> Leader:
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
