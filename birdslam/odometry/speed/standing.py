"""Whether the car stands: corners that have not moved say so where they are known to be the street's.

They may be on the glass: then the near road must be seen to stand (stillness.py), or the speed is held.
"""

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

_STILL_OUTER_PX = 1.5  # four of five corners have moved less where the median has not
_MAX_HELD = 1.5  # of the time that the detection of a standstill takes
# A stop is detected if the last speed would have moved the corners by this multiple of the threshold of no motion, or
# after this time whatever the speed was. By judgement
_CLEARLY, _DETECTION_S = 3.0, 0.5
_SPEED_MEMORY_S = 0.2  # of that speed: of one slow motion between two images half is noise


class StandingDetector:
    """State: that of the near road's stillness; how far and when the corners last moved. Reader: `Odometry`.

    `displacement_px` (M,) is that of the corners since the reference image; `car` the motion by the car's own speed;
    `min_corners` are needed to tell.
    """

    def __init__(
        self, camera: Camera, config: ZeroVelocityConfig, stillness: StillnessConfig, min_corners: int
    ) -> None:
        self.config, self._min_corners = config, min_corners
        self.near_road = NearRoadStillness(camera, stillness)
        self._px_per_m = 0.0  # by which the corners moved, when they did; 0: they never did
        self._mps = 0.0  # the speed of the last motions
        self._unmoved_s = 0.0  # since then

    def is_stationary(
        self,
        step: Pose,
        displacement_px: Floats,
        flow_px: float | None,
        speed_mps: float,
        dt_s: float,
        car: CarMotion | None,
    ) -> bool:
        """Whether the corners and the near road show a car that stands; `speed_mps` is the last one measured."""
        if len(displacement_px) < self._min_corners:
            return False
        if car is not None:
            speed_mps = abs(car.forward_m) / dt_s
            if car.is_moving(self.config.length_m) and (flow_px is None or car.agreed):
                return False
        return is_stationary(self.config, step, displacement_px, flow_px, speed_mps, dt_s)

    def seems_still(self, displacement_px: Floats, fixed: int) -> bool:
        """Whether the corners have hardly moved, be they of the street or, so many of them, `fixed` to the glass."""
        if len(displacement_px) < self._min_corners <= fixed:
            return True  # all that is seen stands
        return len(displacement_px) >= self._min_corners and (
            quantile(displacement_px, 0.5) < self.config.still_px and quantile(displacement_px, 0.8) < _STILL_OUTER_PX
        )

    def needs_proof(
        self, stationary: bool, unknown: bool, obstructed: bool, speed_mps: float, dt_s: float, car: CarMotion | None
    ) -> bool:
        """Whether corners that stand are no evidence of a car that stands: they may be on the glass.

        Where the scale is not `unknown`, nothing was found on the glass and brakes could have stopped the car, they are
        the street's, which has moved before; those that are not `stationary` are far away.
        """
        if car is not None and car.agreed and not car.is_moving(self.config.length_m):
            return False
        too_fast = speed_mps > self.config.braking_mps2 * dt_s + self.config.speed_mps
        return unknown or obstructed or (stationary and too_fast)

    def moved(self, displacement_px: Floats, length_m: float, dt_s: float) -> tuple[float, float]:
        """A motion of `length_m` since the image in which the corners last moved.

        Over how long it was (s), and how much of it may be of the images before, in which nothing was seen to move (m).
        """
        over_s, self._unmoved_s = min(self._unmoved_s + dt_s, max(_DETECTION_S, dt_s)), 0.0
        if len(displacement_px) and length_m > 0.0:
            outer_px = quantile(displacement_px, 0.8)
            if outer_px > _CLEARLY * self.config.still_px:
                self._px_per_m = outer_px / length_m
        self._mps += (length_m / over_s - self._mps) * -math.expm1(-over_s / _SPEED_MEMORY_S)
        return over_s, length_m * (1.0 - dt_s / over_s)

    def stood(self, dt_s: float) -> float:
        """One more image in which nothing moved: 1-sigma of the car's motion (m), 0 where it is stationary.

        A car that creeps moves the corners in the image by less than counts as none, and in some more images by more.
        """
        self._unmoved_s += dt_s
        would_move_px = self._px_per_m * self._mps * self._unmoved_s
        if self._px_per_m == 0.0 or self._unmoved_s > _DETECTION_S or would_move_px > _CLEARLY * self.config.still_px:
            return 0.0
        unseen_m = self.config.still_px / self._px_per_m  # at the most, since the corners last moved
        return unseen_m * dt_s / self._unmoved_s / math.sqrt(3.0)

    def held_too_long(self, dt_s: float) -> bool:
        """Whether a speed was held for longer than the detection of a standstill takes."""
        return dt_s > _MAX_HELD * self.near_road.config.long_s
