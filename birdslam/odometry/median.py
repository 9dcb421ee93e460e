"""The median of residuals, from which robust estimates take their scale, and other quantiles."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats


def upper_median(values: Floats) -> float:
    """The median of `values` (N,), N >= 1, of an even number the upper one; numpy.median takes many times as long."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def quantile(values: Floats, share: float) -> float:
    """Of `values` (N,), N >= 1, between the two nearest by their distance, as numpy.quantile in a tenth of its time."""
    at = share * (len(values) - 1)
    low = int(at)
    high = min(low + 1, len(values) - 1)
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + (ordered[high] - ordered[low]) * (at - low))
