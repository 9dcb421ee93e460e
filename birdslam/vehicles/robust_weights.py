"""Measurements that contradict all the others are believed less (Huber), in the innovations of a Kalman filter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def information(S: Floats, innovation: Floats, cues: int, gate_sigma: float) -> Floats:
    """The inverse of the innovations' covariance S (M, M), with each box's worst cue trusted less where it misfits.

    Innovations (M,) stand cue by cue, of all boxes each. What all the others say of one differs from it by
    (S^-1 v)_i / (S^-1)_ii, with the variance 1 / (S^-1)_ii.
    """
    whole = np.asarray(np.linalg.inv(S), dtype=np.float64)
    of_each = np.diag(whole)
    misfit = np.abs(whole @ innovation) / np.sqrt(of_each)
    by_box = misfit.reshape(cues, -1)
    n = by_box.shape[1]
    worst = by_box.argmax(axis=0) * n + np.arange(n)
    worst = worst[misfit[worst] > gate_sigma]
    if not len(worst):
        return whole
    # Woodbury: noise added to a few measurements
    more = ((misfit[worst] / gate_sigma) ** 4 - 1.0) / of_each[worst]
    columns = whole[:, worst]
    inner = np.diag(1.0 / more) + columns[worst]
    out: Floats = whole - columns @ np.linalg.solve(inner, columns.T)
    return out
