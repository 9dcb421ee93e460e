"""The minimum of Eq. 8: what the factors' edges in the newest frame say is put to what the window knows."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.costs import edge_cost, inflation, pose_cost
from birdslam.graph.factors.factor import Linearised
from birdslam.graph.state_layout import diagonal_blocks
from birdslam.graph.window import Window

_LEAST = 1e-8  # 0.1 mm, 0.1 mrad: edges more exact than that would cost the covariances their digits
_LEFT_OUT = 1e12  # so uncertain an edge says nothing


@functools.cache
def solver() -> tuple[Any, Any]:
    """LAPACK and BLAS, which take 22 MB and a second to load: who solves asks for them at the start, the others
    never."""
    from scipy.linalg import blas, lapack

    return lapack, blas


def minimise(window: Window, terms: Sequence[Linearised], hold: slice | None = None) -> None:
    """The minimum of Eq. 8 over the edges of the newest frame, all at once, linearised at the prediction.

    Notes in each of `terms` which of its edges are outliers. The numbers `hold` of the state keep their mean and
    covariance, and their part in all others' uncertainty: they are considered, not estimated (Schmidt 1966). Where the
    numbers leave all bounds, the window is not finite afterwards.
    """
    if not terms:
        return
    residual: list[float] = []
    for term in terms:
        residual += term.residual  # Eq. 8: F is the sum over all factors
    HP, S = _projected(window.P, terms)
    _add_noise(S, terms)
    lapack, blas = solver()
    L, failed = lapack.dpotrf(S.T, lower=1, overwrite_a=1)
    if failed:  # no numbers of a road: nothing here is a covariance any more, which the caller sees
        window.P[:] = np.nan
        return
    W = blas.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T  # P H' S^-1 H P = W'W
    whitened = blas.dtrsv(L, np.array(residual), lower=1, overwrite_x=1)
    dx = (whitened @ W).tolist()  # Eq. 8: where the sum of the window's own cost and F is least
    held = None if hold is None else window.P[hold, hold].copy()
    window.P -= W.T @ W
    if hold is not None:
        dx[hold] = [0.0] * (hold.stop - hold.start)
        window.P[hold, hold] = held
    window.shift(dx)


def _projected(P: Floats, terms: Sequence[Linearised]) -> tuple[Floats, Floats]:
    """H P and H P H' (what the window does not know of the residuals), H the Jacobians of all terms, one below another.

    Where all their rows are unit vectors, these are rows and columns of P.
    """
    index: list[int] = []
    for term in terms:
        if not isinstance(term.jacobian, list):
            break
        index += term.jacobian
    else:
        HP = P.take(index, axis=0)
        return HP, HP.take(index, axis=1)
    unit = np.eye(len(P))
    H = np.concatenate([unit[term.jacobian] if isinstance(term.jacobian, list) else term.jacobian for term in terms])
    HP = H @ P
    return HP, HP @ H.T


def _add_noise(S: Floats, terms: Sequence[Linearised]) -> None:
    """Adds the edges' covariances to that of their residuals, `S`: of edges past their gate more than their own."""
    placed, first = [], 0
    for term in terms:
        blocks = diagonal_blocks(S, first, term.covs.shape)
        blocks += term.covs
        placed.append((term, blocks))
        first += len(term.residual)
    S.reshape(-1)[:: len(S) + 1] += _LEAST
    for term, blocks in placed:
        if term.gate is not None:
            term.outliers = _inflate(blocks, term, term.gate)


def _inflate(blocks: Floats, term: Linearised, gate: float) -> list[int]:
    """Adds to the covariances (k, d, d) of residuals what edges past `gate` are less sure; which are outliers."""
    d, e = term.covs.shape[1], term.residual
    cost = pose_cost if d == 3 else edge_cost
    distances = [cost(e[d * k : d * k + d], cov) for k, cov in enumerate(blocks.tolist())]
    outliers: list[int] = []
    if max(distances) > gate:
        outliers = [k for k, distance in enumerate(distances) if distance > 4.0 * gate]
        more = inflation(np.array(distances), gate) - 1.0
        more[outliers] = 0.0
        blocks += more[:, None, None] * term.covs
        blocks[outliers] += _LEFT_OUT * np.eye(d)
    return outliers
