"""How much an alignment of the road tells of the length, by how much less likely the images are with other lengths.

The curvature of the likelihood at its maximum does not say so: drops, an encoder's grain and lines along the road
correlate alike at any length. The log likelihood of n normal residuals, of images that correlate by c, is
-n/2 log(1 - c^2). Over a length that is off by d it gains G (1 - exp(-d^2 / 2 w^2)), G being the gain over images that
do not correlate: the information is G / w^2, by the length that leaves the least.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

OTHER_LENGTHS_LOG = (-0.35, -0.2, 0.2, 0.35)  # over which a fit must be likelier
_MAX_SHARE = 0.99  # of the gain, up to which the width of the maximum is observable
_MIN_VARIANCE_RATIO = 1e-6  # of the variance that a correlation leaves


def length_information(fitted: float, others: Sequence[float], samples: float) -> float:
    """Information about the log length, given all else, of `samples` independent ones.

    `fitted` is the images' correlation by the fit, `others` those with the lengths of OTHER_LENGTHS_LOG. Where any is
    as likely it is 0, or less by chance.
    """
    unexplained = float(np.log(min(_left(fitted), 1.0 - _MIN_VARIANCE_RATIO)))
    most, out = -0.5 * samples * unexplained, np.inf
    for off, other in zip(OTHER_LENGTHS_LOG, others, strict=True):
        share = 1.0 - float(np.log(_left(other))) / unexplained
        out = min(out, -2.0 * most * float(np.log1p(-min(share, _MAX_SHARE))) / off**2)
    return out


def _left(correlation: float) -> float:
    """The share of the variance that a correlation leaves unexplained."""
    return max(1.0 - max(correlation, 0.0) ** 2, _MIN_VARIANCE_RATIO)
