"""Fast medians and quantiles for robust estimators."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats


def upper_median(values: Floats) -> float:
    """The upper median of `values` (N,), N >= 1; much faster than numpy.median."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def quantile(values: Floats, fraction: float) -> float:
    """The linearly interpolated quantile of `values` (N,), N >= 1; equals numpy.quantile in a tenth of its time."""
    at = fraction * (len(values) - 1)
    low = int(at)
    high = min(low + 1, len(values) - 1)
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + (ordered[high] - ordered[low]) * (at - low))
