"""The correlated part of a CV edge's error, which the vehicle's next edges do not average out.

An edge is a filter's result (vehicles/state) that shares road, size and lower edge with the previous edge. A share of
its covariance C = F F' belongs to an error G n, G = sqrt(share) F, with two unit-variance numbers n, along and across
the line of sight. They are considered, not estimated (Schmidt 1966); see docs/method.md, "Errors that last".
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.graph.edges import CvEdges

DRIVING_MPS = 1.0  # the view changes well above this speed (as in vehicles/state/ground_size_config.py)
_MIN_M2 = 1e-12


def line_of_sight_factors(at: Complexes, covs: Floats) -> Floats:
    """Factors F (k, 2, 2) of the position covariances FF' in `covs` (k, 3, 3); column 0 is along the line of sight."""
    along = at / np.maximum(np.abs(at), 1e-9)
    axes = np.array([[along.real, -along.imag], [along.imag, along.real]]).transpose(2, 0, 1)
    C = axes.transpose(0, 2, 1) @ covs[:, :2, :2] @ axes
    L = np.zeros(C.shape)  # Cholesky factor; C may be singular
    L[:, 0, 0] = np.sqrt(np.maximum(C[:, 0, 0], _MIN_M2))
    L[:, 1, 0] = C[:, 1, 0] / L[:, 0, 0]
    L[:, 1, 1] = np.sqrt(np.maximum(C[:, 1, 1] - np.square(L[:, 1, 0]), _MIN_M2))
    out: Floats = axes @ L
    return out


def relative_sigmas(edges: CvEdges) -> Floats:
    """1-sigma (k, 2) of the edges' positions along and across the line of sight, as fractions of the distance."""
    distance_m = np.maximum(np.abs(edges.at), 1e-9)
    out: Floats = np.sqrt(np.square(edges.factors).sum(axis=1)) / distance_m[:, None]
    return out


def lasting_correlation(sigma_rel: Floats, sigma_before_rel: Floats, driven_s: Floats, memory_s: float) -> Floats:
    """Correlation (k, 2) of the lasting errors with those of the previous edges, `driven_s` (k,) of driving ago.

    It drops when the sigma shrinks (new measurements) and when it grows (new errors).
    """
    more, less = np.maximum(sigma_rel, sigma_before_rel), np.minimum(sigma_rel, sigma_before_rel)
    out: Floats = np.exp(-driven_s / memory_s)[:, None] * less / more
    return out
