"""Eqs. 2-8 of the paper, in its order: what the edges measure, what they weigh, and the cost that is minimised.

What one frame adds to the cost F of Eq. 8 is collected here as a `Cost`, linear in the state of the window (window.py),
which minimises it. Three things are written otherwise than in the paper and mean the same:

- An information matrix Omega is given by its inverse, the covariance.
- The poses of the window are relative to the newest ego pose, so that (T_S^W)^-1 T_D^W of Eq. 2 is one of them. A
  residual is the measurement minus the state, in the axes of the source node S; covariances are turned to these axes.
- Poses are complex: a position x + iy and a heading e^(i yaw) (geometry/planar.py). A point's covariance
  [[m + a, b], [b, m - a]] is its mean m and its deviator d = a + ib: turning by an angle multiplies d by
  e^(2i angle), and the inverse is (m, -d) / (m^2 - |d|^2). That halves the numpy calls of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.planar import Complexes, Floats, advance, pairs, turned, unit
from birdslam.geometry.se2 import SE2

Rows = NDArray[np.int64]


@dataclass(slots=True)
class CvEdges:
    """The CV edges of the newest frame to vehicles that the window has."""

    rows: Rows  # (k,) the vehicles, by their row in the window
    poses: Floats  # (k, 3) T_ego_vehicle
    covs: Floats  # (k, 3, 3) in the axes of the measured pose


@dataclass(slots=True)
class VvEdges:
    """The VV edges from the newest poses of vehicles in the window to the newest frame."""

    rows: Rows  # (v,) the vehicles, by their row in the window
    dt_s: Floats  # (v,) the interval that the edge spans
    motions: Floats  # (v, 3) T_from_to
    covs: Floats  # (v, 3, 3) in the axes of the measured pose


NO_VV = VvEdges(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(slots=True)
class CpEdge:
    """All CP edges of a frame as one (Eq. 7)."""

    residual: Floats  # (2,) metres in ego: by how much the ego node lies further on than the window has it
    cov: Floats  # (2, 2)
    place: Rows  # (2,) which numbers of the state are the place of that node


@dataclass(slots=True)
class Cost:
    """A sum of F^s (Eq. 5) over edges that each measure numbers of the state: residual = measured - state[index]."""

    index: Rows  # (n,) which numbers of the state
    residual: Floats  # (n,)
    covs: Floats  # (n / 3, 3, 3), the inverses of the edges' information matrices
    cp_cov: Floats | None = None  # (2, 2) of the last two rows, where CP edges are in the sum


# --- Eq. 2: binary edges (CC, CV, VV) ---


def chained(T_world_from: SE2, T_from_to: SE2) -> SE2:
    """T_world_to where the residual of a CC edge (Eq. 2) is the identity: nothing else is known of a new pose yet."""
    return T_world_from @ T_from_to  # Eq. 2


def binary_residual(measured: Floats, headings: Complexes, at: Complexes, heading: Complexes) -> Floats:
    """(3N,) residuals (x_m, y_m, yaw_rad) of N CV or VV edges, in the axes of the source node.

    `measured` (N, 3) are the measurements T_S_D and `headings` (N,) their headings; `at` and `heading` (N,) are the
    poses of D in S that the window has.
    """
    out = np.empty(3 * len(at))
    gap = measured[:, 0] + 1j * measured[:, 1] - at  # Eq. 2: its translation
    out[0::3] = gap.real
    out[1::3] = gap.imag
    turn = headings * heading.conj()  # Eq. 2: its rotation
    np.arctan2(turn.imag, turn.real, out=out[2::3])
    return out


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


def pose_costs(residuals: Floats, covs: Floats) -> Floats:
    """(N,) squared Mahalanobis distances of residuals (3N,) with covariances (N, 3, 3)."""
    e = residuals.reshape(-1, 3, 1)
    out: Floats = (e * np.linalg.solve(covs, e)).reshape(-1, 3).sum(axis=1)  # Eq. 5
    return out


def point_costs(residuals: Complexes, means: Floats, deviators: Complexes) -> Floats:
    """(N,) the same of points: residuals (N,), covariances by their means (N,) and deviators (N,)."""
    e, m, d = residuals, means, deviators
    out: Floats = (m * (e * e.conj()).real - (d.conj() * e * e).real) / (m * m - (d * d.conj()).real)  # Eq. 5
    return out


# --- Eq. 6: the cost of what moves ---


def cv_cost(edges: CvEdges, headings: Complexes, states: Rows, at: Complexes, heading: Complexes) -> Cost:
    """CV, with the measured `headings` (k,), of vehicles that stand `at` with `heading` (k,).

    Their poses are the numbers `states` (k, 3) of the state.
    """
    residual = binary_residual(edges.poses, headings, at, heading)
    return Cost(states.ravel(), residual, turned(edges.covs, headings))


def vv_cost(edges: VvEdges, states: Rows, velocity: Complexes, turn_radps: Floats) -> Cost:
    """VV, of vehicles whose twists (v,) are the numbers `states` (v, 3) of the state."""
    v = len(edges.rows)
    way, heading, partial = advance(np.ones(v, np.complex128), velocity, turn_radps, edges.dt_s)
    headings = unit(edges.motions[:, 2])
    H = np.zeros((v, 3, 3))  # how an error of the twist moves the end of the way
    H[:, :2] = pairs(partial)[:, :, 3:]
    H[:, 2, 2] = edges.dt_s
    back = np.linalg.inv(H)
    residual = back @ binary_residual(edges.motions, headings, way, heading).reshape(v, 3, 1)
    covs = back @ turned(edges.covs, headings) @ back.transpose(0, 2, 1)
    return Cost(states.ravel(), residual.ravel(), covs)


def dynamic_cost(cv: Cost, vv: Cost | None) -> Cost:
    """F_D of this frame: its CV and VV edges.

    Of the other terms of Eq. 6, CC has moved the window on to this frame (`chained`), and the CV edges of earlier
    frames are in what the window knows.
    """
    if vv is None:
        return cv
    index, residual = np.concatenate([cv.index, vv.index]), np.concatenate([cv.residual, vv.residual])
    return Cost(index, residual, np.concatenate([cv.covs, vv.covs]))  # Eq. 6


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
    """F = F_D + F_S."""
    if static is None:
        return dynamic
    index, residual = np.concatenate([dynamic.index, static.place]), np.concatenate([dynamic.residual, static.residual])
    return Cost(index, residual, dynamic.covs, static.cov)  # Eq. 8
