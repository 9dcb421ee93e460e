"""Posterior of an unknown metric scale, on a grid over its logarithm.

Each measurement is a likelihood over the scale or an outlier: p(z | s) = P p(z) + (1 - P) p(z | s).
So no single image decides, and all evidence of the last images counts together. Where the posterior has one mode, the
road's Kalman filter takes over from it (`road/scale.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEP_LOG = 0.06
GRID_LOG: Floats = np.arange(-70.0, 71.0, dtype=np.float64) * STEP_LOG  # factors of 1/66 to 66
P_OUTLIER = 0.3  # of a measurement: in traffic, shadows on the road move
P_WRONG = 0.003  # of a scale that was found
_P_DOUBTED = 0.03  # of a scale that the last images of the road contradict
MODE_HALF_WIDTH_LOG = 0.25


@dataclass(frozen=True)
class Mode:
    """A mode of the posterior: the log of its scale, its probability, and its 1-sigma."""

    log: float
    probability: float
    sigma_log: float


class ScalePosterior:
    """State: probabilities of metres per unit of the window. Reader: `RoadScale`."""

    def __init__(self) -> None:
        self._log_p: Floats = np.zeros(len(GRID_LOG))
        self._offset_log = 0.0  # by which the lengths of the window were multiplied since the last reset

    @property
    def log_factors(self) -> Floats:
        """(N,) log of the factor on the window's present lengths to metres, of each cell."""
        return GRID_LOG - self._offset_log

    def reset(self, sigma_log: float | None = None) -> None:
        """Resets to a uniform prior, or to the window's scale with a 1-sigma of `sigma_log`, which may be wrong."""
        self._offset_log, self._log_p = 0.0, np.zeros(len(GRID_LOG))
        if sigma_log is not None:
            kept = np.exp(-0.5 * np.square(GRID_LOG / max(sigma_log, STEP_LOG)))
            self._log_p = np.log((1.0 - _P_DOUBTED) * kept / kept.sum() + _P_DOUBTED / len(kept))

    def rescale(self, log_factor: float) -> None:
        """Follows a multiplication of all lengths."""
        self._offset_log += log_factor

    def diffuse(self, var_log: float) -> None:
        """Adds the variance of a random walk of the scale."""
        share = min(0.5 * var_log / STEP_LOG**2, 0.25)
        p = np.pad(self._probabilities(), 1, mode="edge")
        self._log_p = np.log((1.0 - 2.0 * share) * p[1:-1] + share * (p[2:] + p[:-2]) + 1e-300)

    def update(self, log_likelihood: Floats, independence: float = 1.0) -> float:
        """Updates with a measurement's log likelihood (N,), up to a constant.

        `independence` is 0 to 1: the fraction of the measurement that earlier ones do not share. Returns the
        probability that the measurement is an outlier if the window's present scale is right.
        """
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        mixture = P_OUTLIER + (1.0 - P_OUTLIER) * likelihood / likelihood.mean()
        self._log_p += independence * np.log(mixture)
        self._log_p -= self._log_p.max()
        return P_OUTLIER / float(mixture[self._near(int(np.abs(self.log_factors).argmin()))].max())

    def plausible(self, min_ratio: float) -> NDArray[np.bool_]:
        """(N,) cells with at least `min_ratio` of the largest probability."""
        return np.asarray(self._log_p >= self._log_p.max() + np.log(min_ratio))

    def mode(self) -> Mode:
        """The mode around the cell with the largest probability."""
        return self._around(int(self._log_p.argmax()))

    def at_present(self) -> Mode:
        """The mode around the window's present scale."""
        return self._around(int(np.abs(self.log_factors).argmin()))

    def _around(self, cell: int) -> Mode:
        near = self._near(cell)
        p, log_factors = self._probabilities()[near], self.log_factors[near]
        total = float(p.sum())
        mean = float(p @ log_factors) / total
        sigma = np.sqrt(float(p @ np.square(log_factors - mean)) / total + STEP_LOG**2 / 12.0)
        return Mode(mean, total, float(sigma))

    def _near(self, cell: int) -> NDArray[np.bool_]:
        return np.asarray(np.abs(GRID_LOG - GRID_LOG[cell]) < MODE_HALF_WIDTH_LOG)

    def _probabilities(self) -> Floats:
        p = np.exp(self._log_p - self._log_p.max())
        out: Floats = p / p.sum()
        return out
