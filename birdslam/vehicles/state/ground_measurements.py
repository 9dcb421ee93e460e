"""The measurements of the boxes in `ground_size_filter.GroundSizeFilter`, and what a state expects of them.

z is the depth of the nearest face, r on to the roof's far edge, y/x the box's bearing, H the camera's height; the road
rises by pitch + tilt + v (z - PLANE_AT_M) / 2 - roll y/x - crown |y|/x, v its vertical curvature:

    bottom = (H + edge) / z - rise      (Eq. 1)            top = (H - h) / (z + r) - rise
    log width = log w + log(class's outline) - log z
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev

Floats = NDArray[np.float64]

# States of all vehicles: tilt of the camera over the road, its crown, lasting errors of the images' tilt, what the
# sizes and what the lower edges have in common, the road's vertical curvature
PITCH, ROLL, CROWN, IMAGE_PITCH, IMAGE_ROLL, SIZE, LOWER, VERTICAL = range(8)
COMMON, OWN = 8, 4  # and of each vehicle:
HEIGHT, OUTLINE, EDGE, TILT = range(OWN)
Cue = Literal["bottom", "top", "width"]
CUES: tuple[Cue, ...] = ("bottom", "top", "width")  # measurements of each box, in this order


def expected_boxes(
    x: Floats, at: NDArray[np.intp], bearing: Floats, reach: Floats, height_m: float, tilt_rad: Floats
) -> tuple[Floats, Floats]:
    """The measurements (3 N,) expected of a state (M + N,), cue by cue, and their derivatives (3 N, M + N) by it.

    `at` (N,) is where the state has each box's vehicle, its last N numbers are the logs of the depths. Slopes are
    against a ground of `tilt_rad` (pitch, roll); `height_m` is the camera's.
    """
    n = len(at)
    m = len(x) - n
    rows = np.arange(n)
    depth, height = np.exp(x[m:]), np.exp(x[at])
    below = height_m + x[at + EDGE]
    far = np.where(height_m > height, depth + reach, depth)
    half = bev.rise(depth, 1.0)
    level = x[PITCH] - tilt_rad[0] + x[at + TILT] + x[VERTICAL] * half
    lean = (x[ROLL] - tilt_rad[1]) * bearing + x[CROWN] * np.abs(bearing)
    bottom = bev.road_slope(depth, below) - level + lean  # Eq. 1
    top = (height_m - height) / far - level + lean
    J = np.zeros((len(CUES) * n, m + n))
    J[: 2 * n, PITCH] = -1.0
    J[:n, ROLL] = J[n : 2 * n, ROLL] = bearing
    J[:n, CROWN] = J[n : 2 * n, CROWN] = np.abs(bearing)
    J[rows, at + TILT] = J[n + rows, at + TILT] = -1.0
    J[:n, VERTICAL] = J[n : 2 * n, VERTICAL] = -half
    J[rows, at + EDGE] = 1.0 / depth
    falls = 0.5 * x[VERTICAL] * depth
    J[rows, m + rows] = -below / depth - falls
    J[n + rows, at] = -height / far
    J[n + rows, m + rows] = -(height_m - height) / far**2 * depth - falls
    J[2 * n + rows, at + OUTLINE] = 1.0
    J[2 * n + rows, m + rows] = -1.0
    return np.concatenate([bottom, top, x[at + OUTLINE] - x[m:]]), J


def robust_information(S: Floats, innovation: Floats, gate_sigma: float) -> Floats:
    """The inverse of the innovations' covariance S (M, M), with the worst cue of each box at a robust weight (Huber).

    Innovations (M,) stand cue by cue, of all boxes each. One differs from its prediction by all the others by
    (S^-1 v)_i / (S^-1)_ii, with the variance 1 / (S^-1)_ii: past `gate_sigma` its noise is raised.
    """
    whole = np.asarray(np.linalg.inv(S), dtype=np.float64)
    precision = np.diag(whole)
    residual = np.abs(whole @ innovation) / np.sqrt(precision)
    by_box = residual.reshape(len(CUES), -1)
    n = by_box.shape[1]
    worst = by_box.argmax(axis=0) * n + np.arange(n)
    worst = worst[residual[worst] > gate_sigma]
    if not len(worst):
        return whole
    # Woodbury: noise added to a few measurements
    more = ((residual[worst] / gate_sigma) ** 4 - 1.0) / precision[worst]
    columns = whole[:, worst]
    inner = np.diag(1.0 / more) + columns[worst]
    out: Floats = whole - columns @ np.linalg.solve(inner, columns.T)
    return out
