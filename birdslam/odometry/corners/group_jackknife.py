"""Whether one part of the image alone gives a step its length: a delete-a-group jackknife (Quenouille; Tukey 1958).

The corners of a vehicle that no detector found, and that drives as the car does, stay in view while the street's pass
by. So their landmarks are the best known ones, and a robust kernel rejects the street. But they lie together: without
their part of the image the step is another one, by more than chance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.resection import linearised
from birdslam.odometry.corners.selection import Corners
from birdslam.odometry.corners.sliding_window import SlidingWindow

Floats = NDArray[np.float64]

_STRIPS, _STRIPS_LEFT_OUT = 8, 2  # of the image, side by side: a vehicle beside the car covers a quarter of its width
_LEAST_LANDMARKS = 5  # of a part that is left out
_WEAK = 1e-3  # information that keeps a solution finite


def length_without_a_part(
    window: SlidingWindow, corners: Corners, reference: Pose, pose: Pose, inflation: float
) -> tuple[float, float]:
    """By how much the step from `reference` to `pose` changes in length without the part of the image that changes it
    most, and how many sigmas that is; `inflation` is that of the pose's covariance. (0, 0) where too little is seen."""
    x, J, r, weights = linearised(window, corners, pose)
    step = pose.R.T @ (pose.p - reference.p)
    length = float(np.linalg.norm(step))
    if length < 1e-9 or len(x) < 2 * _LEAST_LANDMARKS:
        return 0.0, 0.0
    along = np.concatenate([step / length, np.zeros(3)])
    strip = np.minimum((_STRIPS * (x - x.min()) / max(float(np.ptp(x)), 1e-9)).astype(np.int64), _STRIPS - 1)
    by_strip = [_normal_equations(J, r, weights, strip == k) for k in range(_STRIPS)]
    A, g = sum(a for a, _, _ in by_strip) + _WEAK * np.eye(6), sum(b for _, b, _ in by_strip)
    all_, var = -np.linalg.solve(A, g), float(along @ np.linalg.solve(A, along))
    change, most = 0.0, 0.0
    for k in range(_STRIPS - _STRIPS_LEFT_OUT + 1):
        left_out = by_strip[k : k + _STRIPS_LEFT_OUT]
        if sum(n for _, _, n in left_out) < _LEAST_LANDMARKS:
            continue
        B = A - sum(a for a, _, _ in left_out)
        rest = -np.linalg.solve(B, g - sum(b for _, b, _ in left_out))
        off = float(along @ (rest - all_))
        sigma = math.sqrt(inflation * max(float(along @ np.linalg.solve(B, along)) - var, 1e-12))
        if abs(off) / sigma > most:
            change, most = off, abs(off) / sigma
    return change, most


def _normal_equations(J: Floats, r: Floats, weights: Floats, of: NDArray[np.bool_]) -> tuple[Floats, Floats, int]:
    """Of some landmarks, and their number."""
    flat = J[:, :, of].reshape(6, -1)
    weighted = (J[:, :, of] * weights[of]).reshape(6, -1)
    return weighted @ flat.T, weighted @ r[:, of].reshape(-1), int((weights[of] > 0.0).sum())
