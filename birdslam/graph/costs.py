"""Residual (Eq. 2), scaled information (Eq. 4) and cost (Eq. 5) of edges, for all edges of a type at once.

Information matrices are given by covariances. A pose is complex: position x + iy and heading e^(i yaw). A point's
covariance [[m + a, b], [b, m - a]] is its mean m and its deviator d = a + ib: a rotation by an angle multiplies d by
e^(2i angle), and the inverse is (m, -d) / (m^2 - |d|^2).
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats

Triple = tuple[float, float, float]


def binary_residuals(measured_at: Complexes, measured_heading: Complexes, at: Complexes, heading: Complexes) -> Floats:
    """Residuals (k, 3) x_m, y_m, yaw_rad of CV or VV edges, in the axes of their source nodes.

    Inputs are the measurements T_S_D and the window's poses of D in S, each as position (k,) and heading (k,).
    """
    out = np.empty((len(at), 3))
    gap = measured_at - at  # Eq. 2: its translation
    out[:, 0], out[:, 1] = gap.real, gap.imag
    turn = measured_heading * heading.conj()
    out[:, 2] = np.arctan2(turn.imag, turn.real)  # Eq. 2: its rotation
    return out


def rotated(covs: Floats, heading: Complexes) -> Floats:
    """Rotates covariances (k, 3, 3) from axes with `heading` (k,) to the axes in which the headings are given."""
    turn = np.zeros(covs.shape)
    turn[:, 0, 0] = turn[:, 1, 1] = heading.real
    turn[:, 1, 0] = heading.imag
    turn[:, 0, 1] = -heading.imag
    turn[:, 2, 2] = 1.0
    out: Floats = turn @ covs @ turn.transpose(0, 2, 1)
    return out


def inflation(costs: Floats, gate: float) -> Floats:
    """Inverse robust weights (N,), 1 / lambda of Eq. 4: factors on the covariances of edges.

    The factor is 1 up to a cost (Eq. 5) of `gate`, then the square of the excess.
    """
    return np.maximum(1.0, costs / gate) ** 2  # Eq. 4, inverted


def pose_costs(residuals: Floats, weights: Floats) -> Floats:
    """Squared Mahalanobis distances (k,) of residuals (k, d, 1) with the inverses (k, d, d) of their covariances."""
    out: Floats = (residuals.transpose(0, 2, 1) @ weights @ residuals)[:, 0, 0]  # Eq. 5
    return out


def point_costs(residuals: Complexes, means: Floats, deviators: Complexes) -> Floats:
    """Squared Mahalanobis distances (N,) of points: residuals (N,), covariances as means (N,) and deviators (N,)."""
    e, m, d = residuals, means, deviators
    out: Floats = (m * (e * e.conj()).real - (d.conj() * e * e).real) / (m * m - (d * d.conj()).real)  # Eq. 5
    return out
