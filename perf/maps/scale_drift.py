"""A unit of length that drifts: what closing loops makes of it with a scale for each keyframe, and without.

Rounds of a block by an odometry whose scale walks, or drifts away while no road is seen, and that says so of itself;
links between the rounds are in the metres of the keyframe that was seen. SE(2) has the same links, as uncertain as
their scale.
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.bench.baselines.loops_se2 import places_in_se2
from birdslam.bench.simulation.places import block
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops
from birdslam.loops.drift import CORRELATION_M, LEAST_SCALE_REL, link_cov
from birdslam.loops.gnss.factors import Node
from birdslam.loops.keyframe import Link
from birdslam.perf.reporting.figures import Ledger

ROUND_M, STEP_M = 2000.0, 4
WALKS = 0.0002, 0.0005, 0.001  # of the scale's logarithm, by the root of a metre
CARRIED = 0.03, 0.06  # by which the scale drifts from CARRIED_FROM_M to the end of a round
CARRIED_FROM_M, AGAIN_M = 800.0, 200.0  # of a round's way, and that is driven twice
SEEDS = range(1, 6)
STEP_SIGMA, LOOP_SIGMA = (0.01, 0.006, 0.0006), (0.04, 0.04, 0.001)

Drive = tuple[list[SE2], list[Node], list[Link]]  # true poses, keyframes by odometry, links


def measure(ledger: Ledger) -> None:
    """RMS of the keyframes' places, by each way, in the mean over SEEDS, and how many are within 2 sigma."""
    for walk in WALKS:
        drives = [walked(seed, walk) for seed in SEEDS]
        _judged(ledger, f"scale walks by {100 * walk:g} % a root of a metre, two rounds of 2 km", drives)
    for drift in CARRIED:
        drives = [carried(seed, drift) for seed in SEEDS]
        _judged(ledger, f"scale carried, drifts by {100 * drift:g} % in a round of 2 km", drives)


def _judged(ledger: Ledger, title: str, drives: list[Drive]) -> None:
    rms: dict[str, list[float]] = {"odometry": [], "SE(2)": [], "Sim(2)": []}
    inside: dict[str, list[float]] = {"SE(2)": [], "Sim(2)": []}
    for true, nodes, links in drives:
        rms["odometry"].append(_rms(_off([node.T_map_keyframe for node in nodes], true)))
        for name, (off, sigma) in (("SE(2)", in_se2(true, nodes, links)), ("Sim(2)", in_sim2(true, nodes, links))):
            rms[name].append(_rms(off))
            inside[name].append(float((np.abs(off) < 2.0 * sigma).mean()))
    means = {name: round(float(np.mean(each)), 2) for name, each in rms.items()}
    within = {name: round(float(np.mean(each)), 2) for name, each in inside.items()}
    text = f"RMS of keyframes over {len(drives)} drives: " + ", ".join(f"{k} {v:.2f} m" for k, v in means.items())
    text += "; within 2 sigma " + ", ".join(f"{name} {share:.2f}" for name, share in within.items())
    ledger.add(title, text, **means, within_2_sigma=within, text=text)


def walked(seed: int, walk: float) -> Drive:
    """Two rounds in a scale that walks at random."""
    chance = np.random.default_rng([seed, 1])
    count = round(2 * ROUND_M / STEP_M)
    way_m = STEP_M * np.arange(count)
    scales = np.exp(np.cumsum(walk * math.sqrt(STEP_M) * chance.standard_normal(count)))
    return _drive(seed, scales, walk * np.sqrt(way_m))


def carried(seed: int, drift: float) -> Drive:
    """A round and its begin again, in a scale that errs as odometry's does, and drifts once it is carried."""
    chance = np.random.default_rng([seed, 1])
    way_m = np.arange(0.0, ROUND_M + AGAIN_M, STEP_M)
    lasts, error = math.exp(-STEP_M / CORRELATION_M), LEAST_SCALE_REL * chance.standard_normal(len(way_m))
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
        scale_rel = math.hypot(LEAST_SCALE_REL, drifted[k])
        links.append(Link(k - 1, k, step, link_cov(step, scale_rel), scale_rel=scale_rel))
    round_, cov = len(route) // STEP_M, np.diag(np.square(LOOP_SIGMA))
    for k in range(round_ + 2, len(true), 2):
        between = true[k - round_].between(true[k])
        seen = _measured(between, scales[k - round_], chance.standard_normal(3) * LOOP_SIGMA)
        links.append(Link(k - round_, k, seen, cov, loop=True))
    return true, [Node(k, T) for k, T in enumerate(odometry)], links


def in_se2(true: list[SE2], nodes: list[Node], links: list[Link]) -> tuple[Floats, Floats]:
    """(N, 2) how far keyframes are off along and across them, and its 1-sigma, without scales."""
    wide = []
    for link in links:
        scale_m = link.scale_rel * math.hypot(link.T_from_to.x_m, link.T_from_to.y_m)
        cov = link.cov + np.diag([scale_m**2, 0.0, 0.0])
        wide.append((link.from_number, link.to_number, link.T_from_to, cov))
    places, sigma = places_in_se2([node.T_map_keyframe for node in nodes], wide)
    return _off([SE2(float(x), float(y), T.yaw_rad) for (x, y), T in zip(places, true, strict=True)], true), sigma


def in_sim2(true: list[SE2], nodes: list[Node], links: list[Link]) -> tuple[Floats, Floats]:
    """The same by the method."""
    solved = list(close_loops(nodes, links, agreed=True).values())
    sigma = np.sqrt([np.diag(each.cov)[:2] for each in solved])
    return _off([each.T_map_keyframe for each in solved], true), sigma


def _measured(step: SE2, scale: float, error: Floats) -> SE2:
    return step.scaled(scale) @ SE2.exp(error)


def _off(found: list[SE2], true: list[SE2]) -> Floats:
    return np.array([T.between(here).log()[:2] for here, T in zip(found, true, strict=True)])


def _rms(off: Floats) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))
