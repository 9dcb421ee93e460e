"""What one comparison of the road's image says for itself, and how surely.

The slopes of smooth asphalt are noise for the most part. Noise pulls a fit towards what it began with and makes it look
sure of that, since slopes count as information whether or not the other image has them too. So each slope is held
against the same place's in the other image, whose noise is another (instrumental variables, as of a regression with
errors in its variables):

    shared  = sum w s there here^T      noise = sum w s^2 mean mean^T      mean = (there + here) / 2
    x       = x - shared^-1 sum w s mean r         cov = shared^-1 noise shared^-1

where `there` and `here` are a pixel's derivatives by the slopes of the past and of the present image, r is its
residual, w its weight, and s the share of the slopes about it that both images have: of painted lines all, of grain
that a video encoder left out none. In the direction with the
least of it KITTI's images share 0.9 of their information, rendered asphalt half, behind an encoder nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ROAD = 4  # log lambda, pitch, roll, curvature; then the errors of the odometry's motion, and the brightness
MOTION = 5  # the rotation's error (3), that of the direction of travel to the right and down (2)
_LEAST_INFORMATION = (1.0, 10.0, 10.0, 1e4)
_LEAST_BRIGHTNESS = 1e-6
# Rows and columns over which slopes are held against each other; of rendered motorways, streets and nights behind
# windscreens and an encoder, six images each, (10, 20) and (26, 52) fail as few
_CELL_PX = (16, 32)
_LEAST_ALIKE = 0.02  # of a cell, so that no fit is without pixels
_LEAST_SHARED = 0.35  # of the information in any direction: less can't be told from none by so few pixels


@dataclass(frozen=True)
class RoadFit:
    """What one comparison alone says: (log lambda, pitch_rad, roll_rad, curvature_per_m) and its covariance (4, 4)."""

    state: Floats
    cov: Floats
    correlation: float
    samples: int


@dataclass(frozen=True)
class Slopes:
    """One image's slopes at the samples, along the past camera's axes x and y (N,) each, and the residual's derivative
    (11, N) by (log lambda, pitch, roll, curvature, errors of the motion, bias, gain) that they make."""

    x: Floats
    y: Floats
    derivative: Floats


def fit_alone(
    x: Floats, px: Ints, there: Slopes, here: Slopes, residual: Floats, weights: Floats, motion_info: Floats
) -> tuple[Floats, Floats]:
    """(4,) and its covariance (4, 4), by the images alone, from the state `x` (9,) that a prior has guided the fit to.

    `px` (N, 2), `residual` (N,) and `weights` (N,) are the samples', `motion_info` (5, 5) is how well the motion's
    errors were known. A direction that the images do not see has a variance far above what roads have: it is harmless.
    """
    share = alike(px, there, here)
    mean = 0.5 * (there.derivative + here.derivative)
    shared = (there.derivative * (weights * share)) @ here.derivative.T
    shared = 0.5 * (shared + shared.T)
    noise = (mean * (weights * share**2)) @ mean.T
    pull = mean @ (weights * share * residual)
    motion = slice(ROAD, ROAD + MOTION)
    for information in (shared, noise):
        information[motion, motion] += motion_info
        information[np.diag_indices(ROAD)] += _LEAST_INFORMATION
        information[range(-2, 0), range(-2, 0)] += _LEAST_BRIGHTNESS
    pull[motion] += motion_info @ x[motion]
    inverse = np.linalg.inv(_at_least(_LEAST_SHARED, shared, noise))
    state: Floats = x[:ROAD] - (inverse @ pull)[:ROAD]
    cov: Floats = (inverse @ noise @ inverse)[:ROAD, :ROAD]
    return state, 0.5 * (cov + cov.T)


def alike(px: Ints, there: Slopes, here: Slopes) -> Floats:
    """(N,) the share of the slopes about each sample that both images have, 0 to 1."""
    row, column = px[:, 1] // _CELL_PX[0], px[:, 0] // _CELL_PX[1]
    cell = row * (int(column.max()) + 1) + column
    both = np.bincount(cell, there.x * here.x + there.y * here.y)
    each = np.bincount(cell, 0.5 * (there.x**2 + there.y**2 + here.x**2 + here.y**2))
    out: Floats = np.clip(both / np.maximum(each, 1e-9), _LEAST_ALIKE, 1.0)[cell]
    return out


def _at_least(share: float, information: Floats, noise: Floats) -> Floats:
    """The information (n, n), in no direction less than a share of what there would be without noise."""
    L = np.linalg.cholesky(noise)
    by_L = np.linalg.inv(L)
    shares, axes = np.linalg.eigh(by_L @ information @ by_L.T)
    out: Floats = L @ (axes * np.maximum(shares, share)) @ axes.T @ L.T
    return out
