"""How far odometry may be off after a way, by which poses in a map grow uncertain; and what still is a localisation."""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2

LOST_SIGMA_M, LOST_SIGMA_RAD = 0.5, math.radians(1.5)  # a pose less exact than that is none
# Odometry between fixes, 1-sigma: along and across as a share of the way, yaw by the root of it
DRIFT_REL, DRIFT_M, DRIFT_YAW_RAD = 0.02, 0.01, 0.0012
INVALID_REL, INVALID_YAW_RAD_PER_M = 1.0, 0.02  # of a step that odometry itself calls invalid: any length, any bend
ODOMETRY_SCALE_REL = 0.012  # 1-sigma of its metric scale
LOOP_SCALE_REL = 0.01  # by which the scale of odometry differs from one end of a way to the other
LOOP_YAW_RAD = 0.0006


def drift(step: SE2, valid: bool = True) -> Floats:
    """(3, 3) covariance of a step of odometry, of the tangent at its end."""
    way_m = math.hypot(step.x_m, step.y_m)
    sigma_m = DRIFT_REL * way_m + DRIFT_M * math.sqrt(way_m)
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + 0.02 * abs(step.yaw_rad)
    if not valid:
        sigma_m += INVALID_REL * way_m
        yaw_rad += INVALID_YAW_RAD_PER_M * way_m + abs(step.yaw_rad)
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2]) + 1e-10 * np.eye(3)


def drift_after(way_m: float) -> Floats:
    """(3, 3) what odometry may be off after so much way there and back, by which a loop is judged (chi-square)."""
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + LOOP_YAW_RAD
    sigma_m = (DRIFT_REL + DRIFT_M) * math.sqrt(way_m) + (LOOP_SCALE_REL + yaw_rad) * way_m / 4.0
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2])


def moved(cov: Floats, step: SE2, valid: bool = True) -> Floats:
    """A covariance at the beginning of a step, at its end, with the step's own."""
    Ad = step.inverse().adjoint()
    out: Floats = Ad @ cov @ Ad.T + drift(step, valid)
    return out


def is_exact(cov: Floats) -> bool:
    """Whether a pose of this covariance (3, 3) is a localisation."""
    return bool(max(cov[0, 0], cov[1, 1]) < LOST_SIGMA_M**2 and cov[2, 2] < LOST_SIGMA_RAD**2)
