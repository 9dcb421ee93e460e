"""The ego's motion by what the car itself says of it, where images show nothing, or nothing that a car does."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.odometry.motion import MotionConfig, car_cov
from birdslam.odometry.speed.scale import CarStep

Floats = NDArray[np.float64]

DRIVES_M = 0.05  # from one image to the next: a car that says less may stand
_SIDEWAYS = 0.25  # of the way forwards: the camera may look 5 degrees aside, and a car drifts by as much
_LONGEST_AHEAD_M = 2.5  # a bus's camera is so much farther before the rear axle than a passenger car's
_SIDESTEP_M = 0.05  # what images of a near scene may be wrong by


def reckoned(
    config: MotionConfig, car: CarStep, last_yaw_rate_radps: float, dt_s: float, camera_ahead_m: float
) -> tuple[SE2, Floats]:
    """T_prev_curr of the camera over `dt_s` and its covariance (3, 3), of a car that rolls on its rear axle.

    Without the car's yaw rate the last turn fades out. The camera is `camera_ahead_m` before the rear axle.
    """
    yaw_rad, yaw_sigma_rad = car.yaw_rad, car.yaw_sigma_rad
    if yaw_rad is None:
        yaw_rad = last_yaw_rate_radps * config.turn_fades_s * (1.0 - math.exp(-dt_s / config.turn_fades_s))
        yaw_sigma_rad = 0.5 * config.coast_yaw_acceleration_radps2 * dt_s**2 + config.coast_yaw_rate_radps * dt_s
    T_prev_curr = SE2.exp(np.array([car.forward_m, camera_ahead_m * yaw_rad, yaw_rad]))
    return T_prev_curr, car_cov(config, T_prev_curr, car.sigma_m, car.sigma_rel, yaw_sigma_rad)


def moves_sideways(T_prev_curr: SE2, camera_ahead_m: float) -> bool:
    """Whether images show a motion to the side that no driving car makes.

    By night they may, of lights and of their own noise; so may dirt on the windscreen.
    """
    forward_m, side_m, yaw_rad = T_prev_curr.log()
    limit_m = _SIDEWAYS * abs(forward_m) + _LONGEST_AHEAD_M * abs(yaw_rad) + _SIDESTEP_M
    return bool(abs(side_m - camera_ahead_m * yaw_rad) > limit_m)
