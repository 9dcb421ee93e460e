"""Interface of the odometry's metric scale (paper, Sec. 3.1, scale-unambiguous ego-motion initialisation).

The scale follows from the known height of the camera over the road. Implementations: `road.scale.RoadScale`, a Kalman
filter, and `road.moving_median.MovingMedianScale`, the paper's moving median.
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
    """Input of the metric scale for one image, in the scale of the window."""

    grey: NDArray[np.uint8]  # (H, W)
    pose: Pose  # in the window frame
    boxes_px: NDArray[np.float64]  # (N, 4) vehicles
    road_mask: NDArray[np.bool_] | None  # (H, W), may be a few images old
    window: SlidingWindow  # its newest keyframe is this image
    flow_px: float = 0.0  # optical flow of the near road since the reference image (speed/zero_velocity.py)
    interval_ns: tuple[int, int] = (0, 0)  # start and end of the motion, t_source_ns
    sigma_across_m: float = 0.0  # 1-sigma of the lateral position, from the resection
    sigma_rotation_rad: float = 0.0  # 1-sigma of the rotation, from the resection
    has_fixed_corners: bool = False  # corners are fixed to the windscreen


class MetricScale(Protocol):
    """Estimates the factor from the scale of the window to metres, image by image."""

    fit: RoadFit | None  # accepted alignment of the newest image, without its prior
    vanishing_point: VanishingPoint | None  # accepted vanishing point of the newest image

    @property
    def bonnet_px(self) -> NDArray[np.float64] | None:
        """(W, 2) upper edge of the car's own bonnet in the image; None if none is visible."""

    @property
    def ground(self) -> GroundPlane:
        """The current camera over the road; the height is the calibrated one, which defines the scale."""

    @property
    def sigma_rel(self) -> float:
        """Relative 1-sigma of the scale."""

    @property
    def tilt_cov(self) -> NDArray[np.float64]:
        """(2, 2) covariance of the ground's pitch and roll."""

    @property
    def is_unknown(self) -> bool:
        """Whether the scale is too uncertain to drive by."""

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """Restarts with a new window at this image, whose scale has a 1-sigma of `sigma_rel`."""

    def add_predicted_motion(self, sigma_rel: float) -> None:
        """Raises the 1-sigma of the scale to `sigma_rel`, after a motion whose length the velocity prior gave."""

    def reset_tilt(self) -> None:
        """Resets the tilt to the prior of the mount, after a rotation that was not observed."""

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Adds the readings of the car's own speed that arrived by the frame of this time."""

    def car_motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """The car's motion by its own speed; None without trusted readings."""

    @property
    def motion_factor(self) -> float:
        """Factor on the newest motion only, beside that on all lengths; corrects it by the car's own speed."""

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """Returns the factor on all lengths, about the current camera, after the motion T_prev_curr `step`."""

    def status(self) -> list[Status]:
        """Faults of the scale."""

    def car_status(self) -> list[Status]:
        """Faults of the car's own speed."""

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """Sources of the metric scale."""
