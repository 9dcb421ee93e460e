"""The trajectory of a drive in bounded memory: each pose is relative to its nearest keyframe and moves with it."""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.loops.keyframe import Keyframe
from birdslam.loops.place_map import PlaceMap
from birdslam.outputs.placed import Place
from birdslam.types import Estimate

POSE_EVERY_M = 1.0  # initial spacing of the stored poses
MAX_POSES = 20_000  # at this number every second pose is removed and the spacing is doubled
HELD_M = 30.0  # max. distance of a pose from its keyframe
NONE = -1  # number in place of a keyframe's, for a pose relative to the map


class HeldTrajectory:
    """`add` takes each pose in the map; `places` returns the stored ones, from arrays of fixed size."""

    def __init__(self) -> None:
        self._numbers = np.full((MAX_POSES + 1, 3), NONE, np.int64)  # source time in ns, epoch, keyframe
        self._poses = np.full((MAX_POSES + 1, 6), np.nan)  # T_odom_ego and T_keyframe_ego: x_m, y_m, yaw_rad
        self._length = 0
        self._every_m = POSE_EVERY_M
        self._last: SE2 | None = None  # stored pose, in the map

    def add(self, estimate: Estimate, T_map_ego: SE2, place_map: PlaceMap) -> None:
        """Adds a pose if its distance from the last kept one exceeds the spacing."""
        last = self._last
        if last is not None and math.hypot(T_map_ego.x_m - last.x_m, T_map_ego.y_m - last.y_m) < self._every_m:
            return
        self._last = T_map_ego
        rows = place_map.near(T_map_ego, HELD_M)
        keyframe: Keyframe | None = place_map.keyframes[rows[0]] if rows else None
        T_keyframe_ego = T_map_ego if keyframe is None else keyframe.T_map_keyframe.between(T_map_ego)
        number = NONE if keyframe is None else keyframe.number
        self._numbers[self._length] = estimate.t_source_ns, estimate.epoch, number
        self._poses[self._length] = *_of(estimate.T_world_ego), *_of(T_keyframe_ego)
        self._length += 1
        if self._length > MAX_POSES:
            for kept in (self._numbers, self._poses):
                half = kept[: self._length : 2]
                kept[: len(half)] = half.copy()
            self._length = (self._length + 1) // 2
            self._every_m *= 2.0

    def places(self, place_map: PlaceMap) -> list[Place]:
        """Returns the trajectory for the current poses of the map's keyframes."""
        at = {keyframe.number: keyframe.T_map_keyframe for keyframe in place_map.keyframes} | {NONE: SE2()}
        rows = zip(self._numbers[: self._length].tolist(), self._poses[: self._length].tolist(), strict=True)
        return [
            Place(t_source_ns, epoch, SE2(*poses[:3]), at[number] @ SE2(*poses[3:]))
            for (t_source_ns, epoch, number), poses in rows
        ]


def _of(pose: SE2) -> tuple[float, float, float]:
    return pose.x_m, pose.y_m, pose.yaw_rad
