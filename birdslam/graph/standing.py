"""Decides whether vehicles are stationary or moving, and computes their reported velocity.

Two probabilities of being stationary, that of the front end (road_users/models/user_filter.py) and the Savage-Dickey
density ratio of the velocity of the graph, are pooled by the mean log odds (Genest and Zidek 1986). The decision has
hysteresis; the velocity has the covariance of a mixture. docs/method.md ("Stationary or moving") has the equations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.graph.vehicles import VehicleNode
from birdslam.types import Moves

PRIOR = 1.0 / 3.0  # probability that a new vehicle is stationary, as in vehicle_boxes.py
PRIOR_BESIDE = 0.75  # the same for vehicles first seen more than 15 m aside, from labels of KITTI tracking
MAX_PROBABILITY = 0.99  # limit of either probability, and 1 minus it
DECIDED, GIVEN_UP = 0.9, 0.7  # probabilities at which a decision is made, and revoked; by judgement
STANDING_MPS = 0.05  # 1-sigma of the velocity of a stationary vehicle
_MIN_DET = 1e-12  # of a velocity's covariance, (m/s)^4
_SHARE = {Moves.STANDING: 1.0, Moves.DRIVING: 0.0}


def _logit(probability: float) -> float:
    return math.log(max(probability, 1e-12) / max(1.0 - probability, 1e-12))


_PRIOR_LOG_ODDS, _BESIDE_LOG_ODDS = _logit(PRIOR), _logit(PRIOR_BESIDE) - _logit(PRIOR)
_MAX_LOG_ODDS = _logit(MAX_PROBABILITY)


def _clipped(log_odds: float) -> float:
    return min(max(log_odds, -_MAX_LOG_ODDS), _MAX_LOG_ODDS)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def judge(vehicles: Sequence[VehicleNode], velocities: Floats, covs: Floats, birth_det: float, t_ns: int) -> None:
    """Updates `standing` and `moves` of the vehicles that have an edge in this frame, at source time `t_ns`.

    `velocities` (M, 2) in m/s with `covs` (M, 2, 2) come from the graph; `birth_det` is the determinant of such a
    covariance for a new vehicle.
    """
    log_birth = math.log(birth_det)
    for v, (x, y), ((xx, xy), (_, yy)) in zip(vehicles, velocities.tolist(), covs.tolist(), strict=True):
        if v.seen_ns != t_ns or v.standing_seen is None:
            continue
        by_growth = by_velocity = _clipped(_logit(v.standing_seen))
        if not v.is_fixed:  # else the graph does not estimate its velocity
            det = max(xx * yy - xy * xy, _MIN_DET)
            z2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det
            by_velocity = _clipped(_PRIOR_LOG_ODDS + 0.5 * (log_birth - math.log(det) - z2))
        # Both probabilities assume PRIOR
        standing = _probability((by_velocity + by_growth) / 2.0 + (_BESIDE_LOG_ODDS if v.beside else 0.0))
        if not v.in_path:
            v.standing, v.moves = standing, decide(v.moves, standing)
        elif standing <= 1.0 - DECIDED:  # an error of size or tilt can't explain the slow approach
            v.standing, v.moves = standing, Moves.DRIVING
        elif v.moves is not Moves.DRIVING and _probability(by_velocity) <= 1.0 - DECIDED:
            v.standing, v.moves = None, Moves.UNDECIDED


def decide(before: Moves, standing: float) -> Moves:
    """Returns the decision after `before`, given the probability of being stationary."""
    if standing >= DECIDED:
        return Moves.STANDING
    if standing <= 1.0 - DECIDED:
        return Moves.DRIVING
    given_up = (standing if before is Moves.STANDING else 1.0 - standing) < GIVEN_UP
    return Moves.UNDECIDED if given_up else before


def reported_velocities(
    vehicles: Sequence[VehicleNode], velocities: Complexes, covs: Floats
) -> tuple[Complexes, Floats]:
    """Returns velocities u (M,) in m/s with covariances (M, 2, 2), from those of the graph, which assume motion.

    The velocity is 0 with the probability p of being stationary, else N(v, P); u = (1 - w) v, and the covariance is
    (1 - p) P + ((1 - p) w^2 + p (1 - w)^2) v v' + p sigma^2 I; w is 1 if stationary, 0 if moving, else p.
    """
    stands = [v.standing or 0.0 for v in vehicles]
    p, w = np.array([stands, [_SHARE.get(v.moves, of) for v, of in zip(vehicles, stands, strict=True)]])
    spread = np.sqrt((1.0 - p) * w * w + p * (1.0 - w) ** 2)
    by_spread = (spread * velocities).view(np.float64).reshape(-1, 2)
    reported = (1.0 - p)[:, None, None] * covs + by_spread[:, :, None] * by_spread[:, None]
    reported.reshape(-1, 4)[:, ::3] += (p * STANDING_MPS**2)[:, None]
    return (1.0 - w) * velocities, reported
