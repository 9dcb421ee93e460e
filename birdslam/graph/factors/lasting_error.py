"""The correlated part of a CV edge's error, which the vehicle's next edges do not average out.

An edge is a filter's result (road_users/state) that shares road, size and lower edge with the previous edge. A share of
its covariance C = F F' belongs to an error G n, G = sqrt(share) F, with two unit-variance numbers n, along and across
the line of sight. They are considered, not estimated (Schmidt 1966); see docs/method.md, "Errors that last".
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats

DRIVING_MPS = 1.0  # the view changes well above this speed (as in road_users/state/ground_size_config.py)
_MIN_M2 = 1e-12


def line_of_sight_factor(along: complex, mean: float, deviator: complex) -> tuple[complex, complex]:
    """Columns, as x + iy, of the factor F of a position covariance FF' with this mean and deviator (costs.py).

    The first is along the line of sight, a unit number. The covariance may be singular.
    """
    deviator *= (along * along).conjugate()
    L = math.sqrt(max(mean + deviator.real, _MIN_M2))  # Cholesky factor in the axes of the line of sight
    aside = deviator.imag / L
    across = math.sqrt(max(mean - deviator.real - aside * aside, _MIN_M2))
    return along * complex(L, aside), along * complex(0.0, across)


def lasting_correlation(sigma_rel: Floats, sigma_before_rel: Floats, driven_s: Floats, memory_s: float) -> Floats:
    """Correlation (k, 2) of the lasting errors with those of the previous edges, `driven_s` (k,) of driving ago.

    It drops when the sigma shrinks (new measurements) and when it grows (new errors).
    """
    more, less = np.maximum(sigma_rel, sigma_before_rel), np.minimum(sigma_rel, sigma_before_rel)
    out: Floats = np.exp(-driven_s / memory_s)[:, None] * less / more
    return out
