"""The prior of heights: a class's mean, what a drive's vehicles have in common, and Student's t about both.

    log h = log h_class + common + own,   own ~ t(dof, scale)

One car in thirty is over 15 % taller than its class: more than a normal distribution has. A t is a normal distribution
of variance scale^2 / w, with the mean weight w = (dof - 1) / (dof + E[own^2] / scale^2) once `own` is known. As a
height is learned, its prior's weight is replaced: a change of information of rank one (Sherman, Morrison).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MIN_VARIANCE = 1e-12  # of a height that its class knows exactly
_MIN_CHANGE = 0.02  # of a weight: a smaller one is left for later


class SizePrior:
    """begin() with each vehicle, then reweigh() after its boxes.

    State, of each vehicle: the log of its class's height (m), the squared scale of its t and its weight.
    """

    def __init__(self, sigma_common: float, dof: float) -> None:
        self.sigma_common, self.dof = sigma_common, dof
        self.log_height = np.zeros(0)
        self._scale2 = np.zeros(0)
        self._weight = np.zeros(0)

    def begin(self, height_m: float, sigma_height: float) -> tuple[float, float]:
        """Of a vehicle in the next row: the share of `common` that it has, and the variance of its own part."""
        variance = sigma_height**2 - self.sigma_common**2
        shares = variance > 0.0
        if not shares:
            variance = max(sigma_height**2, MIN_VARIANCE)
        weight = 1.0 - 2.0 / self.dof
        self.log_height = np.append(self.log_height, math.log(height_m))
        self._scale2, self._weight = np.append(self._scale2, variance * weight), np.append(self._weight, weight)
        return float(shares), variance

    def replace(
        self,
        row: int,
        x: Floats,
        P: Floats,
        at: tuple[int, int],
        height_m: float,
        sigma_height: float,
    ) -> tuple[Floats, Floats]:
        """State and covariance with another prior of a vehicle's height; `at` is where log h and `common` stand."""
        variance = max(sigma_height**2 - self.sigma_common**2, MIN_VARIANCE)
        weight = 1.0 - 2.0 / self.dof
        priors = (
            (math.log(height_m), weight, variance * weight),
            (
                float(self.log_height[row]),
                -float(self._weight[row]),
                float(self._scale2[row]),
            ),
        )
        for mean, share, scale2 in priors:  # the new one first: information is never negative
            x, P = _informed(x, P, at, mean, share / scale2)
        self.log_height[row], self._weight[row], self._scale2[row] = priors[0]
        return x, P

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Forget the vehicles of all other rows."""
        for name in ("log_height", "_scale2", "_weight"):
            setattr(self, name, getattr(self, name)[rows])

    def without_vehicles(self) -> SizePrior:
        """One for the same class table."""
        return SizePrior(self.sigma_common, self.dof)

    def reweigh(
        self, rows: Sequence[int], x: Floats, P: Floats, at: NDArray[np.intp], common: int
    ) -> tuple[Floats, Floats]:
        """State (M,) and covariance (M, M) by new weights; log h is at `at` (N,), what they share at `common`."""
        if not math.isfinite(self.dof):
            return x, P
        own = x[at] - x[common] - self.log_height[rows]
        variance = P[at, at] - 2.0 * P[at, common] + P[common, common]
        weight = (self.dof - 1.0) / (self.dof + (own**2 + variance) / self._scale2[rows])
        for k in np.flatnonzero(np.abs(weight - self._weight[rows]) > _MIN_CHANGE).tolist():
            row = rows[k]
            change = (weight[k] - self._weight[row]) / self._scale2[row]
            x, P = _informed(x, P, (int(at[k]), common), float(self.log_height[row]), float(change))
            self._weight[row] = weight[k]
        return x, P


def _informed(x: Floats, P: Floats, at: tuple[int, int], mean: float, information: float) -> tuple[Floats, Floats]:
    """Adds the information that log h minus `common` is `mean` (Sherman-Morrison)."""
    of_height, common = at
    Pa = P[:, of_height] - P[:, common]
    gain = Pa * (information / (1.0 + information * (Pa[of_height] - Pa[common])))
    return x + gain * (mean - (x[of_height] - x[common])), P - np.outer(gain, Pa)
