"""What a recorded drive is: its frames in order, its camera and, where it has one, its truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera


class DatasetError(ValueError):
    """A recording or camera file that can't be used; the message names the path and what is wrong with it."""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame; `image` (H, W) grey or (H, W, 3) BGR as stored, None where it is unreadable and `error` says why."""

    index: int  # 0, 1, 2, ... of this recording, whatever its stride
    t_source_ns: int  # the recording's own clock
    image: NDArray[np.uint8] | None
    error: str | None = None


class Recording(ABC):
    """A recorded drive of one camera. `rate_hz` is nominal, after the stride; frames are not yet undistorted."""

    name: str
    camera: Camera
    rate_hz: float

    @abstractmethod
    def __len__(self) -> int:
        """Frames in the recording, unreadable ones counted."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, from index `start` on; an unreadable one has no image, and the iteration goes on."""

    def truth_poses(self) -> NDArray[np.float64] | None:
        """(N, 3, 4) poses of camera 0 as KITTI rows in metres, one a frame; None where there are none."""
        return None

    def T_cam0_cam(self) -> NDArray[np.float64]:
        """(4, 4) this camera in the axes of camera 0, whose poses the truth gives: the lever arm between the two."""
        return np.eye(4)
