"""How far odometry may be off after a way, by which poses in a map grow uncertain; and what still is a localisation.

Odometry says itself how sure its metres are (`scale_sigma_rel`); and where two of its steps differ by more than a car
can brake or speed up, the rest is its error.
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import NS_PER_S, Estimate

LOST_SIGMA_M, LOST_SIGMA_RAD = 0.5, math.radians(1.5)  # beyond it a pose counts as lost
# Odometry between fixes, 1-sigma: along and across as a share of the way, yaw by the root of it
DRIFT_REL, DRIFT_M, DRIFT_YAW_RAD = 0.02, 0.01, 0.0012
INVALID_REL, INVALID_YAW_RAD_PER_M = 1.0, 0.02  # of a step that odometry itself calls invalid: any length, any bend
MIN_SCALE_REL = 0.012  # 1-sigma of its metric scale, where it calls it surer
MAX_MPS2 = 10.0  # by which a car changes its velocity: its tyres hold no more
# An error of odometry's scale lasts for CORRELATION_M of way, as in the window's graph, and a part of it for KEPT_M
CORRELATION_M, KEPT_M = 20.0, 1000.0
ACROSS_M, ALONG_M = 0.03, 0.01  # of a link, by the root of its way: direction (.005 rad for CORRELATION_M), the rest
LOOP_SCALE_REL = 0.01  # by which the scale of odometry differs from one end of a way to the other
LOOP_YAW_RAD = 0.0006


class Steps:
    """An odometry's steps, estimate by estimate in one epoch."""

    def __init__(self) -> None:
        self._last: Estimate | None = None
        self._velocity_mps: tuple[float, float] | None = None  # of the last step, in its ego
        self.sum_m2 = 0.0  # variance of all errors that `add` has found so far, and of the invalid steps

    def add(self, estimate: Estimate) -> float:
        """By how much the step that ends here is off for sure, in metres."""
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
    """(3, 3) covariance of a step of odometry, of the tangent at its end.

    `scale_rel` is the sigma that odometry states of its metres, `error_m` what is known to be wrong (`Steps`).
    """
    way_m = math.hypot(step.x_m, step.y_m)
    sigma_m = max(DRIFT_REL, scale_rel) * way_m + DRIFT_M * math.sqrt(way_m) + error_m
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + 0.02 * abs(step.yaw_rad)
    if not valid:
        sigma_m += INVALID_REL * way_m
        yaw_rad += INVALID_YAW_RAD_PER_M * way_m + abs(step.yaw_rad)
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2]) + 1e-10 * np.eye(3)


def link_cov(step: SE2, scale_rel: float, unsure_m2: float = 0.0) -> Floats:
    """(3, 3) covariance of a drive's own motion between two keyframes, apart from the part of its scale that is kept.

    `unsure_m2`: variance of what is known to be wrong in it (`Steps`).
    """
    way_m = math.hypot(step.x_m, step.y_m)
    scale_rel = max(scale_rel, MIN_SCALE_REL)
    along_m2 = (ALONG_M**2 + 2.0 * CORRELATION_M * scale_rel**2) * way_m  # as of independent steps, over a long way
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + 0.02 * abs(step.yaw_rad)
    yaw_rad2 = yaw_rad**2 + INVALID_YAW_RAD_PER_M**2 * unsure_m2
    return np.diag([along_m2 + unsure_m2, ACROSS_M**2 * way_m + unsure_m2, yaw_rad2]) + 1e-10 * np.eye(3)


def own_scale_rel(scale_rel: float, camera_rel: float) -> float:
    """What odometry's sigma of its metres has besides the camera's height, which is the same all along a drive."""
    return math.sqrt(max(scale_rel**2 - camera_rel**2, 0.0))


def drift_after(way_m: float) -> Floats:
    """(3, 3) what odometry may be off after so much way there and back, by which a loop is judged (chi-square)."""
    yaw_rad = DRIFT_YAW_RAD * math.sqrt(way_m) + LOOP_YAW_RAD
    sigma_m = (DRIFT_REL + DRIFT_M) * math.sqrt(way_m) + (LOOP_SCALE_REL + yaw_rad) * way_m / 4.0
    return np.diag([sigma_m**2, sigma_m**2, yaw_rad**2])


def moved(cov: Floats, step: SE2, valid: bool = True, scale_rel: float = 0.0, error_m: float = 0.0) -> Floats:
    """A covariance at the beginning of a step, at its end, with the step's own."""
    Ad = step.inverse().adjoint()
    out: Floats = Ad @ cov @ Ad.T + drift(step, valid, scale_rel, error_m)
    return out


def is_exact(cov: Floats) -> bool:
    """Whether a pose of this covariance (3, 3) is a localisation."""
    return bool(max(cov[0, 0], cov[1, 1]) < LOST_SIGMA_M**2 and cov[2, 2] < LOST_SIGMA_RAD**2)
