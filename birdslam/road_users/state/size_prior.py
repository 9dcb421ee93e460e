"""Prior of heights: mean of the class, a common offset of the drive, and a Student's t per vehicle.

    log h = log h_class + common + own,   own ~ t(dof, scale)

The tails of a normal distribution are too thin. The t is treated as a normal distribution of variance scale^2 / w with
the mean weight w = (dof - 1) / (dof + E[own^2] / scale^2). The weight is updated as the height is learned, by a rank-
one change of the information (Sherman-Morrison).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MIN_VARIANCE = 1e-12  # of a height
_MIN_CHANGE = 0.02  # of a weight, for an update


class SizePrior:
    """Calls: add_vehicle() per vehicle, then reweigh() after its boxes.

    State of each vehicle: log of the class's height (m), squared scale of its t, and its weight.
    """

    def __init__(self, sigma_common: float, dof: float) -> None:
        self.sigma_common, self.dof = sigma_common, dof
        self.log_height = np.zeros(0)
        self._scale2 = np.zeros(0)
        self._weight = np.zeros(0)

    def add_vehicle(self, height_m: float, sigma_height: float) -> tuple[float, float]:
        """Adds a vehicle in the next row; returns its factor on `common`, and the variance of its own part."""
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
        """Replaces the prior of a vehicle in state and covariance; `at` is the index of log h and of `common`."""
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
        for mean, share, scale2 in priors:  # the new one first, so that the information stays positive
            x, P = _informed(x, P, at, mean, share / scale2)
        self.log_height[row], self._weight[row], self._scale2[row] = priors[0]
        return x, P

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes the vehicles of all other rows."""
        for name in ("log_height", "_scale2", "_weight"):
            setattr(self, name, getattr(self, name)[rows])

    def without_vehicles(self) -> SizePrior:
        """An empty prior with the same parameters."""
        return SizePrior(self.sigma_common, self.dof)

    def reweigh(
        self, rows: Sequence[int], x: Floats, P: Floats, at: NDArray[np.intp], common: int
    ) -> tuple[Floats, Floats]:
        """Updates the weights in state (M,) and covariance (M, M); log h is at `at` (N,), the offset at `common`."""
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
