"""Collects the content of the picture of a drive from its estimates, with bounded memory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.outputs.bev_picture import Scene, Track
from birdslam.types import PEOPLE, Estimate, MapUpdate, Moves, RoadUser

MAX_POSES, MAX_TRACK_POSES, MAX_POINTS, MAX_TRACKS = 4000, 100, 20_000, 200  # under 3 MB in all


class Thinned:
    """At most `keep` rows of numbers. When it is full, it drops every second row and doubles its interval.

    The buffer has room for `begin` rows at first (None: for all) and doubles when needed.
    """

    def __init__(self, width: int, keep: int, begin: int | None = None) -> None:
        self._keep = keep
        self._rows = np.full((keep if begin is None else min(begin, keep), width), np.nan)  # allocates the pages now
        self._kept = 0
        self._step = 1
        self._seen = 0

    def add(self, *row: float) -> None:
        """Keeps or skips this row."""
        if self._seen % self._step == 0:
            if self._kept >= self._keep:
                left = self._rows[: self._kept : 2].copy()
                self._rows[: len(left)], self._kept = left, len(left)
                self._step *= 2
            if self._seen % self._step == 0:
                if self._kept == len(self._rows):
                    more = np.full((min(2 * self._kept, self._keep) - self._kept, self._rows.shape[1]), np.nan)
                    self._rows = np.concatenate([self._rows, more])
                self._rows[self._kept] = row
                self._kept += 1
        self._seen += 1

    def array(self) -> Floats:
        """Returns the rows kept, (N, width)."""
        return self._rows[: self._kept].copy()


class _TrackHistory:
    def __init__(self) -> None:
        self.poses = Thinned(3, MAX_TRACK_POSES, begin=16)
        self.speeds = Thinned(1, MAX_TRACK_POSES, begin=16)
        self.farthest_m = 0.0


class SceneRecorder:
    """Joins the worlds of all epochs in one picture: each epoch starts at the last pose of the previous one."""

    def __init__(self) -> None:
        self.T_picture_world = SE2()  # of the newest epoch
        self._last: Estimate | None = None
        self._ego, self._breaks = Thinned(3, MAX_POSES), Thinned(2, MAX_POSES)
        self._lanes, self._landmarks = Thinned(2, MAX_POINTS), Thinned(2, MAX_POINTS)
        self._tracks: dict[int, tuple[_TrackHistory, RoadUser, SE2]] = {}  # history, last estimate, pose in the picture

    def add(self, estimate: Estimate) -> None:
        """Adds the estimate of one frame."""
        if self._last is not None and self._last.epoch != estimate.epoch:
            T_picture_ego = self.T_picture_world @ self._last.T_world_ego
            self.T_picture_world = T_picture_ego @ estimate.T_world_ego.inverse()
            self._breaks.add(T_picture_ego.x_m, T_picture_ego.y_m)
        self._last = estimate
        self._ego.add(*_numbers(self.T_picture_world @ estimate.T_world_ego))
        for user in estimate.road_users:
            if user.age_ns == 0:
                self._add_track(estimate, user)

    def add_map(self, update: MapUpdate) -> None:
        """Adds map points of the newest epoch."""
        for points, kept in ((update.landmarks_m, self._landmarks), (update.lanes_m, self._lanes)):
            for x_m, y_m in self.T_picture_world @ np.array(points).reshape(-1, 2):
                kept.add(float(x_m), float(y_m))

    def _add_track(self, estimate: Estimate, user: RoadUser) -> None:
        history = self._tracks.pop(user.vehicle)[0] if user.vehicle in self._tracks else _TrackHistory()
        placed = self.T_picture_world @ user.T_world_vehicle
        self._tracks[user.vehicle] = history, user, placed  # insertion order: the most recent is last
        if len(self._tracks) > MAX_TRACKS:
            del self._tracks[next(iter(self._tracks))]
        history.poses.add(*_numbers(placed))
        seen_from = estimate.T_world_ego.between(user.T_world_vehicle)
        history.farthest_m = max(history.farthest_m, math.hypot(seen_from.x_m, seen_from.y_m))
        # The depth error gives a stationary vehicle a velocity too
        reported = user.moves is Moves.DRIVING or user.label in PEOPLE
        history.speeds.add(math.hypot(*user.velocity_mps) if reported else 0.0)

    def scene(self, **known: Any) -> Scene:
        """Returns the scene; `known` are its other fields."""
        tracks = [
            Track(
                vehicle=vehicle,
                label=last.label,
                length_m=last.length_m,
                width_m=last.width_m,
                poses=np.vstack([history.poses.array(), _numbers(placed)]),
                frames=last.frames,
                speed_mps=float(np.median(history.speeds.array())),
                farthest_m=history.farthest_m,
            )
            for vehicle, (history, last, placed) in sorted(self._tracks.items())
        ]
        ego = self._ego.array()
        if self._last is not None:
            ego = np.vstack([ego, _numbers(self.T_picture_world @ self._last.T_world_ego)])
        return Scene(
            ego=ego,
            breaks=self._breaks.array(),
            tracks=tracks,
            lanes=self._lanes.array(),
            landmarks=self._landmarks.array(),
            **known,
        )


def _numbers(pose: SE2) -> tuple[float, float, float]:
    return pose.x_m, pose.y_m, pose.yaw_rad
