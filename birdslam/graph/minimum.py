"""The minimum of Eq. 8: what the edges of the newest frame say is put to what the window knows."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from birdslam.graph.factors import (
    Cost,
    CpEdge,
    CvEdge,
    Floats,
    VvEdge,
    collective_cost,
    dynamic_cost,
    inflation,
    pose_cost,
)
from birdslam.graph.state_layout import EGO, diagonal_blocks
from birdslam.graph.window import Window

_LEAST = 1e-8  # 0.1 mm, 0.1 mrad: edges more exact than that would cost the covariances their digits
_LEFT_OUT = 1e12  # so uncertain an edge says nothing


@functools.cache
def solver() -> tuple[Any, Any]:
    """LAPACK and BLAS, which take 22 MB and a second to load: who solves asks for them at the start, the others
    never."""
    from scipy.linalg import blas, lapack

    return lapack, blas


def minimise(
    window: Window,
    cv: Sequence[CvEdge],
    vv: Sequence[VvEdge],
    cp: CpEdge | None,
    gate: float,
    hold: bool = False,
    ends_alike: bool = True,
) -> list[int]:
    """The minimum of Eq. 8 over the edges of the newest frame, all at once, linearised at the prediction.

    A CV edge whose squared Mahalanobis distance is past `gate` has its covariance multiplied by the square of the
    excess; past four times `gate` it is an outlier and left out. `hold` keeps the ego where it is (standstill).
    `ends_alike`: a CV edge may take the front of a vehicle for its back.
    Returns which CV edges are outliers. Where the numbers leave all bounds, the window is not finite afterwards.
    """
    if not cv and not vv and cp is None:
        return []
    if ends_alike:
        opposed = [e.row for e in cv if (e.heading * window.heading[window.nodes + e.row].conjugate()).real < 0.0]
        if opposed:
            window.turn_about(opposed)
    cost = _cost(window, cv, vv, cp)
    HP = window.P.take(cost.index, axis=0)
    S = HP.take(cost.index, axis=1)  # of the residuals: what the window does not know, and the edges' own noise
    outliers = _add_noise(S, cost, len(cv), gate)
    lapack, blas = solver()
    L, failed = lapack.dpotrf(S.T, lower=1, overwrite_a=1)
    if failed:  # no numbers of a road: nothing here is a covariance any more, which the caller sees
        window.P[:] = np.nan
        return outliers
    W = blas.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T  # P H' S^-1 H P = W'W
    whitened = blas.dtrsv(L, np.array(cost.residual), lower=1, overwrite_x=1)
    dx = (whitened @ W).tolist()  # Eq. 8: where the sum of the window's own cost and F is least
    held = window.ego_cov.copy() if hold else None
    window.P -= W.T @ W
    if held is not None:
        dx[EGO] = 0.0, 0.0, 0.0
        window.P[EGO, EGO] = held
    window.shift(dx)
    return outliers


def _cost(window: Window, cv: Sequence[CvEdge], vv: Sequence[VvEdge], cp: CpEdge | None) -> Cost:
    """F of Eq. 8 as far as it is of this frame."""
    firsts, at, heading = window.layout.firsts, window.at[window.nodes :], window.heading[window.nodes :]
    seen = [(e, firsts[e.row], at[e.row], heading[e.row]) for e in cv]
    moved = [(e, firsts[e.row] + 3, window.velocity[e.row], window.turn_radps[e.row]) for e in vv]
    return collective_cost(dynamic_cost(seen, moved), cp)


def _add_noise(S: Floats, cost: Cost, cv_edges: int, gate: float) -> list[int]:
    """Adds the edges' covariances to that of their residuals, `S`: of CV edges past `gate` more than their own.

    The first `cv_edges` of the blocks are CV. Returns which of them are outliers.
    """
    covs = np.fromiter(cost.covs, np.float64, len(cost.covs)).reshape(-1, 3, 3)
    blocks = diagonal_blocks(S, len(covs))
    blocks += covs
    if cost.cp_cov is not None:
        S[-2:, -2:] += cost.cp_cov
    S.reshape(-1)[:: len(S) + 1] += _LEAST
    e = cost.residual
    distances = [pose_cost(e[3 * k : 3 * k + 3], cov) for k, cov in enumerate(blocks[:cv_edges].tolist())]
    outliers: list[int] = []
    if distances and max(distances) > gate:
        outliers = [k for k, distance in enumerate(distances) if distance > 4.0 * gate]
        more = inflation(np.array(distances), gate) - 1.0
        more[outliers] = 0.0
        blocks[:cv_edges] += more[:, None, None] * covs[:cv_edges]
        blocks[outliers] += _LEFT_OUT * np.eye(3)
    return outliers
