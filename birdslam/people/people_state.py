"""The state of one person, how people move, and what a mixture of filters amounts to.

    x = [x, y, vx, vy, log h, tilt, kerb, foot, head]

Place (m) and velocity (m/s) are in the odometry's world, `h` is the height in metres, `tilt` (rad) and `kerb` (m, the
road under the feet lies lower by it) are of the road there against the front end's ground, `foot` and `head` are errors
of the box that last for a while, as shares of its height: somebody's pose, what a detector makes of clothes.
"""

from __future__ import annotations

from dataclasses import dataclass

from birdslam.geometry.arrays import Floats

STATES = X, Y, VX, VY, HEIGHT, TILT, KERB, FOOT, HEAD = range(9)
VELOCITY = slice(2, 4)
# Who moves along the road comes towards the ego or goes away from it; others cross, or walk anyhow
MOTIONS = STANDING, TOWARDS, AWAY, CROSSING = range(4)
FILTERS = 2 * len(MOTIONS)  # for an adult's height, and for a child's
STANDING_FILTERS, CHILD_FILTERS = [STANDING, len(MOTIONS) + STANDING], slice(len(MOTIONS), None)


@dataclass(frozen=True)
class Moments:
    """Means (N, 9) and covariances (N, 9, 9) of the mixtures, and the probabilities (N,) of standing and a child."""

    mean: Floats
    cov: Floats
    standing: Floats
    child: Floats


def merged(x: Floats, P: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean (..., S) and covariance (..., S, S) of Gaussian mixtures (..., C, S), (..., C, S, S) by weights (..., C)."""
    mean = (weight[..., None] * x).sum(axis=-2)
    gap = x - mean[..., None, :]
    spread = P + gap[..., :, None] * gap[..., None, :]
    return mean, (weight[..., None, None] * spread).sum(axis=-3)
