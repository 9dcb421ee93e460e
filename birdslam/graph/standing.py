"""Decides whether vehicles are stationary or moving, and computes their reported velocity.

Two probabilities of being stationary, that of the front end (vehicles/state/parallax.py) and the Savage-Dickey density
ratio of the graph's velocity, are pooled by the mean of their log odds (Genest and Zidek 1986). The decision has
hysteresis; the velocity has the covariance of a mixture. docs/method.md ("Stationary or moving") has the equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.vehicles import VehicleNode
from birdslam.types import Moves

PRIOR = 1.0 / 3.0  # probability that a new vehicle is stationary, as in parallax.py
PRIOR_BESIDE = 0.75  # the same for vehicles first seen more than 15 m aside, from labels of KITTI tracking
MAX_PROBABILITY = 0.99  # limit of either probability, and 1 minus it
DECIDED, GIVEN_UP = 0.9, 0.7  # probabilities at which a decision is made, and revoked; by judgement
STANDING_MPS = 0.05  # 1-sigma of the velocity of a stationary vehicle
_MIN_DET = 1e-12  # of a velocity's covariance, (m/s)^4
_SHARE = {Moves.STANDING: 1.0, Moves.DRIVING: 0.0}


def judge(vehicles: Sequence[VehicleNode], velocities: Floats, covs: Floats, birth_det: float, t_ns: int) -> None:
    """Updates `standing` and `moves` of the vehicles that have an edge in this frame, at source time `t_ns`.

    `velocities` (M, 2) in m/s with `covs` (M, 2, 2) come from the graph; `birth_det` is the determinant of such a
    covariance for a new vehicle.
    """
    rows = [row for row, v in enumerate(vehicles) if v.seen_ns == t_ns and v.standing_seen is not None]
    if not rows:
        return
    x, y = velocities[rows].T
    xx, xy, yy = covs[rows, 0, 0], covs[rows, 0, 1], covs[rows, 1, 1]
    det = np.maximum(xx * yy - xy * xy, _MIN_DET)
    z2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det
    by_velocity = _clipped(_logit(PRIOR) + 0.5 * (np.log(birth_det / det) - z2))
    seen = np.array([vehicles[row].standing_seen for row in rows], np.float64)
    # Both probabilities assume PRIOR
    beside = np.array([vehicles[row].beside for row in rows]) * (_logit(PRIOR_BESIDE) - _logit(PRIOR))
    by_growth = _clipped(_logit(seen))
    # The graph does not estimate the velocity of a fixed vehicle
    by_velocity = np.where([vehicles[row].is_fixed for row in rows], by_growth, by_velocity)
    pooled = _probability((by_velocity + by_growth) / 2.0 + beside)
    alone = _probability(by_velocity)
    for row, standing, by_velocity_alone in zip(rows, pooled.tolist(), alone.tolist(), strict=True):
        v = vehicles[row]
        if not v.in_path:
            v.standing, v.moves = standing, decide(v.moves, standing)
        elif standing <= 1.0 - DECIDED:  # an error of size or tilt can't explain the slow approach
            v.standing, v.moves = standing, Moves.DRIVING
        elif v.moves is not Moves.DRIVING and by_velocity_alone <= 1.0 - DECIDED:
            v.standing, v.moves = None, Moves.UNDECIDED


def decide(before: Moves, standing: float) -> Moves:
    """Returns the decision after `before`, given the probability of being stationary."""
    if standing >= DECIDED:
        return Moves.STANDING
    if standing <= 1.0 - DECIDED:
        return Moves.DRIVING
    given_up = (standing if before is Moves.STANDING else 1.0 - standing) < GIVEN_UP
    return Moves.UNDECIDED if given_up else before


def reported_velocities(vehicles: Sequence[VehicleNode], velocities: Floats, covs: Floats) -> tuple[Floats, Floats]:
    """Returns velocities u (M, 2) in m/s with covariances (M, 2, 2), from those of the graph, which assume motion.

    The velocity is 0 with the probability p of being stationary, else N(v, P); u = (1 - w) v, and the covariance is
    (1 - p) P + ((1 - p) w^2 + p (1 - w)^2) v v' + p sigma^2 I; w is 1 if stationary, 0 if moving, else p.
    """
    stands = [v.standing or 0.0 for v in vehicles]
    p = np.array(stands)
    w = np.array([_SHARE.get(v.moves, of) for v, of in zip(vehicles, stands, strict=True)])
    spread = (1.0 - p) * w * w + p * (1.0 - w) ** 2
    reported = (1.0 - p)[:, None, None] * covs
    reported += (spread[:, None] * velocities)[:, :, None] * velocities[:, None]
    reported[:, 0, 0] += p * STANDING_MPS**2
    reported[:, 1, 1] += p * STANDING_MPS**2
    return (1.0 - w)[:, None] * velocities, reported


def _clipped(log_odds: Floats) -> Floats:
    most = _logit(MAX_PROBABILITY)
    return np.minimum(np.maximum(log_odds, -most), most)


def _probability(log_odds: Floats) -> Floats:
    out: Floats = 1.0 / (1.0 + np.exp(-log_odds))
    return out


@overload
def _logit(probability: float) -> float: ...
@overload
def _logit(probability: Floats) -> Floats: ...
def _logit(probability: float | Floats) -> float | Floats:
    out: float | Floats = np.log(np.maximum(probability, 1e-12) / np.maximum(1.0 - probability, 1e-12))
    return out
