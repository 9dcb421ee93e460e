"""Camera pitch from the direction of travel: the epipole of a car on a road lies on the horizon.

It needs corners only, neither road nor scale, and initializes the pitch of a following drive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from birdslam.calibration.lens_adjustment import LensProblem

_MIN_WINDOWS = 4
_TRAVEL_SIGMA_RAD = 0.003  # suspension and grade
_MAX_PITCH_RAD = 0.3  # maximum angle between direction of travel and optical axis
_NORMAL_PER_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation


class TravelPitch(NamedTuple):
    """Pitch of the camera relative to the direction of travel, > 0: nose down, with its 1-sigma."""

    pitch_rad: float
    sigma_rad: float


def pitch_by_travel(problem: LensProblem, focal_sigma_rel: float) -> TravelPitch | None:
    """Median pitch over the windows of a drive; None with too few windows.

    The sigma is from their scatter; overlapping windows count half. An angle has the relative error of the focal
    length.
    """
    at = -np.einsum("wikj,wik->wij", problem.R, problem.t)  # (W, IMAGES, 3) of each image in its window's first camera
    steps = np.einsum("wikl,wil->wik", problem.R[:, :-1], np.diff(at, axis=1))
    pitch = np.arctan2(-steps[..., 1], np.linalg.norm(steps[..., ::2], axis=-1)).mean(axis=1)
    pitch = pitch[(steps[..., 2] > 0.0).all(axis=1) & (np.abs(pitch) < _MAX_PITCH_RAD)]
    if len(pitch) < _MIN_WINDOWS:
        return None
    centre = float(np.median(pitch))
    spread = _NORMAL_PER_MAD * float(np.median(np.abs(pitch - centre)))
    of_median = math.sqrt(0.5 * math.pi / (0.5 * len(pitch)))  # of a normal distribution's median, by its sigma
    return TravelPitch(centre, math.hypot(_TRAVEL_SIGMA_RAD, of_median * spread, centre * focal_sigma_rel))
