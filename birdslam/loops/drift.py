"""The error model of odometry: growth of the covariance of a pose in the map, and the limit of a localisation.

Odometry reports the sigma of its scale (`scale_sigma_rel`). A change of velocity beyond the tyres' limit is an error.
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import NS_PER_S, Estimate

LOST_SIGMA_M, LOST_SIGMA_RAD = 0.5, math.radians(1.5)  # max. sigmas of a localisation
# 1-sigma of odometry between fixes: position as a fraction of the distance, position and yaw by its square root
DRIFT_REL, DRIFT_M, DRIFT_YAW_RAD = 0.02, 0.01, 0.0012
INVALID_REL, INVALID_YAW_RAD_PER_M = 1.0, 0.02  # of an invalid step
MIN_SCALE_REL = 0.012  # min. 1-sigma of the scale
MAX_MPS2 = 10.0  # max. acceleration, by the tyres
# Correlation lengths of the scale error: of its varying part, as in the window's graph, and of its persistent part
CORRELATION_M, KEPT_M = 20.0, 1000.0
ACROSS_M, ALONG_M = 0.03, 0.01  # of a link, by the square root of its length
LOOP_SCALE_REL = 0.01  # change of the scale between the ends of a loop
LOOP_YAW_RAD = 0.0006


class Steps:
    """The errors of odometry's steps in one epoch."""

    def __init__(self) -> None:
        self._last: Estimate | None = None
        self._velocity_mps: tuple[float, float] | None = None  # of the last step, in its ego
        self.sum_m2 = 0.0  # variance of all errors found by `add`, and of the invalid steps

    def add(self, estimate: Estimate) -> float:
        """Returns the certain error of the step that ends here, in m."""
        last, self._last = self._last, estimate
        before, self._velocity_mps = self._velocity_mps, None
        if last is None:
            return 0.0
        if not estimate.valid:
            self.sum_m2 += (INVALID_REL * math.hypot(*last.T_world_ego.between(estimate.T_world_ego).log()[:2])) ** 2
            return 0.0
        dt_s = (estimate.t_source_ns - last.t_source_ns) / NS_PER_S
        if dt_s <= 0.0:
            return 0.0
        step = last.T_world_ego.between(estimate.T_world_ego)
        x_mps, y_mps = self._velocity_mps = step.x_m / dt_s, step.y_m / dt_s
        if before is None:
            return 0.0
        changed_mps = math.hypot(x_mps - before[0], y_mps - before[1])
        error_m = max(changed_mps - MAX_MPS2 * dt_s, 0.0) * dt_s
        self.sum_m2 += error_m**2
        return error_m


def drift(step: SE2, valid: bool = True, scale_rel: float = 0.0, error_m: float = 0.0) -> Floats:
    """Returns the covariance (3, 3) of an odometry step, of the tangent at its end.

    `scale_rel`: odometry's sigma of its scale; `error_m`: its known error (`Steps`).
    """
    way_m = math.hypot(step.x_m, step.y_m)
    sigma_m = max(DRIFT_REL, scale_rel) * way_m + DRIFT_M * math.sqrt(way_m) + error_m
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + 0.02 * abs(step.yaw_rad)
    if not valid:
        sigma_m += INVALID_REL * way_m
        yaw_rad += INVALID_YAW_RAD_PER_M * way_m + abs(step.yaw_rad)
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2]) + 1e-10 * np.eye(3)


def link_cov(step: SE2, scale_rel: float, unsure_m2: float = 0.0) -> Floats:
    """Returns the covariance (3, 3) of odometry between two keyframes, without the persistent scale error.

    `unsure_m2`: variance of its known errors (`Steps`).
    """
    way_m = math.hypot(step.x_m, step.y_m)
    scale_rel = max(scale_rel, MIN_SCALE_REL)
    along_m2 = (ALONG_M**2 + 2.0 * CORRELATION_M * scale_rel**2) * way_m  # as of independent steps
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + 0.02 * abs(step.yaw_rad)
    yaw_rad2 = yaw_rad**2 + INVALID_YAW_RAD_PER_M**2 * unsure_m2
    return np.diag([along_m2 + unsure_m2, ACROSS_M**2 * way_m + unsure_m2, yaw_rad2]) + 1e-10 * np.eye(3)


def own_scale_rel(scale_rel: float, camera_rel: float) -> float:
    """Returns odometry's scale sigma without the part of the camera's height, which is constant during a drive."""
    return math.sqrt(max(scale_rel**2 - camera_rel**2, 0.0))


def drift_after(way_m: float) -> Floats:
    """Returns the covariance (3, 3) of odometry after a loop of this length, for the chi-square test of the loop."""
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + LOOP_YAW_RAD
    sigma_m = (DRIFT_REL + DRIFT_M) * math.sqrt(way_m) + (LOOP_SCALE_REL + yaw_rad) * way_m / 4.0
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2])


def moved(cov: Floats, step: SE2, valid: bool = True, scale_rel: float = 0.0, error_m: float = 0.0) -> Floats:
    """Propagates a covariance over a step and adds the step's own."""
    Ad = step.inverse().adjoint()
    out: Floats = Ad @ cov @ Ad.T + drift(step, valid, scale_rel, error_m)
    return out


def is_exact(cov: Floats) -> bool:
    """Whether a pose of this covariance (3, 3) is a localisation."""
    return bool(max(cov[0, 0], cov[1, 1]) < LOST_SIGMA_M**2 and cov[2, 2] < LOST_SIGMA_RAD**2)
