"""The pitch of a camera by the way it travels: a car drives along the road, so that its epipole lies on the horizon.

Corners alone show where the camera travels; neither the road nor a scale is needed. So a drive that follows begins with
a camera whose pitch is about right: where it is off by two degrees or more, the road's image shows no motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from birdslam.calibration.lens_adjustment import LensProblem

_MIN_WINDOWS = 4
_TRAVEL_SIGMA_RAD = 0.003  # a car squats on its springs, and climbs a little
_STEEPEST_RAD = 0.3  # a direction farther from the axis is no car's
_NORMAL_PER_MAD = 1.4826  # a normal distribution's sigma by its median absolute deviation


class TravelPitch(NamedTuple):
    """The camera's pitch against its way, > 0: nose down, with its 1-sigma."""

    pitch_rad: float
    sigma_rad: float


def pitch_by_travel(problem: LensProblem, focal_sigma_rel: float) -> TravelPitch | None:
    """By the poses of the windows of a drive; None of less than a few.

    The median over the windows; its sigma by how far they scatter (the car bounces). Windows overlap by half, so that
    half of them count. An angle from the axis is as sure as the focal length.
    """
    at = -np.einsum("wikj,wik->wij", problem.R, problem.t)  # (W, IMAGES, 3) of each image in its window's first camera
    steps = np.einsum("wikl,wil->wik", problem.R[:, :-1], np.diff(at, axis=1))
    pitch = np.arctan2(-steps[..., 1], np.linalg.norm(steps[..., ::2], axis=-1)).mean(axis=1)
    pitch = pitch[(steps[..., 2] > 0.0).all(axis=1) & (np.abs(pitch) < _STEEPEST_RAD)]
    if len(pitch) < _MIN_WINDOWS:
        return None
    centre = float(np.median(pitch))
    spread = _NORMAL_PER_MAD * float(np.median(np.abs(pitch - centre)))
    of_median = math.sqrt(0.5 * math.pi / (0.5 * len(pitch)))  # of a normal distribution's median, by its sigma
    return TravelPitch(centre, math.hypot(_TRAVEL_SIGMA_RAD, of_median * spread, centre * focal_sigma_rel))
