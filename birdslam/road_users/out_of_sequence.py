"""Out-of-sequence measurements: late detections are processed at their own frame, in order.

Tracks and filters are at the last *settled* frame, whose detections are processed or no longer expected. Later frames
are *open*: their ego pose, time and camera pitch are stored. Detections settle the open frames up to theirs. The road
at the newest frame is predicted over the open frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import GroundPlane, VerticalCurvature
from birdslam.perception import DepthMap, Detections
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, VehicleTrack
from birdslam.road_users.tracking import Tracker


class OutOfSequenceConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the wait for detections."""

    latest_ms: float = 500.0  # source time after which detections are dropped


@dataclass(frozen=True)
class OpenFrame:
    """A frame without its detections: the ego, and the arguments of `GroundSizeFilter.predict`."""

    ego: EgoFrame
    dt_s: float
    turn_rad: float | None
    image_ground: GroundPlane | None
    image_cov: NDArray[np.float64] | None
    travelled_m: float | None = None
    vertical: VerticalCurvature | None = None


class Follower(Protocol):
    """A tracker of other road users with the same detections and road."""

    def settle(self, frame: OpenFrame, detections: Detections | None, road: GroundSizeFilter) -> None:
        """Processes the next frame in order, after its vehicles; `road` is the road at it."""


class OutOfSequenceTracker:
    """Calls per frame: open_frame(), then ingest_detections(); `road` is then the road at the newest frame."""

    def __init__(self, tracker: Tracker, config: OutOfSequenceConfig, followers: Sequence[Follower] = ()) -> None:
        self.tracker = tracker
        self._followers = tuple(followers)
        self.ground_size = tracker.ground_size  # at the last settled frame
        self.road = self.ground_size  # at the newest frame
        self.config = config
        self._open: deque[OpenFrame] = deque()
        self._newest_frame = -1
        self._used_frame = -1  # of the newest detections that were used

    def open_frame(self, frame: OpenFrame) -> None:
        """Adds a frame. If its number does not grow, the source restarted: all open frames are settled."""
        if frame.ego.frame_id <= self._newest_frame:
            self._settle_before(self._newest_frame + 1)
            self._used_frame = -1
        self._newest_frame = frame.ego.frame_id
        self._open.append(frame)
        if self.road is not self.ground_size:
            _predict(self.road, frame)
        while (frame.ego.t_source_ns - self._open[0].ego.t_source_ns) * 1e-6 > self.config.latest_ms:
            self._settle_oldest(None)

    def ingest_detections(
        self,
        detections: Detections | None,
        detected_frame: int,
        depth: DepthMap | None = None,
        road: NDArray[np.bool_] | None = None,
        awaited_from: int = 0,
    ) -> list[VehicleTrack]:
        """Returns the confirmed tracks with detections in `detected_frame`, as of that frame, ordered by id.

        Detections of a frame are used once, and arrive in order. `depth` and the mask `road` (H, W) are of the same
        frame or None. No more detections arrive for frames before `awaited_from`.
        """
        tracks: list[VehicleTrack] = []
        awaited = any(frame.ego.frame_id == detected_frame for frame in self._open)
        if detections is not None and awaited and detected_frame > self._used_frame:
            self._used_frame = detected_frame
            self._settle_before(detected_frame)
            tracks = self._settle_oldest(detections, depth, road)
        else:
            self._settle_before(awaited_from)
        if self._open and self.road is self.ground_size:
            self.road = self.ground_size.without_vehicles()
            for frame in self._open:
                _predict(self.road, frame)
        return tracks

    def _settle_before(self, frame_id: int) -> None:
        while self._open and self._open[0].ego.frame_id < frame_id:
            self._settle_oldest(None)

    def _settle_oldest(
        self,
        detections: Detections | None,
        depth: DepthMap | None = None,
        road: NDArray[np.bool_] | None = None,
    ) -> list[VehicleTrack]:
        """Settles the oldest open frame, with or without detections. `road` must be predicted again afterwards."""
        frame = self._open.popleft()
        self.road = self.ground_size
        _predict(self.ground_size, frame)
        tracks = self.tracker.localise_vehicles(frame.ego, detections, depth, road)
        for follower in self._followers:
            follower.settle(frame, detections, self.ground_size)
        return tracks


def _predict(ground_size: GroundSizeFilter, frame: OpenFrame) -> None:
    of_road = frame.image_ground, frame.image_cov, frame.travelled_m, frame.vertical
    ground_size.predict(frame.dt_s, frame.turn_rad, *of_road)
