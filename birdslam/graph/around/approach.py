"""Who may come near: the closest approach of road users to the ego, were all to go on as they move now.

An aid for planners and no safety function: nobody's intention is in it, and nobody who was not detected.
With p and v the place and velocity of somebody against the ego's, t = -p.v / v.v and d = |p + v t|; their sigmas come
from the covariances of p and v to first order.
"""

from __future__ import annotations

import numpy as np

from birdslam.graph.costs import Floats
from birdslam.types import Approach

HORIZON_S = 30.0  # a later approach is told as it would be then
NEARBY_S, NEARBY_M, NEARBY_SIGMA = 5.0, 2.0, 2.0
SLOWEST_MPS2 = 0.01  # a squared velocity below it is none
MOST = 1e9  # of any number that is told


def approaches(p: Floats, v: Floats, p_cov: Floats, v_cov: Floats) -> list[Approach]:
    """Of N road users, p and v (N, 2) against the ego's, in m and m/s, with covariances (N, 2, 2), all in one frame."""
    if not len(p):
        return []
    square = np.maximum((v * v).sum(axis=1), SLOWEST_MPS2)
    along = (p * v).sum(axis=1)
    free = -along / square
    time = np.minimum(np.maximum(free, 0.0), HORIZON_S)
    at = p + v * time[:, None]
    distance = np.sqrt((at * at).sum(axis=1))
    by_p, by_v = -v / square[:, None], (-p - 2.0 * free[:, None] * v) / square[:, None]
    time_var = _form(by_p, p_cov) + _form(by_v, v_cov)
    sigma = np.where((free > 0.0) & (free < HORIZON_S), np.sqrt(np.maximum(time_var, 0.0)), 0.0)
    towards = at / np.maximum(distance, 1e-6)[:, None]
    there = p_cov + v_cov * np.square(time)[:, None, None]
    sigma_m = np.sqrt(np.maximum(_form(towards, there), 0.0))
    soon = (time <= NEARBY_S) & (distance - NEARBY_SIGMA * sigma_m <= NEARBY_M)
    rows = np.minimum(np.stack([time, sigma, distance, sigma_m], axis=1), MOST).tolist()
    return [
        Approach(time_s=t, sigma_s=s, distance_m=d, sigma_m=e, nearby=near)
        for (t, s, d, e), near in zip(rows, soon.tolist(), strict=True)
    ]


def _form(a: Floats, cov: Floats) -> Floats:
    """(N,): a' C a."""
    x, y = a[:, 0], a[:, 1]
    out: Floats = x * (x * cov[:, 0, 0] + 2.0 * y * cov[:, 0, 1]) + y * y * cov[:, 1, 1]
    return out
