"""Direction of traffic in the lanes, learned from the road users seen there, and the side on which one drives.

A moving vehicle beyond a line shows the direction of the lanes beyond that line. Each vehicle counts once per line.
The result is the prior for a new vehicle whose front and back are not yet distinguished.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.lanes.curves import basis
from birdslam.lanes.users import UserInEgo
from birdslam.types import Lane, LaneLine, Lanes

MAX_ONCOMING_COS = -0.3  # max. cosine between an oncoming direction and the ego's
DIRECTION_EVIDENCE = 2.0  # log odds per vehicle: one in eight turns, overtakes or is misjudged
MAX_LOG_ODDS = 6.0
# Log odds per vehicle of whether users beyond a line move, and their maximum. The evidence falls with the lateral
# distance between the two vehicles.
MOVING_EVIDENCE, MAX_MOVING_EVIDENCE = 1.0, 3.0
SIMILAR_DISTANCE_M, MIN_SIMILARITY = 1.5, 0.3
MIN_SIGMA_MPS, MAX_SIGMAS = 0.1, 30.0
# Vehicles do not park on fast roads: log odds of moving per m/s of the ego above MIN_FAST_ROAD_MPS, and their maximum
MIN_FAST_ROAD_MPS, FAST_ROAD_EVIDENCE_PER_MPS, MAX_FAST_ROAD_EVIDENCE = 13.0, 0.4, 3.0
MIN_BEYOND_SIGMAS = 2.0  # min. lateral distance beyond a line
MAX_ENTRIES = 64
STATED_SIDE_EVIDENCE = 2.2  # log odds of the stated side; a few oncoming vehicles on the other side outweigh it
# A new oncoming vehicle may first be taken for one that moves along, front for back: log odds of moving along per sigma
# of speed, and the sigmas from which a vehicle counts as evidence
ALONG_EVIDENCE, MIN_SURE_SIGMAS = 1.0, 4.0
# Share of oncoming vehicles among moving ones, (beside the ego's lane, beyond all known lanes): on the left of the ego
# for right-hand traffic, and on its right. Counted in the labels of KITTI tracking.
FAR_SIDE, NEAR_SIDE = (0.63, 0.95), (0.07, 0.03)


class TrafficState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State for a graph's checkpoint."""

    log_odds: dict[int, float] = {}
    counted: list[tuple[int, int]] = []
    right_log_odds: float = STATED_SIDE_EVIDENCE
    sided: list[int] = []
    driving: list[tuple[int, int, float, bool]] = []


@dataclass(frozen=True)
class Between:
    """The line between a road user and the ego's lane, and the distance of the user beyond it."""

    line: LaneLine
    beyond_m: float


@dataclass(frozen=True)
class TrafficPrior:
    """The probability that a road user moves, and that it is oncoming if it moves.

    `left`, `right`: the latter on that side of the ego, (beside the ego's lane, beyond all known lanes).
    """

    moving: float
    left: tuple[float, float]
    right: tuple[float, float]


class Traffic:
    """State: per line the log odds that traffic beyond it is oncoming, and votes on whether users beyond it move.

    Also the log odds of right-hand traffic.
    """

    def __init__(self, state: TrafficState = TrafficState()) -> None:  # noqa: B008
        self._against = dict(state.log_odds)
        self._counted = dict.fromkeys(state.counted)  # (line, vehicle), in the order of counting
        self._right = state.right_log_odds
        self._sided = dict.fromkeys(state.sided)
        # (line, vehicle): distance beyond the line, whether it moved
        self._driving = {(line, vehicle): (beyond_m, moving) for line, vehicle, beyond_m, moving in state.driving}

    def state(self) -> TrafficState:
        """The state between two frames."""
        driving = [(*key, *vote) for key, vote in self._driving.items()]
        return TrafficState(dict(self._against), list(self._counted), self._right, list(self._sided), driving)

    def observe(self, users: Sequence[UserInEgo], between: Sequence[Between | None]) -> None:
        """Learns from the road users of a frame and the lines between them and the ego (`lines_between`)."""
        for user, seen in zip(users, between, strict=True):
            if user.is_pedestrian or seen is None:
                continue
            along, moving, key = user.cos_along, user.is_moving, (seen.line.line, user.vehicle)
            if along is not None and (
                along <= MAX_ONCOMING_COS or (along >= -MAX_ONCOMING_COS and _speed_sigmas(user) >= MIN_SURE_SIGMAS)
            ):
                self._count_direction(key, along < 0.0, user.T_ego_vehicle.y_m > 0.0)
            if moving is not None and key not in self._driving:
                self._driving[key] = seen.beyond_m, moving
                _drop_oldest(self._driving)

    def _count_direction(self, key: tuple[int, int], against: bool, at_left: bool) -> None:
        line, vehicle = key
        if key not in self._counted:
            self._counted[key] = None
            odds = self._against.pop(line, 0.0) + (DIRECTION_EVIDENCE if against else -DIRECTION_EVIDENCE)
            self._against[line] = min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)
            _drop_oldest(self._counted)
            _drop_oldest(self._against)
        # A vehicle on the left that moves along may be in another lane of the same direction
        if against and vehicle not in self._sided:
            self._sided[vehicle] = None
            evidence = math.log(FAR_SIDE[0] / NEAR_SIDE[0])
            self._right = min(max(self._right + (evidence if at_left else -evidence), -MAX_LOG_ODDS), MAX_LOG_ODDS)
            _drop_oldest(self._sided)

    def estimate_prior(self, user: UserInEgo, seen: Between | None, ego_mps: float) -> TrafficPrior:
        """Estimates motion and direction of a road user; `seen` is the line between it and the ego's lane."""
        if user.is_pedestrian:
            return TrafficPrior(user.moving, (0.0, 0.0), (0.0, 0.0))
        moving, along = user.moving, user.cos_along
        more = min(FAST_ROAD_EVIDENCE_PER_MPS * max(ego_mps - MIN_FAST_ROAD_MPS, 0.0), MAX_FAST_ROAD_EVIDENCE)
        more += 0.0 if seen is None else self._moving_log_odds(seen)
        if more:
            moving = moving / (moving + (1.0 - moving) * math.exp(-more))
        if along is not None and along < MAX_ONCOMING_COS:
            return TrafficPrior(moving, (1.0, 1.0), (1.0, 1.0))
        odds = 0.0 if seen is None else self._against.get(seen.line.line, 0.0)
        if along is not None:
            odds -= ALONG_EVIDENCE * _speed_sigmas(user)
        right = _probability(self._right)
        (far, far_beyond), (near, near_beyond) = FAR_SIDE, NEAR_SIDE
        left_side = near + right * (far - near), near_beyond + right * (far_beyond - near_beyond)
        right_side = far + right * (near - far), far_beyond + right * (near_beyond - far_beyond)
        if odds:
            left_side = _with_odds(left_side[0], odds), _with_odds(left_side[1], odds)
            right_side = _with_odds(right_side[0], odds), _with_odds(right_side[1], odds)
        return TrafficPrior(moving, left_side, right_side)

    def _moving_log_odds(self, seen: Between) -> float:
        """Log odds of moving from other users beyond the same line, weighted by lateral distance."""
        total = 0.0
        for (line, _), (beyond_m, moving) in self._driving.items():
            if line == seen.line.line:
                apart = (beyond_m - seen.beyond_m) / SIMILAR_DISTANCE_M
                similarity = MIN_SIMILARITY + (1.0 - MIN_SIMILARITY) * math.exp(-0.5 * apart * apart)
                total += similarity if moving else -similarity
        return MOVING_EVIDENCE * min(max(total, -MAX_MOVING_EVIDENCE), MAX_MOVING_EVIDENCE)

    def with_directions(self, lanes: Lanes) -> Lanes:
        """Returns the lanes with the probability of oncoming traffic where it was learned."""
        if lanes.ego_index is None:
            return lanes
        directed = tuple(self._directed(lanes, k) for k in range(len(lanes.lanes)))
        return lanes if directed == lanes.lanes else msgspec.structs.replace(lanes, lanes=directed)

    def _directed(self, lanes: Lanes, k: int) -> Lane:
        """Lane `k` with the direction learned at the innermost known line between it and the ego's lane."""
        ego, lane = lanes.ego_index, lanes.lanes[k]
        if ego is None or k == ego:
            return lane if lane.carriageway else msgspec.structs.replace(lane, oncoming=0.0)
        outwards = range(k, ego) if k < ego else range(k, ego, -1)  # from lane k to the ego's
        for index in outwards:
            line = lanes.lanes[index].right if k < ego else lanes.lanes[index].left
            if line is not None and line in self._against:
                odds = self._against[line]
                return msgspec.structs.replace(lane, oncoming=_probability(odds))
        return lane


def initial_state(drives_on: str) -> TrafficState:
    """The initial state for driving on the "right" or the "left"."""
    return TrafficState(right_log_odds=STATED_SIDE_EVIDENCE if drives_on == "right" else -STATED_SIDE_EVIDENCE)


def _speed_sigmas(user: UserInEgo) -> float:
    """Forward speed over its sigma."""
    return min(user.speed_mps / max(user.speed_sigma_mps, MIN_SIGMA_MPS), MAX_SIGMAS)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _with_odds(share: float, log_odds: float) -> float:
    """Updates a probability by log odds."""
    return share / (share + (1.0 - share) * math.exp(-log_odds))


def _drop_oldest(memory: dict[Any, Any]) -> None:
    """Drops the oldest entries above the limit."""
    while len(memory) > MAX_ENTRIES:
        del memory[next(iter(memory))]


@dataclass(frozen=True)
class Crossings:
    """C curves at the x of U road users: lines of the road, or centre lines of lanes."""

    x_m: Floats  # (U, 1) of the users
    y_m: Floats  # (U, 1)
    covs: Floats  # (U, 3, 3) of their poses
    curves: Floats  # (C, 4)
    known_m: Floats  # (U, C) x of each user, limited to the range in which the curve is known
    curve_m: Floats  # (U, C) y of the curve there
    variance: Floats  # (U, C) of it

    def select(self, curves: slice) -> Crossings:
        """Returns these curves alone."""
        known_m, curve_m, variance = (each[:, curves] for each in (self.known_m, self.curve_m, self.variance))
        return Crossings(self.x_m, self.y_m, self.covs, self.curves[curves], known_m, curve_m, variance)


def crossings(curves: Sequence[LaneLine | Lane], users: Sequence[UserInEgo]) -> Crossings:
    """Evaluates the curves at the road users."""
    x_m, y_m = np.array([(user.T_ego_vehicle.x_m, user.T_ego_vehicle.y_m) for user in users]).T[..., None]
    shapes = [(n.offset_m, n.slope, n.curvature_per_m, n.curvature_rate_per_m2, n.to_m, *n.cov) for n in curves]
    numbers = np.array(shapes)
    known_m = np.minimum(np.maximum(x_m, 0.0), numbers[:, 4])
    at = basis(known_m)  # (U, C, 4)
    by_curve = at.transpose(1, 0, 2) @ numbers[:, 5:].reshape(-1, 4, 4)
    variance = (by_curve.transpose(1, 0, 2) * at).sum(axis=2)
    curve_m = (at * numbers[:, :4]).sum(axis=2)
    covs = np.array([user.cov for user in users])
    return Crossings(x_m, y_m, covs, numbers[:, :4], known_m, curve_m, np.maximum(variance, 0.0))


def lines_between(lines: Sequence[LaneLine], at: Crossings) -> list[Between | None]:
    """For each road user the nearest line that surely lies between it and the ego's lane, or None."""
    if not lines:
        return [None] * len(at.x_m)
    margin_m = MIN_BEYOND_SIGMAS * np.sqrt(np.maximum(at.covs[:, 1, 1, None], 0.0) + at.variance)
    side = np.copysign(1.0, at.y_m)
    beyond = (at.curves[:, 0] * at.y_m > 0.0) & ((at.y_m - at.curve_m) * side >= margin_m)
    nearest = np.where(beyond, np.abs(at.curve_m), -1.0).argmax(axis=1)
    beyond_m = np.abs(at.y_m - at.curve_m).tolist()
    return [
        Between(lines[k], past_m[k]) if is_beyond[k] else None
        for k, past_m, is_beyond in zip(nearest.tolist(), beyond_m, beyond.tolist(), strict=True)
    ]
