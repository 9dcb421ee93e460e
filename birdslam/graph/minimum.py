"""The minimum of Eq. 8: corrects the window by the linearized factors of the newest frame."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.costs import inflation, pose_costs
from birdslam.graph.factors.factor import Linearised
from birdslam.graph.state_layout import EGO, LASTING, OF_VEHICLE, StateLayout, diagonal_blocks
from birdslam.graph.window import Window

_MIN_VARIANCE = 1e-8  # (0.1 mm)^2, (0.1 mrad)^2: keeps the innovation covariance well-conditioned
_LEFT_OUT = 1e12  # variance of an edge that is left out
# Cofactors of a symmetric (3, 3), row-major: a b - c d of the entries with these indices
_COFACTORS = np.array(
    [[4, 2, 1, 2, 0, 1, 1, 1, 0], [8, 5, 5, 5, 8, 2, 5, 2, 4], [5, 1, 2, 1, 2, 0, 2, 0, 1], [5, 8, 4, 8, 2, 5, 4, 5, 1]]
)


@functools.cache
def solver() -> tuple[Any, Any]:
    """Returns LAPACK and BLAS. They take 22 MB and a second to load, and only `_all_at_once` needs them."""
    from scipy.linalg import blas, lapack

    return lapack, blas


def minimise(window: Window, of_vehicles: Sequence[Linearised], terms: Sequence[Linearised], hold_ego: bool) -> None:
    """Minimizes Eq. 8 over the edges of the newest frame, linearized at the prediction.

    The edges `of_vehicles` do not correct the ego poses; with `hold_ego` the other `terms` do not correct the newest
    one; lasting errors are never corrected. These states keep their mean and covariance, but their uncertainty counts
    in all others: they are considered, not estimated (Schmidt 1966). Sets the `outliers` of each term. If a covariance
    is not positive definite, the window is not finite afterwards.
    """
    try:
        if window.together:
            _all_at_once(window, of_vehicles, window.layout.ego_poses)
            _all_at_once(window, terms, EGO if hold_ego else slice(0))
            return
        moved = np.zeros((len(window.velocity), OF_VEHICLE)) if len(of_vehicles) > 1 else None
        for term in of_vehicles:
            _each_vehicle(window, term, moved)
        _egos(window, terms, EGO if hold_ego else None)
    except np.linalg.LinAlgError:  # some matrix is no covariance
        window.of_egos[:] = np.nan


def _each_vehicle(window: Window, term: Linearised, moved: Floats | None) -> None:
    """Applies edges of single, unconnected vehicles: k systems of d equations instead of one of k d.

    `moved` (M, 8) is the sum of the corrections of each vehicle by earlier terms since the linearization; None if there
    is no other term.
    """
    if term.vehicles is None:
        raise ValueError("edges that leave the ego where it is are of single vehicles: `Linearised.vehicles`")
    rows: list[int] | slice = term.vehicles
    if rows == [*range(len(window.velocity))]:
        rows = slice(None)  # avoids a copy
    J, (k, d, _) = term.jacobian, term.covs.shape
    V, C, residual = window.of_vehicles[rows], window.with_egos[rows], np.reshape(term.residual, (k, d, 1))
    if isinstance(J, list):
        HV, HC = V.take(J, axis=1), C.take(J, axis=1)
        S = HV.take(J, axis=2)
        if moved is not None:
            residual = residual - moved[rows].take(J, axis=1)[:, :, None]
    else:
        HV, HC = J @ V, J @ C
        if moved is not None:
            residual = residual - J @ moved[rows][:, :, None]
        S = HV @ J.transpose(0, 2, 1)
    S += term.covs
    S.reshape(k, d * d)[:, :: d + 1] += _MIN_VARIANCE
    weights = _inverses(S)
    weighted = weights @ residual
    if term.gate is not None and _inflate(S, term, term.gate, (residual * weighted)[:, :, 0].sum(axis=1)):  # Eq. 5
        weights = _inverses(S)
        weighted = weights @ residual
    gain = HV.transpose(0, 2, 1) @ weights  # P H' S^-1
    gain[:, LASTING] = 0.0
    dx = (HV.transpose(0, 2, 1) @ weighted)[:, :, 0]  # Eq. 8: where the sum of the window's own cost and F is least
    dx[:, LASTING] = 0.0
    corrected = V - gain @ HV
    corrected[:, LASTING] = corrected[:, :, LASTING].transpose(0, 2, 1)
    window.of_vehicles[rows] = corrected
    window.with_egos[rows] -= gain @ HC
    window.shift_vehicles(rows, dx)
    if moved is not None:
        moved[rows] += dx


def _egos(window: Window, terms: Sequence[Linearised], hold: slice | None) -> None:
    """Applies edges of the ego poses; correlated states are corrected with them."""
    if not terms:
        return
    E, B = window.layout.ego_poses.stop, len(window.of_vehicles)
    H = _jacobian(terms, window.layout)
    C = window.with_egos.reshape(-1, E).T
    if isinstance(H, list):
        HP, HC = window.of_egos.take(H, axis=0), C.take(H, axis=0)
        S = HP.take(H, axis=1)
    else:
        if H[:, E:].any():
            raise ValueError("edges that tie the ego to vehicles need `Factor.ties_vehicles`")
        H = H[:, :E]
        HP, HC = H @ window.of_egos, H @ C
        S = HP @ H.T
    _add_noise(S, terms)
    known = np.concatenate([HP, HC, _residual(terms)[:, None]], axis=1)
    W = np.linalg.solve(np.linalg.cholesky(S), known)  # P H' S^-1 H P = W'W
    of_egos, of_vehicles, whitened_residual = W[:, :E], W[:, E:-1], W[:, -1]
    dx, held = whitened_residual @ of_egos, None if hold is None else window.of_egos[hold, hold].copy()
    window.of_egos -= of_egos.T @ of_egos
    if hold is not None:
        dx[hold] = 0.0
        window.of_egos[hold, hold] = held
    window.shift_egos(dx)  # Eq. 8, as above
    if B and of_vehicles.size:
        window.with_egos -= (of_vehicles.T @ of_egos).reshape(window.with_egos.shape)
        blocks = of_vehicles.T.reshape(B, -1, len(W))
        window.of_vehicles -= blocks @ blocks.transpose(0, 2, 1)
        window.shift_vehicles(slice(None), (whitened_residual @ of_vehicles).reshape(-1, OF_VEHICLE))


def _all_at_once(window: Window, terms: Sequence[Linearised], hold: slice) -> None:
    """Applies edges of any part of the state, with P as one matrix."""
    if not terms:
        return
    P, H = window.P, _jacobian(terms, window.layout)
    if isinstance(H, list):  # all rows are unit vectors: rows and columns of P
        HP = P.take(H, axis=0)
        S = HP.take(H, axis=1)
    else:
        HP = H @ P
        S = HP @ H.T
    _add_noise(S, terms)
    lapack, blas = solver()
    L, failed = lapack.dpotrf(S.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError
    W = blas.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T  # P H' S^-1 H P = W'W
    dx = blas.dtrsv(L, _residual(terms), lower=1, overwrite_x=1) @ W  # Eq. 8, as above
    held = [*range(hold.stop), *window.layout.of_vehicles[:, LASTING].ravel().tolist()]
    of_held = P[np.ix_(held, held)]
    P -= W.T @ W
    dx[held] = 0.0
    P[np.ix_(held, held)] = of_held
    window.set_P(P)
    window.shift(dx)


def _residual(terms: Sequence[Linearised]) -> Floats:
    """Eq. 8: F is the sum over all factors."""
    return np.concatenate([np.reshape(term.residual, -1) for term in terms])


def _jacobian(terms: Sequence[Linearised], layout: StateLayout) -> list[int] | Floats:
    """Returns the stacked Jacobian (m, n) of all terms; or, if all rows are unit vectors, their indices."""
    units = [_units(term.jacobian, term, layout) for term in terms if isinstance(term.jacobian, list)]
    if len(units) == len(terms):
        return [i for of_term in units for i in of_term]
    unit, rows = np.eye(layout.size), []
    for term in terms:
        J = term.jacobian
        if isinstance(J, list):
            rows.append(unit[_units(J, term, layout)])
        elif term.vehicles is None:
            rows.append(np.pad(J, ((0, 0), (0, layout.size - J.shape[1]))))
        else:
            each = np.zeros((*J.shape[:2], layout.size))
            for k, row in enumerate(term.vehicles):
                each[k][:, layout.of_vehicles[row]] = J[k]
            rows.append(each.reshape(-1, layout.size))
    return np.concatenate(rows)


def _units(numbers: list[int], term: Linearised, layout: StateLayout) -> list[int]:
    """Returns the state indices of the indices of a term."""
    if term.vehicles is None:
        return numbers
    of_each: list[int] = layout.of_vehicles[term.vehicles][:, numbers].ravel().tolist()
    return of_each


def _add_noise(S: Floats, terms: Sequence[Linearised]) -> None:
    """Adds the covariances of the edges to `S`, the covariance of their residuals; inflated beyond their gate."""
    placed, first = [], 0
    for term in terms:
        blocks = diagonal_blocks(S, first, term.covs.shape)
        blocks += term.covs
        placed.append((term, blocks))
        first += len(blocks) * blocks.shape[1]
    S.reshape(-1)[:: len(S) + 1] += _MIN_VARIANCE
    for term, blocks in placed:
        if term.gate is not None:
            residual = np.reshape(term.residual, (*blocks.shape[:2], 1))
            _inflate(blocks, term, term.gate, pose_costs(residual, _inverses(blocks)))


def _inverses(covs: Floats) -> Floats:
    """Returns the inverses of (k, d, d). Raises np.linalg.LinAlgError if one is not positive definite."""
    d = covs.shape[1]
    if d != 3:
        np.linalg.cholesky(covs)
        return np.asarray(np.linalg.inv(covs), np.float64)
    C = covs.reshape(-1, 9)  # the general solution takes as long as the rest of the correction
    cofactors = C.take(_COFACTORS[0], axis=1) * C.take(_COFACTORS[1], axis=1)
    cofactors -= C.take(_COFACTORS[2], axis=1) * C.take(_COFACTORS[3], axis=1)
    det = (C[:, :3] * cofactors[:, :3]).sum(axis=1)
    if not np.minimum(np.minimum(C[:, 0], cofactors[:, 8]), det).min() > 0.0:  # Sylvester: the leading minors
        raise np.linalg.LinAlgError
    return (cofactors / det[:, None]).reshape(-1, 3, 3)


def _inflate(blocks: Floats, term: Linearised, gate: float, distances: Floats) -> bool:
    """Inflates the covariances (k, d, d) of residuals for edges beyond `gate`, and sets the outliers of the term.

    Returns whether any edge is beyond the gate.
    """
    term.outliers = []
    if distances.max() <= gate:
        return False
    outliers = np.flatnonzero(distances > 4.0 * gate).tolist()
    more = inflation(distances, gate) - 1.0
    more[outliers] = 0.0
    blocks += more[:, None, None] * term.covs
    blocks[outliers] += _LEFT_OUT * np.eye(blocks.shape[1])
    term.outliers = outliers
    return True
