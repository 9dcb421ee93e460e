"""Measurement model of the boxes in `ground_size_filter.GroundSizeFilter`.

z is the depth of the nearest face, r the distance on to the roof's far edge, y/x the bearing, H the camera height; the
road rises by pitch + tilt + v (z - PLANE_AT_M) / 2 - roll y/x - crown |y|/x with the vertical curvature v:

    bottom = (H + edge) / z - rise      (Eq. 1)            top = (H - h) / (z + r) - rise
    log width = log w + log(class's outline) - log z
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev

Floats = NDArray[np.float64]

# Common states: tilt of the camera over the road, its crown, systematic errors of the tilt by images, common errors of
# sizes and of lower edges, vertical curvature, common error of the heights of people over the road
PITCH, ROLL, CROWN, IMAGE_PITCH, IMAGE_ROLL, SIZE, LOWER, VERTICAL, BODY = range(9)
COMMON, OWN = 9, 4  # numbers of common states, and of states per vehicle
HEIGHT, OUTLINE, EDGE, TILT = range(OWN)
Cue = Literal["bottom", "top", "width"]
CUES: tuple[Cue, ...] = ("bottom", "top", "width")  # measurements per box, in this order


@dataclass(frozen=True)
class RoadTilts:
    """Tilts (N,) of the road beyond the estimated ground, each by a box of a person of its class's height.

    `slope` is the derivative by a log factor on the height, `variance` that of one person, and `correlated` the
    number of successive boxes that count as one.
    """

    tilt_rad: Floats
    bearing: Floats
    slope: Floats
    variance: Floats
    correlated: Floats


def expected_boxes(
    x: Floats, at: NDArray[np.intp], bearing: Floats, reach: Floats, height_m: float, tilt_rad: Floats
) -> tuple[Floats, Floats]:
    """Expected measurements (3 N,) of a state (M + N,), cue by cue, and their Jacobian (3 N, M + N).

    `at` (N,) is the index of each box's vehicle in the state; its last N entries are the log depths. Slopes are
    relative to a ground of `tilt_rad` (pitch, roll); `height_m` is the camera height.
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
    """Inverse of the innovation covariance S (M, M), with a robust weight (Huber) on each box's worst cue.

    Innovations (M,) are ordered cue by cue. The innovation given all others is (S^-1 v)_i / (S^-1)_ii with variance 1 /
    (S^-1)_ii; beyond `gate_sigma` its noise is raised.
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
