"""The alignment's estimate without its prior, by instrumental variables, and its covariance.

Image noise in the gradients biases least squares (errors in variables). So each image's gradients are the instruments
of the other's: shared = sum w s past present^T, noise = sum w s^2 mean mean^T, x - shared^-1 sum w s mean r.
past, present: derivatives by either image's gradients; r, w: residual and weight; s: `shared_gradient`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ROAD = 4  # states: log lambda, pitch, roll, curvature
MOTION = 5  # errors of the odometry's motion: rotation (3), direction of travel right and down (2)
_MIN_INFORMATION = (1.0, 10.0, 10.0, 1e4)
_MIN_BRIGHTNESS = 1e-6
_UNOBSERVED_SIGMA_LOG = 10.0  # 1-sigma of the log of an unobserved length
_CELL_PX = (16, 32)  # rows and columns over which gradients are compared
_MIN_SHARED_GRADIENT = 0.02  # of a cell, so that every fit has pixels
_MIN_SHARED_INFORMATION = 0.35  # minimum ratio to the information without noise, in any direction


@dataclass(frozen=True)
class RoadFit:
    """One alignment without its prior: (log lambda, pitch_rad, roll_rad, curvature_per_m) and its covariance (4, 4)."""

    state: Floats
    cov: Floats
    correlation: float
    samples: int
    length_information: float = np.inf  # about the log length, by likelihoods over lengths; 0: none

    def with_max_information(self, information: float) -> RoadFit:
        """The fit with at most this information about the log length, given tilt and curvature."""
        missing = 1.0 / max(information, _UNOBSERVED_SIGMA_LOG**-2) - 1.0 / float(np.linalg.inv(self.cov)[0, 0])
        cov = self.cov.copy()
        cov[0, 0] += max(missing, 0.0)
        return replace(self, cov=cov)


@dataclass(frozen=True)
class Gradients:
    """One image's gradients at the samples along the past camera's axes x and y, (N,) each.

    `derivative` (11, N) is the residual's by (log lambda, pitch, roll, curvature, errors of the motion, bias, gain).
    """

    x: Floats
    y: Floats
    derivative: Floats


def fit_without_prior(
    x: Floats, px: Ints, past: Gradients, present: Gradients, residual: Floats, weights: Floats, motion_info: Floats
) -> tuple[Floats, Floats]:
    """The state (4,) by the images alone and its covariance (4, 4), given the state `x` (9,) of the fit with a prior.

    `px` (N, 2), `residual` (N,) and `weights` (N,) are of the samples; `motion_info` (5, 5) is the prior information of
    the motion's errors. An unobserved direction gets a variance far above that of roads.
    """
    share = shared_gradient(px, past, present)
    mean = 0.5 * (past.derivative + present.derivative)
    shared = (past.derivative * (weights * share)) @ present.derivative.T
    shared = 0.5 * (shared + shared.T)
    noise = (mean * (weights * share**2)) @ mean.T
    gradient = mean @ (weights * share * residual)
    motion = slice(ROAD, ROAD + MOTION)
    for information in (shared, noise):
        information[motion, motion] += motion_info
        information[np.diag_indices(ROAD)] += _MIN_INFORMATION
        information[range(-2, 0), range(-2, 0)] += _MIN_BRIGHTNESS
    gradient[motion] += motion_info @ x[motion]
    inverse = np.linalg.inv(_limit_from_below(_MIN_SHARED_INFORMATION, shared, noise))
    state: Floats = x[:ROAD] - (inverse @ gradient)[:ROAD]
    cov: Floats = (inverse @ noise @ inverse)[:ROAD, :ROAD]
    return state, 0.5 * (cov + cov.T)


def shared_gradient(px: Ints, past: Gradients, present: Gradients) -> Floats:
    """(N,) fraction of the gradient around each sample that both images share, from 0 (noise) to 1 (lane paint)."""
    row, column = px[:, 1] // _CELL_PX[0], px[:, 0] // _CELL_PX[1]
    cell = row * (int(column.max()) + 1) + column
    both = np.bincount(cell, past.x * present.x + past.y * present.y)
    each = np.bincount(cell, 0.5 * (past.x**2 + past.y**2 + present.x**2 + present.y**2))
    out: Floats = np.clip(both / np.maximum(each, 1e-9), _MIN_SHARED_GRADIENT, 1.0)[cell]
    return out


def _limit_from_below(share: float, information: Floats, noise: Floats) -> Floats:
    """The information (n, n), at least `share` times `noise` in each direction."""
    L = np.linalg.cholesky(noise)
    by_L = np.linalg.inv(L)
    shares, axes = np.linalg.eigh(by_L @ information @ by_L.T)
    out: Floats = L @ (axes * np.maximum(shares, share)) @ axes.T @ L.T
    return out
