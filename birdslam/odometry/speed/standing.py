"""Whether the car stands: corners that have not moved say so where they are known to be the street's.

They may be on the glass: then the near road must be seen to stand (stillness.py), or the speed is held.
"""

from __future__ import annotations

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
_MAX_HELD = 1.5  # times as long as a standstill takes to be told


class StandingDetector:
    """State: that of the near road's stillness. Reader: `Odometry`.

    `displacement_px` (M,) is that of the corners since the reference image; `car` the motion by the car's own speed;
    `min_corners` are needed to tell.
    """

    def __init__(
        self, camera: Camera, config: ZeroVelocityConfig, stillness: StillnessConfig, min_corners: int
    ) -> None:
        self.config, self._min_corners = config, min_corners
        self.near_road = NearRoadStillness(camera, stillness)

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

    def held_too_long(self, dt_s: float) -> bool:
        """Whether a speed was held for longer than a standstill takes to be told: what moves has left the image."""
        return dt_s > _MAX_HELD * self.near_road.config.long_s
