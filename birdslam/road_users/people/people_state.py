"""State of a person, the motions, and the moments of a mixture of filters.

    x = [x, y, vx, vy, log h, tilt, offset, foot, head]

Position (m) and velocity (m/s) are in the odometry world, `h` is the height in metres. `tilt` (rad) and `offset` (m,
downwards) are of the ground at the person relative to the front end's ground. `foot` and `head` are correlated errors
of the edges of the box, relative to its height.
"""

from __future__ import annotations

from dataclasses import dataclass

from birdslam.geometry.arrays import Floats

STATES = X, Y, VX, VY, HEIGHT, TILT, OFFSET, FOOT, HEAD = range(9)
VELOCITY = slice(2, 4)
# TOWARDS and AWAY move along the road, CROSSING in any direction
MOTIONS = STATIONARY, TOWARDS, AWAY, CROSSING = range(4)
FILTERS = 2 * len(MOTIONS)  # for the height of an adult, and of a child
STATIONARY_FILTERS, CHILD_FILTERS = [STATIONARY, len(MOTIONS) + STATIONARY], slice(len(MOTIONS), None)


@dataclass(frozen=True)
class Moments:
    """Means (N, 9) and covariances (N, 9, 9) of the mixtures; probabilities (N,) of standing and of a child."""

    mean: Floats
    cov: Floats
    standing: Floats
    child: Floats


def merge_mixture(x: Floats, P: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean (..., S), covariance (..., S, S) of Gaussian mixtures (..., C, S), (..., C, S, S), weights (..., C)."""
    mean = (weight[..., None] * x).sum(axis=-2)
    gap = x - mean[..., None, :]
    spread = P + gap[..., :, None] * gap[..., None, :]
    return mean, (weight[..., None, None] * spread).sum(axis=-3)
