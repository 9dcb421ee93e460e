"""What a graph of keyframes should do with a unit of length that drifts: nothing, wider links, or a scale a keyframe.

Two rounds of a block by an odometry whose scale walks, links as `loops.closing` weighs them, and links between the
rounds in the metres of the keyframe that was seen. Sim(2) is that of Strasdat et al. 2010; the method has SE(2).
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.bench.baselines.batch_sim2 import places_in_sim2
from birdslam.bench.simulation.places import block
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops
from birdslam.loops.drift import moved
from birdslam.loops.gnss.factors import Node
from birdslam.loops.keyframe import Link
from birdslam.perf.reporting.figures import Ledger

ROUND_M, STEP_M = 2000.0, 4
WALKS = 0.0002, 0.0005  # of the scale's logarithm, by the root of a metre: loops of larger ones are switched off
SEEDS = range(1, 6)
WIDE_REL = 0.06  # of a wider link
STEP_SIGMA, LOOP_SIGMA = (0.01, 0.006, 0.0006), (0.04, 0.04, 0.001)
UNKNOWN_SCALE = 0.05  # 1-sigma of what a link between the rounds says of the two scales: next to nothing


def measure(ledger: Ledger) -> None:
    """RMS of the keyframes' places, by each way, in the mean over SEEDS."""
    for walk in WALKS:
        rms: dict[str, list[float]] = {"odometry": [], "SE(2)": [], "SE(2), wider links": [], "Sim(2)": []}
        spread = []
        for seed in SEEDS:
            true, nodes, links, wide, scales = _drive(seed, walk)
            spread.append(float(np.ptp(scales)))
            for name, places in (
                ("odometry", _xy([node.T_map_keyframe for node in nodes])),
                ("SE(2)", _xy([pose for pose, _ in close_loops(nodes, links).values()])),
                ("SE(2), wider links", _xy([pose for pose, _ in close_loops(nodes, wide).values()])),
                ("Sim(2)", _closed(nodes, links, walk)),
            ):
                rms[name].append(float(np.sqrt(((places - _xy(true)) ** 2).sum(axis=1).mean())))
        means = {name: round(float(np.mean(each)), 2) for name, each in rms.items()}
        text = f"RMS of keyframes over {len(SEEDS)} drives: " + ", ".join(f"{k} {v:.2f} m" for k, v in means.items())
        title = f"scale drifts by {100 * np.mean(spread):.1f} % in two rounds of 2 km"
        ledger.add(title, text, **{"walk": walk, **means}, text=text)


def _xy(poses: list[SE2]) -> Floats:
    return np.array([(T.x_m, T.y_m) for T in poses])


def _drive(seed: int, walk: float) -> tuple[list[SE2], list[Node], list[Link], list[Link], Floats]:
    """True poses, keyframes by odometry, links, the same but wider, and the scale at each keyframe."""
    chance = np.random.default_rng(seed)
    route = block(ROUND_M / 4.0)
    true = [SE2(*(float(number) for number in route[row % len(route)])) for row in range(0, 2 * len(route), STEP_M)]
    true = [true[0].between(T) for T in true]
    scales: Floats = np.exp(np.cumsum(walk * math.sqrt(STEP_M) * chance.standard_normal(len(true))))
    T_odom, odometry, links, wide = SE2(), [SE2()], [], []
    for k in range(1, len(true)):
        step = _measured(true[k - 1].between(true[k]), scales[k], chance.standard_normal(3) * STEP_SIGMA)
        T_odom = T_odom @ step
        odometry.append(T_odom)
        links.append(Link(k - 1, k, step, moved(np.zeros((3, 3)), step)))
        wide.append(Link(k - 1, k, step, moved(np.zeros((3, 3)), step, scale_rel=WIDE_REL)))
    half, cov = len(true) // 2, np.diag(np.square(LOOP_SIGMA))
    for k in range(half + 2, len(true), 2):
        between = true[k - half].between(true[k])
        seen = _measured(between, scales[k - half], chance.standard_normal(3) * LOOP_SIGMA)
        links.append(Link(k - half, k, seen, cov, loop=True))
        wide.append(links[-1])
    return true, [Node(k, T) for k, T in enumerate(odometry)], links, wide, scales


def _measured(step: SE2, scale: float, error: Floats) -> SE2:
    return SE2(step.x_m * scale, step.y_m * scale, step.yaw_rad) @ SE2.exp(error)


def _closed(nodes: list[Node], links: list[Link], walk: float) -> Floats:
    """(N, 2) places of keyframes that have a scale each."""
    edges = []
    for link in links:
        way_m = math.hypot(link.T_from_to.x_m, link.T_from_to.y_m)
        scale = UNKNOWN_SCALE if link.loop else walk * math.sqrt(max(way_m, 0.1))
        sigmas = np.append(np.sqrt(np.diag(link.cov)), scale)
        edges.append((link.from_number, link.to_number, link.T_from_to, sigmas))
    return places_in_sim2([node.T_map_keyframe for node in nodes], edges)
