"""Kalman update by boxes, of which one side may be an outlier.

Each box is one of three cases: no outlier, left, or right. An outlier has rank-one noise u u' on width and bearing; by
Sherman-Morrison (S + u u')^-1 = S^-1 - S^-1 u u' S^-1 / (1 + u' S^-1 u), det(S + u u') = det(S) (1 + u' S^-1 u). The
posterior mixture is approximated by one normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MIN_PROBABILITY = 1e-300


@dataclass(frozen=True)
class SideUpdate:
    """For N boxes and F filters with D states: `step` (N, F, D) of the mean, `cov` (N, F, D, D) after the update.

    `log_likelihood` (N, F) without a constant; `outlier` (2, N, F): probabilities that the left, the right is an
    outlier.
    """

    step: Floats
    cov: Floats
    log_likelihood: Floats
    outlier: Floats


def update_with_side_outliers(
    P: Floats, PJt: Floats, S: Floats, innovation: Floats, shift: Floats, share: Floats
) -> SideUpdate:
    """Updates from P (N, F, D, D), P J' (N, F, D, M) and innovations (N, F, M) with their covariance S.

    `shift` (2, N, F, M) is the 1-sigma effect of an outlier of the left, the right side on the measurements. `share`
    (2, N) is its prior probability.
    """
    information = np.linalg.inv(S)
    weighted = (information @ innovation[..., None])[..., 0]
    plain = -0.5 * ((innovation * weighted).sum(axis=-1) + np.log(np.linalg.det(S)))

    of_shift = np.einsum("nfab,snfb->snfa", information, shift)  # S^-1 u
    grown = 1.0 + np.einsum("snfa,snfa->snf", shift, of_shift)  # 1 + u' S^-1 u
    along = np.einsum("snfa,nfa->snf", of_shift, innovation)
    log_prior = np.log(np.maximum(np.concatenate([1.0 - share.sum(axis=0, keepdims=True), share]), _MIN_PROBABILITY))
    cases = np.concatenate([plain[None], plain - 0.5 * (np.log(grown) - np.square(along) / grown)])
    cases += log_prior[..., None]
    likeliest = cases.max(axis=0)
    probability = np.exp(cases - likeliest)
    total = probability.sum(axis=0)
    outlier = probability[1:] / total

    gain_shift = np.moveaxis((PJt @ of_shift[..., None])[..., 0], 0, -1)  # (N, F, D, 2)
    outlier_last, pulled = np.moveaxis(outlier, 0, -1), np.moveaxis(along / grown, 0, -1)
    # Relative to the update without outliers, each case steps by -pulled gain_shift, with cov + gain_shift^2 / grown
    step = -(gain_shift @ (outlier_last * pulled)[..., None])[..., 0]
    spread = outlier_last * (np.square(pulled) + 1.0 / np.moveaxis(grown, 0, -1))
    cov = P - PJt @ information @ PJt.swapaxes(-1, -2)
    cov += (gain_shift * spread[..., None, :]) @ gain_shift.swapaxes(-1, -2) - step[..., :, None] * step[..., None, :]
    return SideUpdate(
        step=(PJt @ weighted[..., None])[..., 0] + step,
        cov=(cov + cov.swapaxes(-1, -2)) / 2.0,
        log_likelihood=likeliest + np.log(total),
        outlier=outlier,
    )
