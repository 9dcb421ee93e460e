"""Whether vehicles stand or drive, and the velocity that planners are told of them.

Two say how probably a vehicle stands, from the same images but with other errors: the front end by how it grows in the
image (vehicles/state/parallax.py), and the graph by how far from nil its velocity is, against how far it was before
anything was seen (the density ratio of Savage and Dickey):

    log N(0; v, P) - log N(0; 0, P_birth) = log sqrt(|P_birth| / |P|) - v' P^-1 v / 2

They are pooled by the mean of their log odds, as opinions are that share their evidence (Genest and Zidek 1986). Both
begin with the odds of vehicles on the ego's road; who is first seen far beside it more often stands, and gets the odds
of those. From this comes a decision that lasts: taken on strong evidence, given up only where the evidence turns. In
the ego's path growth says nothing (parallax.py tells why), and a car there that creeps must not be told to stand: what
was decided before is kept there, until the velocity alone contradicts it, and nothing new is decided.

The graph's velocity is that of a vehicle that moves. What is told is of both, with the covariance that a mixture has:

    x = 0 with the probability p, else N(v, P);    u = (1 - w) v
    E (x - u)(x - u)' = (1 - p) P + ((1 - p) w^2 + p (1 - w)^2) v v' + p sigma^2 I

w is p, and so u the mean, while nothing is decided; it is 1 for a vehicle that stands and 0 for one that drives. So a
parked car that was just found is not told to drive.
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
# tracking 0000-0018 by RRC's boxes, and of 0005 by two networks', are told alike but for some 10 sights of 5,600
DECIDED, GIVEN_UP = 0.9, 0.7
STANDING_MPS = 0.05  # 1-sigma of the velocity of what stands, as of the final trajectories
_LEAST_DET = 1e-12  # of a velocity's covariance, (m/s)^4
_SHARE = {Moves.STANDING: 1.0, Moves.DRIVING: 0.0}


def judge(v: VehicleNode, velocity: Pair, cov: Quad, birth_det: float, t_ns: int) -> None:
    """Renews `standing` and `moves` of a vehicle, if an edge of this frame, at source time `t_ns`, told of it.

    `velocity` (x, y) in m/s with `cov`, row-major, is the graph's; `birth_det` is the determinant of such a covariance
    at birth.
    """
    if v.seen_ns != t_ns or v.standing_seen is None:
        return
    (x, y), (xx, xy, _, yy) = velocity, cov
    det = max(xx * yy - xy * xy, _LEAST_DET)
    z2 = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det
    by_velocity = _clipped(_logit(PRIOR) + 0.5 * (math.log(birth_det / det) - z2))
    if not v.in_path:
        beside = _logit(PRIOR_BESIDE) - _logit(PRIOR) if v.beside else 0.0  # both have the prior of those on its road
        v.standing = _probability((by_velocity + _clipped(_logit(v.standing_seen))) / 2.0 + beside)
        v.moves = decide(v.moves, v.standing)
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


def told_velocity(v: VehicleNode, velocity: Pair, cov: Quad) -> tuple[Pair, Quad]:
    """A vehicle's velocity in m/s and its covariance, row-major, from the graph's; see the module."""
    (x, y), (xx, xy, yx, yy) = velocity, cov
    p = v.standing or 0.0
    w = _SHARE.get(v.moves, p)
    drives, spread, stands = 1.0 - p, (1.0 - p) * w * w + p * (1.0 - w) ** 2, p * STANDING_MPS**2
    told = (
        drives * xx + spread * x * x + stands,
        drives * xy + spread * x * y,
        drives * yx + spread * x * y,
        drives * yy + spread * y * y + stands,
    )
    return ((1.0 - w) * x, (1.0 - w) * y), told


def _clipped(log_odds: float) -> float:
    most = _logit(SUREST)
    return min(max(log_odds, -most), most)


def _probability(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds))


def _logit(probability: float) -> float:
    return math.log(max(probability, 1e-12) / max(1.0 - probability, 1e-12))
