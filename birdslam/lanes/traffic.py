"""Which way the lanes run, by the traffic that was seen in them.

Whoever drives beside the ego's lane tells the direction of the road beyond the line between: all lanes farther out on
that side run alike, or the other way from a later line on. One vehicle counts once at a line. So a car that has just
come into view, whose front is not known from its back yet, is taken for an oncoming one where others came before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.lanes.curves import across_sigma_m, basis
from birdslam.lanes.users import UserInEgo
from birdslam.types import Lane, LaneLine, Lanes

AGAINST = -0.3  # cosine of a direction to the ego's, below which traffic comes towards the ego
EVIDENCE = 2.0  # log odds that one vehicle adds: one in eight turns, overtakes or is misjudged
MOST = 6.0  # log odds
BEYOND_SIGMAS = 2.0  # so surely beyond a line
MEMORY_LINES = 64


class TrafficState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """For a graph's checkpoint."""

    log_odds: dict[int, float] = {}
    counted: list[tuple[int, int]] = []


class Traffic:
    """State: for each line the log odds that traffic beyond it, seen from the ego, comes towards the ego."""

    def __init__(self, state: TrafficState = TrafficState()) -> None:  # noqa: B008
        self._log_odds = dict(state.log_odds)
        self._counted = dict.fromkeys(state.counted)  # (line, vehicle), in the order of counting

    def state(self) -> TrafficState:
        """As it stands between two frames."""
        return TrafficState(dict(self._log_odds), list(self._counted))

    def observe(self, users: Sequence[UserInEgo], between: Sequence[LaneLine | None]) -> None:
        """What the road users of a frame show of the lines between them and the ego (`lines_between`)."""
        for user, line in zip(users, between, strict=True):
            along = user.cos_along
            if user.walks or along is None or abs(along) < -AGAINST:
                continue
            if line is None or (line.line, user.vehicle) in self._counted:
                continue
            self._counted[line.line, user.vehicle] = None
            odds = self._log_odds.pop(line.line, 0.0) + (EVIDENCE if along < 0.0 else -EVIDENCE)
            self._log_odds[line.line] = min(max(odds, -MOST), MOST)
        while len(self._log_odds) > MEMORY_LINES:
            del self._log_odds[next(iter(self._log_odds))]
        while len(self._counted) > MEMORY_LINES:
            del self._counted[next(iter(self._counted))]

    def against(self, user: UserInEgo, line: LaneLine | None) -> float | None:
        """The probability that a road user moves against the ego's direction, were it to move; None: nothing shows.

        `line` is the one between it and the ego's lane.
        """
        along = user.cos_along
        if along is not None:
            return 1.0 if along < AGAINST else 0.0
        odds = None if line is None else self._log_odds.get(line.line)
        return None if odds is None else 1.0 / (1.0 + math.exp(-odds))

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
            if line is not None and line in self._log_odds:
                odds = self._log_odds[line]
                return msgspec.structs.replace(lane, oncoming=1.0 / (1.0 + math.exp(-odds)))
        return lane


def lines_between(lanes: Lanes, users: Sequence[UserInEgo]) -> list[LaneLine | None]:
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
    nearest, found = farthest.argmax(axis=1).tolist(), beyond.any(axis=1).tolist()
    return [lanes.lines[k] if is_there else None for k, is_there in zip(nearest, found, strict=True)]
