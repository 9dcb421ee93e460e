"""Whether vehicles stand or drive, and the velocity that planners are given of them.

Two estimates of how probably a vehicle stands, the front end's (vehicles/state/parallax.py) and the Savage-Dickey
density ratio of the graph's velocity, are pooled by the mean of their log odds (Genest and Zidek 1986). From that comes
a decision with hysteresis, and a velocity with the covariance of a mixture. docs/method.md ("Standing or driving") has
the equations and the reasons.
"""

from __future__ import annotations

import math

from birdslam.graph.vehicles import VehicleNode
from birdslam.types import Moves

Pair = tuple[float, float]
Quad = tuple[float, float, float, float]

PRIOR = 1.0 / 3.0  # of the vehicles stand when first seen, as parallax.py has it
# Of those first seen more than 15 m aside, on another road or on none. By the labels of KITTI tracking 0000 to 0020: 48
# of 62 cars that do either, at their first sight of 25 px; nearer, but for the ego's own lane, it is 103 of 212
PRIOR_BESIDE = 0.75
SUREST = 0.99  # and 1 less it: neither of the two is believed to be surer
# To decide, and below it to give a decision up. By judgement; from 0.5 to 0.7 and from 0.9 to 0.95 the cars of KITTI
# tracking 0000-0018 by RRC's boxes, and of 0005 by two networks', are decided alike but for some 10 sights of 5,600
DECIDED, GIVEN_UP = 0.9, 0.7
STANDING_MPS = 0.05  # 1-sigma of the velocity of what stands, as of the final trajectories
_LEAST_DET = 1e-12  # of a velocity's covariance, (m/s)^4
_SHARE = {Moves.STANDING: 1.0, Moves.DRIVING: 0.0}


def judge(v: VehicleNode, velocity: Pair, cov: Quad, birth_det: float, t_ns: int) -> None:
    """Renews `standing` and `moves` of a vehicle, if this frame, at source time `t_ns`, has an edge of it.

    `velocity` (x, y) in m/s with `cov`, row-major, is the graph's; `birth_det` is the determinant of such a covariance
    at birth.
    """
    if v.seen_ns != t_ns or v.standing_seen is None:
        return
    (x, y), (xx, xy, _, yy) = velocity, cov
    det = max(xx * yy - xy * xy, _LEAST_DET)
    z2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det
    by_velocity = _clipped(_logit(PRIOR) + 0.5 * (math.log(birth_det / det) - z2))
    beside = _logit(PRIOR_BESIDE) - _logit(PRIOR) if v.beside else 0.0  # both have the prior of those on its road
    standing = _probability((by_velocity + _clipped(_logit(v.standing_seen))) / 2.0 + beside)
    if not v.in_path:
        v.standing, v.moves = standing, decide(v.moves, standing)
    elif standing <= 1.0 - DECIDED:  # no size and no tilt let what stands come nearer so slowly
        v.standing, v.moves = standing, Moves.DRIVING
    elif v.moves is not Moves.DRIVING and _probability(by_velocity) <= 1.0 - DECIDED:
        v.standing, v.moves = None, Moves.UNDECIDED


def decide(before: Moves, standing: float) -> Moves:
    """The decision after the one `before`, from the probability that it stands."""
    if standing >= DECIDED:
        return Moves.STANDING
    if standing <= 1.0 - DECIDED:
        return Moves.DRIVING
    given_up = (standing if before is Moves.STANDING else 1.0 - standing) < GIVEN_UP
    return Moves.UNDECIDED if given_up else before


def reported_velocity(v: VehicleNode, velocity: Pair, cov: Quad) -> tuple[Pair, Quad]:
    """A vehicle's velocity u in m/s and its covariance, row-major, from the graph's, which is of a vehicle that moves.

    x = 0 with the probability p of standing, else N(v, P); u = (1 - w) v, and the covariance is
    (1 - p) P + ((1 - p) w^2 + p (1 - w)^2) v v' + p sigma^2 I; w is 1 when standing, 0 when driving, else p.
    """
    (x, y), (xx, xy, yx, yy) = velocity, cov
    p = v.standing or 0.0
    w = _SHARE.get(v.moves, p)
    drives, spread, stands = 1.0 - p, (1.0 - p) * w * w + p * (1.0 - w) ** 2, p * STANDING_MPS**2
    reported = (
        drives * xx + spread * x * x + stands,
        drives * xy + spread * x * y,
        drives * yx + spread * x * y,
        drives * yy + spread * y * y + stands,
    )
    return ((1.0 - w) * x, (1.0 - w) * y), reported


def _clipped(log_odds: float) -> float:
    most = _logit(SUREST)
    return min(max(log_odds, -most), most)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _logit(probability: float) -> float:
    return math.log(max(probability, 1e-12) / max(1.0 - probability, 1e-12))
