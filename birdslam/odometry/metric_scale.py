"""The interface of the odometry's metric scale (paper, Sec. 3.1, scale-unambiguous ego-motion initialisation).

The scale comes from the known height of the camera over the road. There are two strategies: `road.scale.RoadScale`, a
Kalman filter, and `road.moving_median.MovingMedianScale`, the paper's moving median.
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
from birdslam.odometry.road.vanishing_point import VanishingPoint
from birdslam.odometry.speed.scale import CarMotion
from birdslam.types import SpeedReading, SpeedSource, Status


@dataclass(frozen=True)
class RoadView:
    """The input of the metric scale from one image, lengths in the odometry's unit."""

    grey: NDArray[np.uint8]  # (H, W)
    pose: Pose  # in the window's axes
    boxes_px: NDArray[np.float64]  # (N, 4) vehicles
    road_mask: NDArray[np.bool_] | None  # (H, W), may be some images old
    window: SlidingWindow  # its newest keyframe is this image
    flow_px: float = 0.0  # optical flow of the near road since the last image (speed/zero_velocity.py)
    interval_ns: tuple[int, int] = (0, 0)  # of the motion, by t_source_ns
    sigma_across_m: float = 0.0  # 1-sigma of the position across the direction of travel, by the corners
    sigma_rotation_rad: float = 0.0  # 1-sigma of the rotation, by the corners
    on_glass: bool = False  # there are corners fixed to the windscreen


class MetricScale(Protocol):
    """Turns the odometry's scale into metres, image by image."""

    fit: RoadFit | None  # of the newest image's alignment without its prior, where it was accepted
    vanishing_point: VanishingPoint | None  # of the newest image, where it was accepted

    @property
    def bonnet_px(self) -> NDArray[np.float64] | None:
        """(W, 2) the upper edge of the car's own bonnet in the image; None: none is seen."""

    @property
    def ground(self) -> GroundPlane:
        """The present camera over the road; the height is the calibrated one, by which all lengths are measured."""

    @property
    def sigma_rel(self) -> float:
        """1-sigma of the scale as a fraction."""

    @property
    def tilt_cov(self) -> NDArray[np.float64]:
        """(2, 2) of the ground's pitch and roll."""

    @property
    def unknown(self) -> bool:
        """Too vague to be driven by."""

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """The window restarts with this image; its scale is known to `sigma_rel`."""

    def speed_predicted(self, sigma_rel: float) -> None:
        """The newest motion's length comes from the velocity prior, so the scale is known to `sigma_rel`."""

    def lose_tilt(self) -> None:
        """The camera turned without being seen: its tilt is known no better than by the mount."""

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Readings of the car's own speed that had come by the frame of this time."""

    def car_motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """The car's motion by its own speed; None where there are no trusted readings."""

    @property
    def motion_factor(self) -> float:
        """The factor on the newest motion alone, beside that on all lengths: its error by the car's own speed."""

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, about the present camera, after the motion T_prev_curr `step`."""

    def status(self) -> list[Status]:
        """What is wrong with the scale."""

    def car_status(self) -> list[Status]:
        """What is wrong with the car's own speed."""

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """Where the metres come from."""
