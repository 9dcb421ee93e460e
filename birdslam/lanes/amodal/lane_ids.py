"""Persistent ids of lanes: a lane is recognised by its position in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.se2 import SE2

Ids = Ints

NO_LANE = -1  # id of a point on no known lane


@dataclass(frozen=True)
class LaneCloud:
    """The cells of one lane boundary: `points_m` (N, 2) in ego, `lane` its id."""

    lane: int
    points_m: Floats


def cell_keys(points_m: Floats, cell_m: float) -> Ids:
    """(N,) keys of the cells that points (N, 2) lie in, in the order of x and then y."""
    out: Ids = np.floor(points_m / cell_m).astype(np.int64) @ np.array([1 << 32, 1])
    return out


class LaneIds:
    """Associates the clouds of each frame with known lanes, by their nearest points in world.

    State: the points of the lanes around the ego, in world, with their ids.
    """

    def __init__(self, same_lane_m: float, cell_m: float, remembered_m: float) -> None:
        """`same_lane_m`: max. distance of a lane from its points; `remembered_m`: radius of stored points."""
        from scipy.spatial import cKDTree  # slow import, needed in one process only

        self._tree = cKDTree
        self._same_lane_m, self._cell_m, self._memory_m = same_lane_m, cell_m, remembered_m
        self._next = 0
        self.clear()

    def clear(self) -> None:
        """Drops all lanes; ids are not reused."""
        self._points = np.zeros((0, 2))  # in world
        self._lanes = np.zeros(0, dtype=np.int64)
        self._kd_tree = self._tree(self._points)

    def lookup(self, points_m: Floats) -> Ids:
        """(N,) the lanes that points (N, 2) in world lie on, NO_LANE where there is none."""
        out: Ids = np.full(len(points_m), NO_LANE)
        if len(self._points) and len(points_m):
            distance, at = self._kd_tree.query(points_m, distance_upper_bound=self._same_lane_m)
            near = np.isfinite(distance)
            out[near] = self._lanes[at[near]]
        return out

    def assign(self, T_world_ego: SE2, clouds: list[Floats]) -> tuple[LaneCloud, ...]:
        """Assigns an id to each cloud (N, 2) in ego; each lane gets at most one cloud."""
        in_world = [T_world_ego @ cloud for cloud in clouds]
        votes: list[tuple[int, int, int]] = []  # (how many points, the cloud, the lane)
        if len(self._points):
            for k, points in enumerate(in_world):
                distance, at = self._kd_tree.query(points, distance_upper_bound=self._same_lane_m)
                seen, counts = np.unique(self._lanes[at[np.isfinite(distance)]], return_counts=True)
                votes += [(int(n), k, int(lane)) for n, lane in zip(counts, seen, strict=True)]
        lane_of: dict[int, int] = {}
        for _, k, lane in sorted(votes, key=lambda vote: (-vote[0], vote[1:])):
            if k not in lane_of and lane not in lane_of.values():
                lane_of[k] = lane
        for k in range(len(clouds)):
            if k not in lane_of:
                lane_of[k], self._next = self._next, self._next + 1
        self._store(T_world_ego, in_world, [lane_of[k] for k in range(len(clouds))])
        return tuple(LaneCloud(lane_of[k], cloud) for k, cloud in enumerate(clouds))

    def _store(self, T_world_ego: SE2, clouds: list[Floats], lanes: list[int]) -> None:
        """Adds the clouds' points; each cell of `cell_m` keeps the newest point."""
        points = np.concatenate([*clouds, self._points]) if clouds else self._points
        ids = np.concatenate([np.repeat(lanes, [len(c) for c in clouds]), self._lanes]) if clouds else self._lanes
        near = np.linalg.norm(points - [T_world_ego.x_m, T_world_ego.y_m], axis=1) < self._memory_m
        points, ids = points[near], ids[near]
        _, first = np.unique(cell_keys(points, self._cell_m), return_index=True)
        self._points, self._lanes = points[first], ids[first].astype(np.int64)
        self._kd_tree = self._tree(self._points)
