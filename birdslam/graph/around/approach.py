"""The closest approach of road users to the ego, if all keep their present velocity.

An aid for planners, not a safety function: it ignores intentions and undetected road users. With p and v the
position and velocity relative to the ego, t = -p.v / v.v and d = |p + v t|; their sigmas follow from the covariances of
p and v to first order.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.types import Approach

HORIZON_S = 30.0  # a later approach is evaluated at this time
NEARBY_S, NEARBY_M, NEARBY_SIGMA = 5.0, 2.0, 2.0
MIN_SPEED2_MPS2 = 0.01  # minimum of the squared relative velocity
MAX_REPORTED = 1e9  # limit of every reported number


def approaches(p: Complexes, v: Complexes, means: Floats, deviators: Complexes) -> list[Approach]:
    """Returns the approaches of N road users with positions p and velocities v (N,) relative to the ego, in m and m/s.

    `means` and `deviators` (2, N) are the covariances of p and of v, as in costs.py; p and v are uncorrelated.
    """
    if not len(p):
        return []
    numbers = np.empty((4, len(p)))  # of each approach
    time, sigma_s, distance, sigma_m = numbers
    back = v.conj()
    square = np.maximum((v * back).real, MIN_SPEED2_MPS2)
    free = (p * back).real / -square
    np.minimum(np.maximum(free, 0.0), HORIZON_S, out=time)
    at = p + v * time
    np.abs(at, out=distance)
    by = np.empty((2, 2, len(p)), np.complex128)  # derivatives of time and distance (first axis) by p and v
    towards = at / np.maximum(distance, 1e-6)
    by[0, 0], by[0, 1] = v / square, (p + 2.0 * free * v) / square
    by[1, 0], by[1, 1] = towards, towards * time
    squares = by * by
    variances = means * np.abs(squares) + (deviators.conj() * squares).real
    np.sqrt(np.maximum(variances[:, 0] + variances[:, 1], 0.0), out=numbers[1::2])
    sigma_s *= free == time
    np.minimum(numbers, MAX_REPORTED, out=numbers)
    soon = (time <= NEARBY_S) & (distance - NEARBY_SIGMA * sigma_m <= NEARBY_M)
    return [
        Approach(time_s=t, sigma_s=s, distance_m=d, sigma_m=e, nearby=near)
        for (t, s, d, e), near in zip(numbers.T.tolist(), soon.tolist(), strict=True)
    ]
