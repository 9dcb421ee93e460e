"""Out-of-sequence measurements: late detections are used at their own frame, as if they had come in time.

Tracks and filters stand at the last *settled* frame, whose detections are in or no longer awaited. Of the frames after
it, which are open, the ego's pose, the time and the camera's pitching are kept. When detections arrive, the open frames
up to theirs are settled in order; frames that can get none any more are settled at once, so that no later frame bears
their work. The road under the camera in the newest frame is predicted over the open ones.
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
from birdslam.vehicles.state.ground_size_filter import GroundSizeFilter
from birdslam.vehicles.track import EgoFrame, Track
from birdslam.vehicles.tracking import Tracker


class OutOfSequenceConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long a frame waits for its detections."""

    latest_ms: float = 500.0  # source time; what comes later is left out


@dataclass(frozen=True)
class OpenFrame:
    """What is known of a frame without its detections: the ego, and the arguments of `GroundSizeFilter.predict`."""

    ego: EgoFrame
    dt_s: float
    turn_rad: float | None
    image_ground: GroundPlane | None
    image_cov: NDArray[np.float64] | None
    travelled_m: float | None = None
    vertical: VerticalCurvature | None = None


class Beside(Protocol):
    """Who follows others than vehicles by the same detections, over the same road."""

    def settle(self, frame: OpenFrame, detections: Detections | None, road: GroundSizeFilter) -> None:
        """The next frame in order, after the vehicles in it were localised; `road` is the one in it."""


class OutOfSequenceTracker:
    """open_frame(), then ingest_detections(), once a frame; after both `road` is the one under the camera in it."""

    def __init__(self, tracker: Tracker, config: OutOfSequenceConfig, beside: Sequence[Beside] = ()) -> None:
        self.tracker = tracker
        self._beside = tuple(beside)
        self.ground_size = tracker.ground_size  # at the last settled frame
        self.road = self.ground_size  # at the newest frame
        self.config = config
        self._open: deque[OpenFrame] = deque()
        self._newest_frame = -1
        self._used_frame = -1  # of the newest detections that were used

    def open_frame(self, frame: OpenFrame) -> None:
        """A new frame. One whose number does not grow is of a source that restarted: nothing is awaited any more."""
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
    ) -> list[Track]:
        """The confirmed tracks that detections of `detected_frame` are of, as they were in it, ordered by id.

        Each detections are used once. A detector works on one image at a time, so that none come after later ones.
        `depth` and `road`, a mask (H, W), are of the same frame, None where they are not. Of frames before
        `awaited_from` none come after these.
        """
        tracks: list[Track] = []
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
    ) -> list[Track]:
        """The oldest open frame, with its detections or without any; `road` is to be predicted again after it."""
        frame = self._open.popleft()
        self.road = self.ground_size
        _predict(self.ground_size, frame)
        tracks = self.tracker.localise_vehicles(frame.ego, detections, depth, road)
        for follower in self._beside:
            follower.settle(frame, detections, self.ground_size)
        return tracks


def _predict(ground_size: GroundSizeFilter, frame: OpenFrame) -> None:
    of_road = frame.image_ground, frame.image_cov, frame.travelled_m, frame.vertical
    ground_size.predict(frame.dt_s, frame.turn_rad, *of_road)
