"""New map points in world that `map_update` has not returned yet: settled landmarks and points of lanes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.types import LanePoint, MapUpdate


class PendingState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of `PendingMap`."""

    frame_id: int
    landmarks: list[tuple[float, float]]
    lanes: list[tuple[SE2, tuple[LanePoint, ...]]]


class PendingMap:
    """The new map points of one epoch. The oldest are dropped beyond `landmarks` points or `frames` frames of lanes.

    `take` transforms lane points to world.
    """

    def __init__(self, landmarks: int, frames: int) -> None:
        self._capacity = landmarks, frames
        self.begin(0)

    def begin(self, epoch: int) -> None:
        """Clears the points for a new epoch."""
        self._epoch, self._frame_id = epoch, 0
        self._landmarks: deque[tuple[float, float]] = deque(maxlen=self._capacity[0])
        self._lanes: deque[tuple[SE2, tuple[LanePoint, ...]]] = deque(maxlen=self._capacity[1])

    def state(self) -> PendingState:
        """The state for `resume`."""
        return PendingState(frame_id=self._frame_id, landmarks=list(self._landmarks), lanes=list(self._lanes))

    def resume(self, state: PendingState, epoch: int) -> None:
        """Restores the state."""
        self.begin(epoch)
        self._frame_id = state.frame_id
        self._landmarks.extend(state.landmarks)
        self._lanes.extend(state.lanes)

    def add(
        self, frame_id: int, landmarks_m: Sequence[tuple[float, float]], T_world_ego: SE2, lanes: tuple[LanePoint, ...]
    ) -> None:
        """Adds `landmarks_m` in world and `lanes` in ego."""
        self._frame_id = frame_id
        self._landmarks.extend(landmarks_m)
        if lanes:
            self._lanes.append((T_world_ego, lanes))

    def take(self) -> MapUpdate | None:
        """Returns and removes all points; None if there are none."""
        if not self._landmarks and not self._lanes:
            return None
        lanes_m = [
            (x, y) for T, points in self._lanes for x, y in (T @ np.array([(p.x_m, p.y_m) for p in points])).tolist()
        ]
        lane_ids = tuple(p.lane for _, points in self._lanes for p in points)
        out = MapUpdate(
            epoch=self._epoch,
            frame_id=self._frame_id,
            landmarks_m=tuple(self._landmarks),
            lanes_m=tuple(lanes_m),
            lane_ids=lane_ids if any(lane >= 0 for lane in lane_ids) else (),
        )
        self._landmarks.clear()
        self._lanes.clear()
        return out
