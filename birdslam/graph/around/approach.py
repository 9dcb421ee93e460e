"""Who may come near: the closest approach of road users to the ego, were all to go on as they move now.

An aid for planners and no safety function: nobody's intention is in it, and nobody who was not detected.
With p and v the place and velocity of somebody against the ego's, t = -p.v / v.v and d = |p + v t|; their sigmas come
from the covariances of p and v to first order.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.costs import Complexes
from birdslam.types import Approach

HORIZON_S = 30.0  # a later approach is reported as it would be then
NEARBY_S, NEARBY_M, NEARBY_SIGMA = 5.0, 2.0, 2.0
SLOWEST_MPS2 = 0.01  # a squared velocity below it is none
MOST = 1e9  # of any number that is reported


def approaches(p: Complexes, v: Complexes, means: Floats, deviators: Complexes) -> list[Approach]:
    """Of N road users, places p and velocities v (N,) against the ego's, in m and m/s, all in one frame.

    `means` and `deviators` (2, N) are the covariances of p and of v, as costs.py has them.
    """
    if not len(p):
        return []
    square = np.maximum((v * v.conj()).real, SLOWEST_MPS2)
    free = (p * v.conj()).real / -square
    time = np.minimum(np.maximum(free, 0.0), HORIZON_S)
    at = p + v * time
    distance = np.abs(at)
    # How time goes with p and v, and distance with them: a variance a'Ca is m |a|^2 + Re(d* a^2)
    a = np.empty((2, 2, len(p)), np.complex128)
    a[0] = v, p + 2.0 * free * v
    a[0] /= square
    a[1] = at / np.maximum(distance, 1e-6)  # towards them
    a[1, 1] *= time
    variances = means * (a.real**2 + a.imag**2) + (deviators.conj() * a * a).real
    sigma_s, sigma_m = np.sqrt(np.maximum(variances[:, 0] + variances[:, 1], 0.0))
    sigma_s *= free == time
    soon = (time <= NEARBY_S) & (distance - NEARBY_SIGMA * sigma_m <= NEARBY_M)
    rows = np.minimum(np.array([time, sigma_s, distance, sigma_m]), MOST).T.tolist()
    return [
        Approach(time_s=t, sigma_s=s, distance_m=d, sigma_m=e, nearby=near)
        for (t, s, d, e), near in zip(rows, soon.tolist(), strict=True)
    ]
