"""Whether vehicles stand or drive, and the velocity that planners are given of them.

Two estimates of how probably a vehicle stands, the front end's (vehicles/state/parallax.py) and the Savage-Dickey
density ratio of the graph's velocity, are pooled by the mean of their log odds (Genest and Zidek 1986). From that comes
a decision with hysteresis, and a velocity with the covariance of a mixture. docs/method.md ("Stationary or moving") has
the equations and the reasons.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.vehicles import VehicleNode
from birdslam.types import Moves

PRIOR = 1.0 / 3.0  # of the vehicles stand when first seen, as parallax.py has it
# Of those first seen more than 15 m aside, on another road or on none. By the labels of KITTI tracking 0000 to 0020: 48
# of 62 cars that do either, at their first sight of 25 px; nearer, but for the ego's own lane, it is 103 of 212
PRIOR_BESIDE = 0.75
MAX_PROBABILITY = 0.99  # and 1 less it: neither of the two is believed to be surer
# To decide, and below it to give a decision up. By judgement; from 0.5 to 0.7 and from 0.9 to 0.95 the cars of KITTI
# tracking 0000-0018 by RRC's boxes, and of 0005 by two networks', are decided alike but for some 10 sights of 5,600
DECIDED, GIVEN_UP = 0.9, 0.7
STANDING_MPS = 0.05  # 1-sigma of the velocity of what stands, as of the final trajectories
_MIN_DET = 1e-12  # of a velocity's covariance, (m/s)^4
_SHARE = {Moves.STANDING: 1.0, Moves.DRIVING: 0.0}


def judge(vehicles: Sequence[VehicleNode], velocities: Floats, covs: Floats, birth_det: float, t_ns: int) -> None:
    """Renews `standing` and `moves` of the vehicles of which this frame, at source time `t_ns`, has edges.

    `velocities` (M, 2) in m/s with `covs` (M, 2, 2) are the graph's; `birth_det` is the determinant of such a
    covariance at birth.
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
    # Both have the prior of those on its road
    beside = np.array([vehicles[row].beside for row in rows]) * (_logit(PRIOR_BESIDE) - _logit(PRIOR))
    pooled = _probability((by_velocity + _clipped(_logit(seen))) / 2.0 + beside)
    alone = _probability(by_velocity)
    for row, standing, by_velocity_alone in zip(rows, pooled.tolist(), alone.tolist(), strict=True):
        v = vehicles[row]
        if not v.in_path:
            v.standing, v.moves = standing, decide(v.moves, standing)
        elif standing <= 1.0 - DECIDED:  # no size and no tilt let what stands come nearer so slowly
            v.standing, v.moves = standing, Moves.DRIVING
        elif v.moves is not Moves.DRIVING and by_velocity_alone <= 1.0 - DECIDED:
            v.standing, v.moves = None, Moves.UNDECIDED


def decide(before: Moves, standing: float) -> Moves:
    """The decision after the one `before`, from the probability that it stands."""
    if standing >= DECIDED:
        return Moves.STANDING
    if standing <= 1.0 - DECIDED:
        return Moves.DRIVING
    given_up = (standing if before is Moves.STANDING else 1.0 - standing) < GIVEN_UP
    return Moves.UNDECIDED if given_up else before


def reported_velocities(vehicles: Sequence[VehicleNode], velocities: Floats, covs: Floats) -> tuple[Floats, Floats]:
    """Velocities u (M, 2) in m/s and their covariances (M, 2, 2), from the graph's, which are of vehicles that move.

    x = 0 with the probability p of standing, else N(v, P); u = (1 - w) v, and the covariance is
    (1 - p) P + ((1 - p) w^2 + p (1 - w)^2) v v' + p sigma^2 I; w is 1 when standing, 0 when driving, else p.
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
