"""Information of an alignment about the length, from the likelihoods at other lengths.

The log likelihood of n residuals of images with correlation c is -n/2 log(1 - c^2). Its loss at a length that is off by
d is modelled as G (1 - exp(-d^2 / 2 w^2)), with the gain G over uncorrelated images; the information is G / w^2, the
minimum over lengths. The Hessian would be wrong for drops, encoder noise and lines along the road.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

OTHER_LENGTHS_LOG = (-0.35, -0.2, 0.2, 0.35)  # log factors on the length, of the compared lengths
_MAX_LOSS_RATIO = 0.99  # of the gain, up to which the width w is observable
_MIN_VARIANCE_RATIO = 1e-6  # minimum unexplained variance


def length_information(fitted: float, others: Sequence[float], samples: float) -> float:
    """Information about the log length, given the other states, from `samples` independent samples.

    `fitted` is the correlation of the images at the fit, `others` at the lengths of OTHER_LENGTHS_LOG. It is 0, or
    negative by chance, if another length is as likely.
    """
    unexplained = float(np.log(min(_unexplained_variance(fitted), 1.0 - _MIN_VARIANCE_RATIO)))
    max_gain, out = -0.5 * samples * unexplained, np.inf
    for off, other in zip(OTHER_LENGTHS_LOG, others, strict=True):
        share = 1.0 - float(np.log(_unexplained_variance(other))) / unexplained
        out = min(out, -2.0 * max_gain * float(np.log1p(-min(share, _MAX_LOSS_RATIO))) / off**2)
    return out


def _unexplained_variance(correlation: float) -> float:
    """Fraction of the variance that a correlation leaves unexplained."""
    return max(1.0 - max(correlation, 0.0) ** 2, _MIN_VARIANCE_RATIO)
