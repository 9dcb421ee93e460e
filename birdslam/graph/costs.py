"""What an edge's residual (Eq. 2), scaled information (Eq. 4) and cost (Eq. 5) are, in the numbers of this package.

Information matrices are given by their inverses, covariances. Poses are complex: a position x + iy and a heading
e^(i yaw). A point's covariance [[m + a, b], [b, m - a]] is its mean m and its deviator d = a + ib: turning by an angle
multiplies d by e^(2i angle), and the inverse is (m, -d) / (m^2 - |d|^2). Edges of vehicles are a dozen a frame, taken
one by one in Python's own numbers; landmarks are hundreds, and arrays.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Ints

Complexes = NDArray[np.complex128]
Rows = Ints
Triple = tuple[float, float, float]
Cov = tuple[float, ...]  # row-major, of (x_m, y_m, yaw_rad)


def binary_residual(measured_at: complex, measured_heading: complex, at: complex, heading: complex) -> Triple:
    """(x_m, y_m, yaw_rad) of a CV or VV edge, in the axes of the source node.

    The measurement T_S_D, and the pose of D in S that the window has, each as place and heading.
    """
    gap = measured_at - at  # Eq. 2: its translation
    return gap.real, gap.imag, cmath.phase(measured_heading * heading.conjugate())  # Eq. 2: its rotation


def rotated(cov: Cov, heading: complex) -> Cov:
    """A covariance in axes that point to `heading`, in the axes that this heading is in."""
    xx, xy, xt, _, yy, yt, _, _, tt = cov
    mean = 0.5 * (xx + yy)
    d = complex(0.5 * (xx - yy), xy) * heading * heading
    t = complex(xt, yt) * heading
    return mean + d.real, d.imag, t.real, d.imag, mean - d.real, t.imag, t.real, t.imag, tt


def inflation(costs: Floats, gate: float) -> Floats:
    """(N,) robust weights, inverted: what multiplies the covariances of edges whose cost (Eq. 5) is past `gate`.

    It is 1 / lambda of Eq. 4, the square of the excess; 1 up to the gate.
    """
    return np.maximum(1.0, costs / gate) ** 2  # Eq. 4, inverted


def pose_cost(residual: Sequence[float], cov: Sequence[Sequence[float]]) -> float:
    """The squared Mahalanobis distance of a residual (3,) with covariance (3, 3), by its Cholesky factors LDL'.

    0 where the matrix is no covariance.
    """
    (xx, _, _), (yx, yy, _), (tx, ty, tt) = cov
    x, y, t = residual
    if xx <= 0.0:
        return 0.0
    to_y, to_t = yx / xx, tx / xx
    yy -= to_y * yx
    ty -= to_t * yx
    if yy <= 0.0:
        return 0.0
    y_to_t = ty / yy
    tt -= to_t * tx + y_to_t * ty
    if tt <= 0.0:
        return 0.0
    y -= to_y * x
    t -= to_t * x + y_to_t * y
    return x * x / xx + y * y / yy + t * t / tt  # Eq. 5


def edge_cost(residual: Sequence[float], cov: Sequence[Sequence[float]]) -> float:
    """The same of an edge of any number of dimensions d: residual (d,), covariance (d, d)."""
    try:
        return float(np.dot(residual, np.linalg.solve(cov, residual)))  # Eq. 5
    except np.linalg.LinAlgError:
        return 0.0


def point_costs(residuals: Complexes, means: Floats, deviators: Complexes) -> Floats:
    """(N,) the same of points: residuals (N,), covariances by their means (N,) and deviators (N,)."""
    e, m, d = residuals, means, deviators
    out: Floats = (m * (e * e.conj()).real - (d.conj() * e * e).real) / (m * m - (d * d.conj()).real)  # Eq. 5
    return out
