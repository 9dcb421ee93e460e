"""The paper's metric scale: a moving median over the scales of frames (Sec. 3.1).

The road is the calibrated plane (flat-earth assumption). A landmark on it has a depth in the scale of the window and,
by Eq. 1, in metres; the median ratio is the frame's scale. The paper states no width of the median; the default is 21
frames, 2 s at 10 Hz.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.metric_scale import RoadView
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.points import on_road
from birdslam.odometry.road.vanishing_point import VanishingPoint
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.types import SpeedReading, SpeedSource, Status

Floats = NDArray[np.float64]

_SIGMA_OF_MEDIAN = 1.4826 * 1.2533  # times the median absolute deviation over the root of the number, for normal noise


class MovingMedianScale:
    """A `metric_scale.MetricScale`.

    State: the last `median_frames` scales (metres per initial scale of the window), and the last median.
    Measurements: one scale per frame, from the window's landmarks on the road. Reader: `Odometry`.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.camera, self.config = camera, config
        self.fit: RoadFit | None = None  # always None: images are not aligned
        self.vanishing_point: VanishingPoint | None = None  # always None: not measured
        self._scales: deque[float] = deque(maxlen=config.median_frames)
        self._last_scale = 1.0
        self._carried_m = 0.0  # travelled since the last scale of a frame

    @property
    def bonnet_px(self) -> None:
        """None: bonnets are not detected."""

    @property
    def ground(self) -> GroundPlane:
        """The calibrated ground plane."""
        return self.camera.ground

    @property
    def tilt_cov(self) -> NDArray[np.float64]:
        """Prior of the body's pitch and roll; they are not measured."""
        return np.eye(2) * (self.config.sigma_mount_rad**2 + self.config.sigma_bounce_rad**2)

    @property
    def sigma_rel(self) -> float:
        """Relative 1-sigma of the moving median, from the spread of its scales; 1 before there are enough."""
        if len(self._scales) < self.config.confirmations:
            return 1.0
        log_scales = np.log(self._scales)
        deviation = float(np.median(np.abs(log_scales - np.median(log_scales))))
        sigma = _SIGMA_OF_MEDIAN * deviation / np.sqrt(len(log_scales))
        return float(np.clip(sigma, self.config.sigma_scale_floor_rel, 1.0))

    @property
    def is_unknown(self) -> bool:
        """Whether the scale is too uncertain to drive by."""
        return self.sigma_rel > self.config.invalid_sigma_rel

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """Drops the scales of the old window."""
        self._scales.clear()
        self._last_scale = 1.0

    def add_predicted_motion(self, sigma_rel: float) -> None:
        """Does nothing: the spread of the median is its uncertainty."""

    def reset_tilt(self) -> None:
        """Does nothing: the tilt is not estimated."""

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Does nothing: the paper uses the road alone."""

    def car_motion(self, from_ns: int, to_ns: int) -> None:
        """None: the paper uses the road alone."""

    def car_status(self) -> list[Status]:
        """Empty: the paper uses the road alone."""
        return []

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """The road, or a carried scale."""
        return (SpeedSource.CARRIED if Status.SCALE_CARRIED in self.status() else SpeedSource.ROAD,)

    @property
    def motion_factor(self) -> float:
        """1: the car's own speed is not used."""
        return 1.0

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """Change of the moving median; 1 before the first scale."""
        self._carried_m += float(np.linalg.norm(step.p))
        scale = self.frame_scale(view)
        if scale is not None:
            self._scales.append(scale * self._last_scale)
            self._carried_m = 0.0
        if not self._scales:
            return 1.0
        last, self._last_scale = self._last_scale, float(np.median(self._scales))
        return self._last_scale / last

    def frame_scale(self, view: RoadView) -> float | None:
        """Metres per current scale, from the landmarks of this image on the road; None if there are too few."""
        config, window = self.config, view.window
        seen = np.isfinite(window.obs[-1, :, 0]) & (window.rho_sigma < config.median_sigma_depth_rel * window.rho)
        px = self.camera.to_px(window.obs[-1, seen])
        depth_m = bev.road_point_cam(self.camera, self.ground, px)[:, 2]  # Eq. 1
        ratio = depth_m / window.depths(view.pose)[seen]
        used = on_road(px, self.camera, self.ground, view.boxes_px, view.road_mask, config.align.half_width_m)
        used &= (ratio > 0.0) & (depth_m < config.median_range_m)
        return float(np.median(ratio[used])) if used.sum() >= config.median_landmarks else None

    def status(self) -> list[Status]:
        """Whether the scale is carried or invalid."""
        out = []
        if self._carried_m > self.config.carried_after_m or len(self._scales) < self.config.confirmations:
            out.append(Status.SCALE_CARRIED)
        if self.is_unknown:
            out.append(Status.SCALE_INVALID)
        return out
