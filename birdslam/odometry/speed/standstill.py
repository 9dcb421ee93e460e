"""Standstill detection from unmoved corners, and from the near road (stillness.py) behind a dirty windscreen."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.odometry.median import quantile
from birdslam.odometry.speed.scale import CarMotion
from birdslam.odometry.speed.stillness import NearRoadStillness, StillnessConfig
from birdslam.odometry.speed.zero_velocity import ZeroVelocityConfig, is_stationary

Floats = NDArray[np.float64]

_MAX_OUTER_PX = 1.5  # maximum 80 % quantile of the displacement at a standstill
_MAX_PRIOR_RATIO = 1.5  # of the velocity prior's duration to `StillnessConfig.long_s`
# Standstill if the last speed would have moved the corners by this multiple of still_px, or after this time
_MOTION_RATIO, _DETECTION_S = 3.0, 0.5
_SPEED_MEMORY_S = 0.2  # time constant of the mean speed: a single slow motion is noisy


class StandstillDetector:
    """State: the near road's images; the speed and time of the last motion. Reader: `Odometry`.

    `displacement_px` (M,) is the displacement of the corners since the reference image, `car` the motion by the car's
    own speed, `min_corners` the minimum number of corners for a decision.
    """

    def __init__(
        self, camera: Camera, config: ZeroVelocityConfig, stillness: StillnessConfig, min_corners: int
    ) -> None:
        self.config, self._min_corners = config, min_corners
        self.near_road = NearRoadStillness(camera, stillness)
        self._px_per_m = 0.0  # of the corners at the last motion; 0 before the first
        self._mps = 0.0  # mean speed of the last motions
        self._unmoved_s = 0.0  # time since the last motion

    def is_stationary(
        self,
        step: Pose,
        displacement_px: Floats,
        flow_px: float | None,
        speed_mps: float,
        dt_s: float,
        car: CarMotion | None,
    ) -> bool:
        """Whether corners and near road show a stationary car; `speed_mps` is the last measured speed."""
        if len(displacement_px) < self._min_corners:
            return False
        if car is not None:
            speed_mps = abs(car.forward_m) / dt_s
            if car.is_moving(self.config.length_m) and (flow_px is None or car.has_agreed):
                return False
        return is_stationary(self.config, step, displacement_px, flow_px, speed_mps, dt_s)

    def has_still_corners(self, displacement_px: Floats, fixed: int) -> bool:
        """Whether the corners have hardly moved; `fixed` is the number of corners fixed to the windscreen."""
        if len(displacement_px) < self._min_corners <= fixed:
            return True  # all visible corners are fixed
        return len(displacement_px) >= self._min_corners and (
            quantile(displacement_px, 0.5) < self.config.still_px and quantile(displacement_px, 0.8) < _MAX_OUTER_PX
        )

    def needs_proof(
        self, stationary: bool, unknown: bool, obstructed: bool, speed_mps: float, dt_s: float, car: CarMotion | None
    ) -> bool:
        """Whether unmoved corners are insufficient evidence of a standstill, since they may be on the windscreen.

        They suffice if the scale is not `unknown`, the windscreen is not `obstructed`, and the brakes can have stopped
        the car.
        """
        if car is not None and car.has_agreed and not car.is_moving(self.config.length_m):
            return False
        too_fast = speed_mps > self.config.braking_mps2 * dt_s + self.config.speed_mps
        return unknown or obstructed or (stationary and too_fast)

    def add_motion(self, displacement_px: Floats, length_m: float, dt_s: float) -> tuple[float, float]:
        """Adds a motion of `length_m` since the corners last moved.

        Returns its duration (s), and the part of it (m) that may belong to the unmoved images before.
        """
        over_s, self._unmoved_s = min(self._unmoved_s + dt_s, max(_DETECTION_S, dt_s)), 0.0
        if len(displacement_px) and length_m > 0.0:
            outer_px = quantile(displacement_px, 0.8)
            if outer_px > _MOTION_RATIO * self.config.still_px:
                self._px_per_m = outer_px / length_m
        self._mps += (length_m / over_s - self._mps) * -math.expm1(-over_s / _SPEED_MEMORY_S)
        return over_s, length_m * (1.0 - dt_s / over_s)

    def add_unmoved(self, dt_s: float) -> float:
        """Adds an image without motion. Returns 1-sigma of the car's motion (m), 0 if it is stationary.

        A creeping car moves the corners by less than still_px per image.
        """
        self._unmoved_s += dt_s
        would_move_px = self._px_per_m * self._mps * self._unmoved_s
        if (
            self._px_per_m == 0.0
            or self._unmoved_s > _DETECTION_S
            or would_move_px > _MOTION_RATIO * self.config.still_px
        ):
            return 0.0
        unseen_m = self.config.still_px / self._px_per_m  # maximum since the corners last moved
        return unseen_m * dt_s / self._unmoved_s / math.sqrt(3.0)

    def is_prior_expired(self, dt_s: float) -> bool:
        """Whether the velocity prior was used for longer than the standstill detection takes."""
        return dt_s > _MAX_PRIOR_RATIO * self.near_road.config.long_s
