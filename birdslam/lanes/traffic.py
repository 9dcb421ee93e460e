"""Which way the lanes run, by the traffic that was seen in them, and on which side of the road one drives.

Whoever drives beside the ego's lane tells the direction of the road beyond the line between: all lanes farther out on
that side run alike, or the other way from a later line on. One vehicle counts once at a line. So a car that has just
come into view, whose front is not known from its back yet, is taken for an oncoming one where others came before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from birdslam.lanes.curves import across_sigma_m, basis
from birdslam.lanes.users import UserInEgo
from birdslam.types import Lane, LaneLine, Lanes

AGAINST = -0.3  # cosine of a direction to the ego's, below which traffic comes towards the ego
EVIDENCE = 2.0  # log odds that one vehicle adds: one in eight turns, overtakes or is misjudged
MAX_LOG_ODDS = 6.0  # log odds
# Log odds that one vehicle adds to whether those beyond a line drive, and their most: kerbs and lanes are side by side,
# and the evidence falls with the lateral distance beyond the other lane
DRIVES_EVIDENCE, DRIVES_MAX = 1.0, 3.0
ALIKE_M, MIN_ALIKE = 1.5, 0.3
MIN_SIGMA_MPS, MAX_SIGMAS = 0.1, 30.0
# Vehicles do not park on fast roads: log odds of driving per m/s beyond PARKED_MPS, and their maximum.
# Of KITTI tracking's cars beside the ego's lane, each once, 0.58 stand below 14 m/s (of 317; 0.45 to 0.61 with one
# sequence left out) and 0.34 beyond (of 71; 0.26 to 0.39)
PARKED_MPS, PARKED_EVIDENCE, PARKED_MAX = 13.0, 0.4, 3.0
BEYOND_SIGMAS = 2.0  # so surely beyond a line
MEMORY_LINES = 64
STATED_SIDE = 2.2  # log odds of the side that was stated: a few who come at the other side tell it better
# Who comes is at first taken for one that drives along, a front for a back: of rendered sights that said so 12 % were
# wrong where the speed was 2 to 3 sigma, 3 % at 3 to 6, none beyond. Log odds for each sigma, and those of a witness
ALONG_EVIDENCE, SURE_SIGMAS = 1.0, 4.0
# The share of those who drive that comes towards the ego, beside its lane and beyond all that are known: at its left
# where one drives on the right, and at its right. By the labels of KITTI tracking, each car once, across the ego's way:
# 19 of 30 and 54 of 57, 1 of 14 and 0 of 19
FAR_SIDE, NEAR_SIDE = (0.63, 0.95), (0.07, 0.03)


class TrafficState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """For a graph's checkpoint."""

    log_odds: dict[int, float] = {}
    counted: list[tuple[int, int]] = []
    right_log_odds: float = STATED_SIDE
    sided: list[int] = []
    driving: list[tuple[int, int, float, bool]] = []


@dataclass(frozen=True)
class Between:
    """The line between a road user and the ego's lane, and how far beyond it the user is."""

    line: LaneLine
    beyond_m: float


@dataclass(frozen=True)
class Way:
    """The probabilities that a road user drives and that, were it to, it comes towards the ego.

    The latter by whether it is beside the ego's lane or beyond all that are known, at the ego's left and at its right.
    """

    drives: float
    left: tuple[float, float]
    right: tuple[float, float]


class Traffic:
    """State: for each line the log odds that traffic beyond it, seen from the ego, comes towards the ego.

    And by how much likelier those beyond it drive than is known of each alone: on a motorway's other carriageway nobody
    stands, and beyond a kerb one that does is followed by others. And the log odds that one drives on the right.
    """

    def __init__(self, state: TrafficState = TrafficState()) -> None:  # noqa: B008
        self._against = dict(state.log_odds)
        self._counted = dict.fromkeys(state.counted)  # (line, vehicle), in the order of counting
        self._right = state.right_log_odds
        self._sided = dict.fromkeys(state.sided)
        # (line, vehicle): how far beyond the line it was, and whether it drove
        self._driving = {(line, vehicle): (beyond_m, drives) for line, vehicle, beyond_m, drives in state.driving}

    def state(self) -> TrafficState:
        """As it stands between two frames."""
        driving = [(*key, *vote) for key, vote in self._driving.items()]
        return TrafficState(dict(self._against), list(self._counted), self._right, list(self._sided), driving)

    def observe(self, users: Sequence[UserInEgo], between: Sequence[Between | None]) -> None:
        """What the road users of a frame show of the lines between them and the ego (`lines_between`)."""
        for user, seen in zip(users, between, strict=True):
            if user.walks or seen is None:
                continue
            along, drives, key = user.cos_along, user.surely_drives, (seen.line.line, user.vehicle)
            if along is not None and (along <= AGAINST or (along >= -AGAINST and _sigmas(user) >= SURE_SIGMAS)):
                self._count_way(key, along < 0.0, user.T_ego_vehicle.y_m > 0.0)
            if drives is not None and key not in self._driving:
                self._driving[key] = seen.beyond_m, drives
                _forget(self._driving)

    def _count_way(self, key: tuple[int, int], against: bool, at_left: bool) -> None:
        line, vehicle = key
        if key not in self._counted:
            self._counted[key] = None
            odds = self._against.pop(line, 0.0) + (EVIDENCE if against else -EVIDENCE)
            self._against[line] = min(max(odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)
            _forget(self._counted)
            _forget(self._against)
        # A vehicle to the left of the ego that drives along may be in a lane of the same direction
        if against and vehicle not in self._sided:
            self._sided[vehicle] = None
            evidence = math.log(FAR_SIDE[0] / NEAR_SIDE[0])
            self._right = min(max(self._right + (evidence if at_left else -evidence), -MAX_LOG_ODDS), MAX_LOG_ODDS)
            _forget(self._sided)

    def way(self, user: UserInEgo, seen: Between | None, ego_mps: float) -> Way:
        """What is known of a road user's way; `seen` is the line between it and the ego's lane."""
        if user.walks:
            return Way(user.drives, (0.0, 0.0), (0.0, 0.0))
        drives, along = user.drives, user.cos_along
        more = min(PARKED_EVIDENCE * max(ego_mps - PARKED_MPS, 0.0), PARKED_MAX)
        more += 0.0 if seen is None else self._drive_log_odds(seen)
        if more:
            drives = drives / (drives + (1.0 - drives) * math.exp(-more))
        if along is not None and along < AGAINST:
            return Way(drives, (1.0, 1.0), (1.0, 1.0))
        odds = 0.0 if seen is None else self._against.get(seen.line.line, 0.0)
        if along is not None:
            odds -= ALONG_EVIDENCE * _sigmas(user)
        right = _share(self._right)
        (far, far_beyond), (near, near_beyond) = FAR_SIDE, NEAR_SIDE

        def after(at_right: float, at_left: float) -> float:
            return _with_odds(right * at_right + (1.0 - right) * at_left, odds)

        return Way(
            drives,
            (after(far, near), after(far_beyond, near_beyond)),
            (after(near, far), after(near_beyond, far_beyond)),
        )

    def _drive_log_odds(self, seen: Between) -> float:
        """By those beyond the same line, most by those as far beyond it."""
        total = 0.0
        for (line, _), (beyond_m, drives) in self._driving.items():
            if line == seen.line.line:
                apart = (beyond_m - seen.beyond_m) / ALIKE_M
                alike = MIN_ALIKE + (1.0 - MIN_ALIKE) * math.exp(-0.5 * apart * apart)
                total += alike if drives else -alike
        return DRIVES_EVIDENCE * min(max(total, -DRIVES_MAX), DRIVES_MAX)

    def with_directions(self, lanes: Lanes) -> Lanes:
        """The lanes with the probability that their traffic is oncoming, where something showed it."""
        if lanes.ego_index is None:
            return lanes
        directed = tuple(self._directed(lanes, k) for k in range(len(lanes.lanes)))
        return lanes if directed == lanes.lanes else msgspec.structs.replace(lanes, lanes=directed)

    def _directed(self, lanes: Lanes, k: int) -> Lane:
        """Lane `k` by the lines between it and the ego's: the innermost that is known decides."""
        ego, lane = lanes.ego_index, lanes.lanes[k]
        if ego is None or k == ego:
            return lane if lane.carriageway else msgspec.structs.replace(lane, oncoming=0.0)
        outwards = range(k, ego) if k < ego else range(k, ego, -1)  # from lane k to the ego's
        for index in outwards:
            line = lanes.lanes[index].right if k < ego else lanes.lanes[index].left
            if line is not None and line in self._against:
                odds = self._against[line]
                return msgspec.structs.replace(lane, oncoming=_share(odds))
        return lane


def stated(drives_on: str) -> TrafficState:
    """Before anybody was seen: one drives on the "right" or the "left"."""
    return TrafficState(right_log_odds=STATED_SIDE if drives_on == "right" else -STATED_SIDE)


def _sigmas(user: UserInEgo) -> float:
    """How surely it drives forward."""
    return min(user.speed_mps / max(user.speed_sigma_mps, MIN_SIGMA_MPS), MAX_SIGMAS)


def _share(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _with_odds(share: float, log_odds: float) -> float:
    """A probability, after evidence."""
    return share / (share + (1.0 - share) * math.exp(-log_odds))


def _forget(memory: dict[Any, Any]) -> None:
    """The oldest, where there are too many."""
    while len(memory) > MEMORY_LINES:
        del memory[next(iter(memory))]


def lines_between(lanes: Lanes, users: Sequence[UserInEgo]) -> list[Between | None]:
    """For each road user the nearest line of those that surely lie between it and the ego's lane, or None."""
    if not lanes.lines or not users:
        return [None] * len(users)
    rows = [(user.T_ego_vehicle.x_m, user.T_ego_vehicle.y_m, user.cov[1, 1]) for user in users]
    x_m, y_m, variance = (column[:, None] for column in np.array(rows).T)  # (users, 1)
    shapes = [(n.offset_m, n.slope, n.curvature_per_m, n.curvature_rate_per_m2) for n in lanes.lines]
    curves, covs = np.array(shapes), np.array([line.cov for line in lanes.lines]).reshape(-1, 4, 4)
    at = basis(np.clip(x_m, 0.0, [line.to_m for line in lanes.lines]))  # (users, lines, 4)
    line_m = (at * curves).sum(axis=2)
    margin_m = BEYOND_SIGMAS * np.sqrt(np.maximum(variance, 0.0) + across_sigma_m(at, covs) ** 2)
    beyond = (curves[:, 0] * y_m > 0.0) & ((y_m - line_m) * np.copysign(1.0, y_m) >= margin_m)
    farthest = np.where(beyond, np.abs(line_m), -1.0)
    nearest, found = farthest.argmax(axis=1), beyond.any(axis=1).tolist()
    beyond_m = np.abs(y_m[:, 0] - line_m[np.arange(len(nearest)), nearest]).tolist()
    return [
        Between(lanes.lines[k], past_m) if is_there else None
        for k, past_m, is_there in zip(nearest.tolist(), beyond_m, found, strict=True)
    ]
