"""What the odometry asks of its metric scale (paper, Sec. 3.1, scale-unambiguous ego-motion initialisation).

The scale comes from the known height of the camera over the road. Two strategies stand behind this interface:
`road_scale.RoadScale`, a Kalman filter, and `moving_median.MedianScale`, the paper's moving median.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.vanishing_point import LinesDirection
from birdslam.odometry.speed.scale import CarStep
from birdslam.types import SpeedReading, SpeedSource, Status


@dataclass(frozen=True)
class RoadView:
    """What one image says of the road: its pixels, the camera's pose, and the landmarks, in the odometry's unit."""

    grey: NDArray[np.uint8]  # (H, W)
    pose: Pose  # in the window's axes
    boxes_px: NDArray[np.float64]  # (N, 4) vehicles
    road_mask: NDArray[np.bool_] | None  # (H, W), may be some images old
    window: SlidingWindow  # its newest keyframe is this image
    near_px: float = 0.0  # how far corners on the near road have moved since the last image: in no unit of length
    interval_ns: tuple[int, int] = (0, 0)  # of the motion, by t_source_ns
    sigma_across_m: float = 0.0  # 1-sigma of the pose by the corners: its place across the way
    sigma_rotation_rad: float = 0.0  # ... and its rotation


class MetricScale(Protocol):
    """Turns the odometry's unit of length into metres, image by image."""

    fit: RoadFit | None  # what the newest image's comparison alone said, where it was accepted
    lines: LinesDirection | None  # where the newest image's lines lead, where they were accepted

    @property
    def ground(self) -> GroundPlane:
        """The present camera over the road; the height is the calibrated one, by which all lengths are measured."""

    @property
    def sigma_rel(self) -> float:
        """1-sigma of the scale as a fraction."""

    @property
    def pitch_sigma_rad(self) -> float:
        """1-sigma of the ground's pitch."""

    @property
    def unknown(self) -> bool:
        """Too vague to be driven by."""

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """The window begins anew with this image; its unit of length is known to `sigma_rel`."""

    def length_held(self, sigma_rel: float) -> None:
        """The newest motion is the last speed, held to `sigma_rel`: the unit of length is known no better."""

    def turned_unseen(self) -> None:
        """The odometry lost sight of how the camera turned."""

    def hear(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """The car's own speed, as it had come by the frame of this time."""

    def car_step(self, from_ns: int, to_ns: int) -> CarStep | None:
        """The car's motion by its own readings; None where there are none that can be trusted."""

    @property
    def motion_factor(self) -> float:
        """The factor on the newest motion alone, after that on all lengths: its own error, by the car's speed."""

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, about the present camera, after a motion T_prev_curr of `step`."""

    def status(self) -> list[Status]:
        """What is wrong with the scale."""

    def car_status(self) -> list[Status]:
        """What is wrong with the car's own speed."""

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """What the metres rest on."""
