"""The part of a CV edge's error that lasts, so that the vehicle's next edges do not average it away.

An edge is a filter's result (vehicles/state), whose road, size and lower edge are those of the edge before. Of its
covariance C = F F' a share is that of an error G n, G = sqrt(share) F, with n two numbers of variance 1, along the line
of sight and across it, of the vehicle's state. They are considered and not estimated (Schmidt 1966). docs/method.md
("Errors that last") has the reasons and what was measured.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.graph.edges import CvEdges

DRIVING_MPS = 1.0  # as in vehicles/state/ground_size_config.py: the view changes far above this speed, not below it
_MIN_M2 = 1e-12


def sight_factors(at: Complexes, covs: Floats) -> Floats:
    """(k, 2, 2) F of the places' covariances FF' in `covs` (k, 3, 3); its first column lies along the line of sight."""
    along = at / np.maximum(np.abs(at), 1e-9)
    axes = np.array([[along.real, -along.imag], [along.imag, along.real]]).transpose(2, 0, 1)
    C = axes.transpose(0, 2, 1) @ covs[:, :2, :2] @ axes
    L = np.zeros(C.shape)  # Cholesky's, of what may be singular
    L[:, 0, 0] = np.sqrt(np.maximum(C[:, 0, 0], _MIN_M2))
    L[:, 1, 0] = C[:, 1, 0] / L[:, 0, 0]
    L[:, 1, 1] = np.sqrt(np.maximum(C[:, 1, 1] - np.square(L[:, 1, 0]), _MIN_M2))
    out: Floats = axes @ L
    return out


def relative_sigmas(edges: CvEdges) -> Floats:
    """(k, 2) 1-sigma of the edges' places along the line of sight and across it, as fractions of the distance."""
    distance_m = np.maximum(np.abs(edges.at), 1e-9)
    out: Floats = np.sqrt(np.square(edges.factors).sum(axis=1)) / distance_m[:, None]
    return out


def kept(sigma_rel: Floats, sigma_before_rel: Floats, driven_s: Floats, memory_s: float) -> Floats:
    """(k, 2) how much of the lasting errors is that of the edges before, `driven_s` (k,) of driving ago.

    A result that has become surer rests on new measurements, one that has become less sure on new errors.
    """
    more, less = np.maximum(sigma_rel, sigma_before_rel), np.minimum(sigma_rel, sigma_before_rel)
    out: Floats = np.exp(-driven_s / memory_s)[:, None] * less / more
    return out
