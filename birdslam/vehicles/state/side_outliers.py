"""A Kalman update by boxes, any of which may have one side that is an outlier.

Detectors end a box where a tree or a wall hides the rest of a vehicle, or draw it around two. So each box comes of one
of three cases: no side is an outlier, the left, or the right. An outlier moves width and bearing together, so that its
noise is of rank one, u u'; by Sherman and Morrison (S + u u')^-1 = S^-1 - S^-1 u u' S^-1 / (1 + u' S^-1 u), and
det(S + u u') = det(S) (1 + u' S^-1 u). The mixture of the three becomes one normal distribution again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MIN_PROBABILITY = 1e-300


@dataclass(frozen=True)
class SideUpdate:
    """Of N boxes and F filters with D states each: `step` (N, F, D) to the mean, `cov` (N, F, D, D) after it.

    `log_likelihood` (N, F) less a constant; `outlier` (2, N, F): the probabilities that the left, the right is one.
    """

    step: Floats
    cov: Floats
    log_likelihood: Floats
    outlier: Floats


def update_with_side_outliers(
    P: Floats, PJt: Floats, S: Floats, innovation: Floats, shift: Floats, share: Floats
) -> SideUpdate:
    """From P (N, F, D, D), P J' (N, F, D, M), and the innovations (N, F, M) of boxes without outliers with their cov S.

    `shift` (2, N, F, M): by how much an outlier of the left, the right side moves the measurements, 1-sigma.
    `share` (2, N): the probabilities beforehand that the left, the right is an outlier.
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
    # Each case steps by -pulled gain_off beside the step without outliers, and is less certain by gain_off^2 / grown
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
