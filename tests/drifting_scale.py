"""A simulated drive around a block whose odometry has a drifting scale, and the errors after its loop is closed."""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops
from birdslam.loops.drift import CORRELATION_M, MIN_SCALE_REL, link_cov
from birdslam.loops.gnss.factors import Node
from birdslam.loops.keyframe import Link
from birdslam.perf.maps.places import block

ROUND_M, STEP_M = 2000.0, 4
CARRIED_FROM_M, AGAIN_M = 800.0, 200.0  # of a round's way, and that is driven twice
STEP_SIGMA, LOOP_SIGMA = (0.01, 0.006, 0.0006), (0.04, 0.04, 0.001)

Drive = tuple[list[SE2], list[Node], list[Link]]  # true poses, keyframes by odometry, links


def carried(seed: int, drift: float) -> Drive:
    """Simulates a round and its beginning again; the scale has the errors of odometry, then drifts."""
    chance = np.random.default_rng([seed, 1])
    way_m = np.arange(0.0, ROUND_M + AGAIN_M, STEP_M)
    lasts, error = math.exp(-STEP_M / CORRELATION_M), MIN_SCALE_REL * chance.standard_normal(len(way_m))
    for k in range(1, len(error)):
        error[k] = lasts * error[k - 1] + math.sqrt(1.0 - lasts**2) * error[k]
    drifted = drift * np.clip((way_m - CARRIED_FROM_M) / (ROUND_M - CARRIED_FROM_M), 0.0, None)
    return _drive(seed, np.exp(error + drifted), drifted)


def _drive(seed: int, scales: Floats, drifted: Floats) -> Drive:
    """A keyframe for each of `scales` (N,), whose drift odometry foresees as `drifted` (N,), 1-sigma."""
    chance = np.random.default_rng(seed)
    route = block(ROUND_M / 4.0)
    rows = STEP_M * np.arange(len(scales))
    true = [SE2(*(float(number) for number in route[row % len(route)])) for row in rows]
    true = [true[0].between(T) for T in true]
    T_odom, odometry, links = SE2(), [SE2()], []
    for k in range(1, len(true)):
        step = _measured(true[k - 1].between(true[k]), scales[k], chance.standard_normal(3) * STEP_SIGMA)
        T_odom = T_odom @ step
        odometry.append(T_odom)
        scale_rel = math.hypot(MIN_SCALE_REL, drifted[k])
        links.append(Link(k - 1, k, step, link_cov(step, scale_rel), scale_rel=scale_rel))
    round_, cov = len(route) // STEP_M, np.diag(np.square(LOOP_SIGMA))
    for k in range(round_ + 2, len(true), 2):
        between = true[k - round_].between(true[k])
        seen = _measured(between, scales[k - round_], chance.standard_normal(3) * LOOP_SIGMA)
        links.append(Link(k - round_, k, seen, cov, loop=True))
    return true, [Node(k, T) for k, T in enumerate(odometry)], links


def in_sim2(true: list[SE2], nodes: list[Node], links: list[Link]) -> tuple[Floats, Floats]:
    """Returns the errors (N, 2) along and across the keyframes after closing the loop, and their 1-sigma."""
    solved = list(close_loops(nodes, links, agreed=True).values())
    sigma = np.sqrt([np.diag(each.cov)[:2] for each in solved])
    return _off([each.T_map_keyframe for each in solved], true), sigma


def _measured(step: SE2, scale: float, error: Floats) -> SE2:
    return step.scaled(scale) @ SE2.exp(error)


def _off(found: list[SE2], true: list[SE2]) -> Floats:
    return np.array([T.between(here).log()[:2] for here, T in zip(found, true, strict=True)])
