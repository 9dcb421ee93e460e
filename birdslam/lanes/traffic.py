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
# Log odds that one vehicle adds to whether those beyond a line drive, and their most: kerbs and lanes are side by side
DRIVES_EVIDENCE, DRIVES_MOST = 1.0, 3.0
BEYOND_SIGMAS = 2.0  # so surely beyond a line
MEMORY_LINES = 64


class TrafficState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """For a graph's checkpoint."""

    log_odds: dict[int, float] = {}
    counted: list[tuple[int, int]] = []
    drive_log_odds: dict[int, float] = {}
    judged: list[tuple[int, int]] = []


class Traffic:
    """State: for each line the log odds that traffic beyond it, seen from the ego, comes towards the ego.

    And by how much likelier those beyond it drive than is known of each alone: on a motorway's other carriageway nobody
    stands, and beyond a kerb one that does is followed by others.
    """

    def __init__(self, state: TrafficState = TrafficState()) -> None:  # noqa: B008
        self._against = _Votes(state.log_odds, state.counted, EVIDENCE, MOST)
        self._drive = _Votes(state.drive_log_odds, state.judged, DRIVES_EVIDENCE, DRIVES_MOST)

    def state(self) -> TrafficState:
        """As it stands between two frames."""
        against, drive = self._against, self._drive
        return TrafficState(dict(against.log_odds), list(against.counted), dict(drive.log_odds), list(drive.counted))

    def observe(self, users: Sequence[UserInEgo], between: Sequence[LaneLine | None]) -> None:
        """What the road users of a frame show of the lines between them and the ego (`lines_between`)."""
        for user, line in zip(users, between, strict=True):
            if user.walks or line is None:
                continue
            along, drives = user.cos_along, user.surely_drives
            if along is not None and abs(along) >= -AGAINST:
                self._against.add(line.line, user.vehicle, along < 0.0)
            if drives is not None:
                self._drive.add(line.line, user.vehicle, drives)

    def shows(self, user: UserInEgo, line: LaneLine | None) -> tuple[float, float | None]:
        """The probabilities that a road user drives and that, were it to, it moves against the ego's direction.

        `line` is the one between it and the ego's lane. None: nothing shows a direction.
        """
        if user.walks:
            return user.drives, 0.0
        drives, along = user.drives, user.cos_along
        more = 0.0 if line is None else self._drive.log_odds.get(line.line, 0.0)
        if more:
            drives = drives / (drives + (1.0 - drives) * math.exp(-more))
        if along is not None:
            return drives, 1.0 if along < AGAINST else 0.0
        odds = None if line is None else self._against.log_odds.get(line.line)
        return drives, None if odds is None else 1.0 / (1.0 + math.exp(-odds))

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
            if line is not None and line in self._against.log_odds:
                odds = self._against.log_odds[line]
                return msgspec.structs.replace(lane, oncoming=1.0 / (1.0 + math.exp(-odds)))
        return lane


class _Votes:
    """Log odds of lines by the vehicles beyond them: a vehicle counts once at a line, with `evidence`, up to `most`."""

    def __init__(
        self, log_odds: dict[int, float], counted: Sequence[tuple[int, int]], evidence: float, most: float
    ) -> None:
        self.log_odds = dict(log_odds)
        self.counted = dict.fromkeys(counted)  # (line, vehicle), in the order of counting
        self._evidence, self._most = evidence, most

    def add(self, line: int, vehicle: int, yes: bool) -> None:
        if (line, vehicle) in self.counted:
            return
        self.counted[line, vehicle] = None
        odds = self.log_odds.pop(line, 0.0) + (self._evidence if yes else -self._evidence)
        self.log_odds[line] = min(max(odds, -self._most), self._most)
        while len(self.log_odds) > MEMORY_LINES:
            del self.log_odds[next(iter(self.log_odds))]
        while len(self.counted) > MEMORY_LINES:
            del self.counted[next(iter(self.counted))]


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
