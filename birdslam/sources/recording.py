"""Interface of a recorded drive: frames in order, camera, and optional ground truth."""

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
    """A recording or camera file that cannot be used; the message names the path and the problem."""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame; `image` (H, W) grey or (H, W, 3) BGR as stored, None if unreadable, with the reason in `error`."""

    index: int  # 0, 1, 2, ... of this recording, for any stride
    t_source_ns: int  # the recording's own clock
    image: NDArray[np.uint8] | None
    error: str | None = None
    speeds: tuple[SpeedReading, ...] = ()  # as in `Frame`
    note: str | None = None  # for the log


class OwnLens(NamedTuple):
    """Intrinsics stated by a recording; `height_m` is None if it does not state the camera's height."""

    source: str  # what states them
    lens: Lens
    height_m: float | None


class Recording(ABC):
    """A recorded drive of one camera: name, camera, and nominal frame rate after the stride.

    `undistorted_frames` are the input of `BirdSLAM`; `frames` are as recorded. Each kind of recording keeps a contract
    (tests/test_source_contract.py): frames are numbered from 0, their times increase on one clock, images have square
    pixels and the size of `camera`, an unreadable frame has a reason, and a restart or a stride keeps numbers, times
    and images.
    """

    name: str
    camera: Camera
    rate_hz: float
    speeds: SpeedLog | None = None  # vehicle speeds from a file; they replace the recording's own

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int] | None:
        """(width, height) in pixels of the recording at `path` without a camera; None if unknown.

        Raises DatasetError.
        """
        return None

    @classmethod
    def own_lens(cls, path: Path, topics: BagTopics) -> OwnLens | None:
        """Intrinsics of a recording that may lack the camera's height; None for other kinds. Raises DatasetError."""
        return None

    @classmethod
    def stated_focal_px(cls, path: Path) -> float | None:
        """Approximate focal length from the recording's metadata; usually None. Raises DatasetError."""
        return None

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames, unreadable ones included."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Yields the frames in order from index `start`; an unreadable one has no image."""

    def frames_with_speeds(self, start: int = 0) -> Iterator[RecordedFrame]:
        """`frames`, each with the speed readings that arrived by then."""
        for frame in self.frames(start) if start else self.frames():
            yield frame if self.speeds is None else replace(frame, speeds=self.speeds.until(frame.t_source_ns))

    def undistorted_frames(self) -> Iterator[Frame]:
        """Yields all frames in order, numbered from 0, for a program of one process.

        An unreadable one has no image and a status. `t_capture_ns` is `t_source_ns`; UTC is unknown (0).
        """
        undistort = Undistorter(self.camera)
        for frame_id, recorded in enumerate(self.frames_with_speeds()):
            image, _ = undistorted(undistort, recorded)
            status = (Status.FRAME_UNREADABLE,) if image is None else ()
            yield Frame(frame_id, recorded.t_source_ns, recorded.t_source_ns, 0, image, status, recorded.speeds)

    def truth_poses(self) -> Floats | None:
        """(N, 3, 4) poses of camera 0 as KITTI rows in metres, one per frame; None without truth."""
        return None

    def T_cam0_cam(self) -> Floats:
        """(4, 4) pose of this camera in camera 0, whose poses the truth gives (lever arm)."""
        return np.eye(4)


def check_times(recording: Recording, path: Path, first_ns: int, last_ns: int) -> None:
    """Raises DatasetError if all times of a file are outside the recording's, that is, of another clock."""
    first = next(iter(recording.frames()), None)
    if first is None:
        return
    length_ns = round(len(recording) / recording.rate_hz * NS_PER_S) if len(recording) else last_ns
    begin_ns, end_ns = first.t_source_ns, first.t_source_ns + length_ns
    if last_ns < begin_ns or first_ns > end_ns:
        raise DatasetError(
            f"{path}: its times {first_ns / NS_PER_S:g} to {last_ns / NS_PER_S:g} s are outside the recording's, "
            f"{begin_ns / NS_PER_S:g} to {end_ns / NS_PER_S:g} s"
        )


def undistorted(undistort: Undistorter, recorded: RecordedFrame) -> tuple[NDArray[np.uint8] | None, str | None]:
    """The undistorted image, or None and the reason."""
    if recorded.image is None:
        return None, recorded.error
    try:
        return undistort(recorded.image), None
    except ValueError as unfit:  # size differs from the camera's
        return None, str(unfit)
