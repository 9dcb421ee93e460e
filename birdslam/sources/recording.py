"""What a recorded drive is: its frames in order, its camera and, where it has one, its truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.ros.bag import BagTopics
from birdslam.ros.sensor import Lens
from birdslam.sources.speed_log import SpeedLog
from birdslam.types import NS_PER_S, Frame, SpeedReading, Status


class DatasetError(ValueError):
    """A recording or camera file that can't be used; the message names the path and what is wrong with it."""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame; `image` (H, W) grey or (H, W, 3) BGR as stored, None where it is unreadable and `error` says why."""

    index: int  # 0, 1, 2, ... of this recording, whatever its stride
    t_source_ns: int  # the recording's own clock
    image: NDArray[np.uint8] | None
    error: str | None = None
    speeds: tuple[SpeedReading, ...] = ()  # as in `Frame`


class OwnLens(NamedTuple):
    """The intrinsics that a recording states; `height_m` is None where it does not say how high the camera stands."""

    source: str  # what in it states them
    lens: Lens
    height_m: float | None


class Recording(ABC):
    """A recorded drive of one camera: its name, its camera, and its frames a second (nominal, after the stride).

    `undistorted_frames` are what `BirdSLAM` takes; `frames` are as they were recorded.
    """

    name: str
    camera: Camera
    rate_hz: float
    speeds: SpeedLog | None = None  # the car's own, of a file beside it: they replace the recording's own

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int] | None:
        """(width, height) in pixels of the recording at `path`, found without a camera; None where it can't be.

        Raises DatasetError.
        """
        return None

    @classmethod
    def own_lens(cls, path: Path, topics: BagTopics) -> OwnLens | None:
        """The intrinsics of a recording that may lack the camera's height; None of any other. Raises DatasetError."""
        return None

    @classmethod
    def stated_focal_px(cls, path: Path) -> float | None:
        """A focal length that the recording's metadata state, roughly; None of most. Raises DatasetError."""
        return None

    @abstractmethod
    def __len__(self) -> int:
        """Frames in the recording, unreadable ones counted."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, from index `start` on; an unreadable one has no image, and the iteration goes on."""

    def frames_with_speeds(self, start: int = 0) -> Iterator[RecordedFrame]:
        """`frames`, each with the speed readings that had arrived by then."""
        for frame in self.frames(start) if start else self.frames():
            yield frame if self.speeds is None else replace(frame, speeds=self.speeds.until(frame.t_source_ns))

    def undistorted_frames(self) -> Iterator[Frame]:
        """Every frame in order, numbered from 0, for a program of one process.

        An unreadable one has no image and says so in its status. `t_capture_ns` is `t_source_ns`, and UTC is
        unknown (0).
        """
        undistort = Undistorter(self.camera)
        for frame_id, recorded in enumerate(self.frames_with_speeds()):
            image, _ = undistorted(undistort, recorded)
            status = (Status.FRAME_UNREADABLE,) if image is None else ()
            yield Frame(frame_id, recorded.t_source_ns, recorded.t_source_ns, 0, image, status, recorded.speeds)

    def truth_poses(self) -> Floats | None:
        """(N, 3, 4) poses of camera 0 as KITTI rows in metres, one a frame; None where there are none."""
        return None

    def T_cam0_cam(self) -> Floats:
        """(4, 4) this camera in the axes of camera 0, whose poses the truth gives: the lever arm between the two."""
        return np.eye(4)


def check_times(recording: Recording, path: Path, first_ns: int, last_ns: int) -> None:
    """Raises DatasetError where a file's times all lie outside the recording's: then they are of another clock."""
    first = next(iter(recording.frames()), None)
    if first is None:
        return
    length_ns = round(len(recording) / recording.rate_hz * NS_PER_S) if len(recording) else last_ns
    begin_ns, end_ns = first.t_source_ns, first.t_source_ns + length_ns
    if last_ns < begin_ns or first_ns > end_ns:
        raise DatasetError(
            f"{path}: its times {first_ns / NS_PER_S:g} to {last_ns / NS_PER_S:g} s lie outside the recording's, "
            f"{begin_ns / NS_PER_S:g} to {end_ns / NS_PER_S:g} s"
        )


def undistorted(undistort: Undistorter, recorded: RecordedFrame) -> tuple[NDArray[np.uint8] | None, str | None]:
    """The image without its lens' distortion; or None, and why there is none."""
    if recorded.image is None:
        return None, recorded.error
    try:
        return undistort(recorded.image), None
    except ValueError as unfit:  # of another size than the camera's
        return None, str(unfit)
