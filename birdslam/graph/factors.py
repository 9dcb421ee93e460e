"""Eqs. 2-8 of the paper, in its order: what the edges measure, what they weigh, and the cost that is minimised.

What one frame adds to the cost F of Eq. 8 is collected here as a `Cost`, linear in the state of the window (window.py),
which minimum.py minimises. Three things are written otherwise than in the paper and mean the same:

- An information matrix Omega is given by its inverse, the covariance.
- The poses of the window are relative to the newest ego pose, so that (T_S^W)^-1 T_D^W of Eq. 2 is one of them. A
  residual is the measurement minus the state, in the axes of the source node S; covariances are turned to these axes.
- Poses are complex: a position x + iy and a heading e^(i yaw). A point's covariance [[m + a, b], [b, m - a]] is its
  mean m and its deviator d = a + ib: turning by an angle multiplies d by e^(2i angle), and the inverse is
  (m, -d) / (m^2 - |d|^2).

Edges of vehicles are a dozen a frame, taken one by one in Python's own numbers; landmarks are hundreds, and arrays.
"""

from __future__ import annotations

import cmath
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.constant_twist import advance
from birdslam.geometry.se2 import SE2

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Rows = NDArray[np.int64]
Triple = tuple[float, float, float]
Cov = tuple[float, ...]  # row-major, of (x_m, y_m, yaw_rad)


class CvEdge(NamedTuple):
    """A CV edge of the newest frame to a vehicle that the window has."""

    row: int  # of the vehicle in the window
    at: complex  # the measured place, in ego
    heading: complex
    cov: Cov  # in ego


class VvEdge(NamedTuple):
    """A VV edge from the newest pose of a vehicle in the window to the newest frame."""

    row: int  # of the vehicle in the window
    dt_s: float  # the interval that the edge spans
    motion: SE2  # T_from_to
    cov: Cov  # in the axes of the measured pose


@dataclass(slots=True)
class CpEdge:
    """All CP edges of a frame as one (Eq. 7)."""

    residual: tuple[float, float]  # metres in ego: by how much the ego node lies further on than the window has it
    cov: Floats  # (2, 2)
    place: list[int]  # (2,) which numbers of the state are the place of that node


@dataclass(slots=True)
class Cost:
    """A sum of F^s (Eq. 5) over edges that each measure numbers of the state: residual = measured - state[index]."""

    index: list[int] = field(default_factory=list)  # (n,) which numbers of the state
    residual: list[float] = field(default_factory=list)  # (n,)
    covs: list[float] = field(default_factory=list)  # (3 n,), row-major: inverses of the edges' information matrices
    cp_cov: Floats | None = None  # (2, 2) of the last two rows, where CP edges are in the sum


# --- Eq. 2: binary edges (CC, CV, VV) ---


def chained(T_world_from: SE2, T_from_to: SE2) -> SE2:
    """T_world_to where the residual of a CC edge (Eq. 2) is the identity: nothing else is known of a new pose yet."""
    return T_world_from @ T_from_to  # Eq. 2


def binary_residual(measured_at: complex, measured_heading: complex, at: complex, heading: complex) -> Triple:
    """(x_m, y_m, yaw_rad) of a CV or VV edge, in the axes of the source node.

    The measurement T_S_D, and the pose of D in S that the window has, each as place and heading.
    """
    gap = measured_at - at  # Eq. 2: its translation
    return gap.real, gap.imag, cmath.phase(measured_heading * heading.conjugate())  # Eq. 2: its rotation


def turned(cov: Cov, heading: complex) -> Cov:
    """A covariance in axes that point to `heading`, told outside."""
    xx, xy, xt, _, yy, yt, _, _, tt = cov
    mean = 0.5 * (xx + yy)
    d = complex(0.5 * (xx - yy), xy) * heading * heading
    t = complex(xt, yt) * heading
    return mean + d.real, d.imag, t.real, d.imag, mean - d.real, t.imag, t.real, t.imag, tt


# --- Eq. 3: unary edges (CP) ---


def landmark_residual(points: Complexes, node: complex, heading: complex, tied: Complexes) -> Complexes:
    """(N,) how much further on, in ego, each landmark says that an ego node is.

    `points` (N,) are where the landmarks are, in ego, `tied` (N,) the same landmarks as that node saw them, which
    stands at `node` with `heading` in ego.
    """
    return points - node - heading * tied  # Eq. 3


# --- Eq. 4: effective information ---


def effective_cov(weight: float, dimensions: int) -> tuple[float, ...]:
    """Row-major covariance of an edge whose information matrix is `weight` (lambda) times the unit matrix."""
    variance = 1.0 / weight  # Eq. 4, inverted
    return tuple(variance if i == j else 0.0 for i in range(dimensions) for j in range(dimensions))


def inflation(costs: Floats, gate: float) -> Floats:
    """(N,) robust weights, inverted: what multiplies the covariances of edges whose cost (Eq. 5) is past `gate`.

    It is 1 / lambda of Eq. 4, the square of the excess; 1 up to the gate.
    """
    return np.maximum(1.0, costs / gate) ** 2  # Eq. 4, inverted


# --- Eq. 5: the cost of an edge ---


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


def point_costs(residuals: Complexes, means: Floats, deviators: Complexes) -> Floats:
    """(N,) the same of points: residuals (N,), covariances by their means (N,) and deviators (N,)."""
    e, m, d = residuals, means, deviators
    out: Floats = (m * (e * e.conj()).real - (d.conj() * e * e).real) / (m * m - (d * d.conj()).real)  # Eq. 5
    return out


# --- Eq. 6: the cost of what moves ---


def dynamic_cost(
    cv: Iterable[tuple[CvEdge, int, complex, complex]], vv: Iterable[tuple[VvEdge, int, complex, float]]
) -> Cost:
    """F_D of this frame: its CV and VV edges.

    With each CV edge come the first of the three numbers of the state that are the vehicle's pose, its place and its
    heading; with each VV edge the first of the three that are its twist, its velocity and its yaw rate. Of the other
    terms of Eq. 6, CC has moved the window on to this frame (`chained`), and the CV edges of earlier frames are in what
    the window knows.
    """
    cost = Cost()
    for seen, first, at, heading in cv:
        cost.index += (first, first + 1, first + 2)
        cost.residual += binary_residual(seen.at, seen.heading, at, heading)
        cost.covs += seen.cov
    for moved, first, velocity, turn_radps in vv:
        residual, cov = _as_twist(moved, velocity, turn_radps)
        cost.index += (first, first + 1, first + 2)
        cost.residual += residual
        cost.covs += cov
    return cost  # Eq. 6


def _as_twist(edge: VvEdge, velocity: complex, turn_radps: float) -> tuple[list[float], list[float]]:
    """What a VV edge says of the twist that the window has: residual (3,) and covariance (9,)."""
    way, heading, by_velocity, by_turn = advance(1.0 + 0.0j, velocity, turn_radps, edge.dt_s)
    T = edge.motion
    measured = cmath.rect(1.0, T.yaw_rad)
    g, d = by_velocity, by_turn
    back = np.linalg.inv([[g.real, -g.imag, d.real], [g.imag, g.real, d.imag], [0.0, 0.0, edge.dt_s]])
    residual = back @ binary_residual(complex(T.x_m, T.y_m), measured, way, heading)
    cov = back @ np.reshape(turned(edge.cov, measured), (3, 3)) @ back.T
    return residual.tolist(), cov.ravel().tolist()


# --- Eq. 7: the cost of what stands ---


def sum_of_points(residuals: Complexes, means: Floats, deviators: Complexes) -> tuple[complex, float, complex]:
    """N >= 1 unary edges on one translation as one: their centroid weighted by information, and its covariance.

    Exact: the sum over p of the costs of t - residual_p, and the cost of t - centroid, differ by a constant in t.
    """
    det = means * means - (deviators * deviators.conj()).real
    information, deviation = means / det, -deviators / det
    moment = complex((information * residuals + deviation * residuals.conj()).sum())  # Eq. 7, and its two sums below
    m, d = float(information.sum()), complex(deviation.sum())
    det_sum = m * m - abs(d) ** 2
    return (m * moment - d * moment.conjugate()) / det_sum, m / det_sum, -d / det_sum


# --- Eq. 8: the cost of a frame ---


def collective_cost(dynamic: Cost, static: CpEdge | None) -> Cost:
    """F = F_D + F_S, in place of F_D."""
    if static is not None:
        dynamic.index += static.place
        dynamic.residual += static.residual
        dynamic.cp_cov = static.cov
    return dynamic  # Eq. 8
