"""The incremental optimizer against the batch on one sequence of measurements (the paper: 0.016 s and 1.9 s).

    python -m perf incremental [--frames 414] [--vehicles 3] [--output F.json]

Both get the same seeded drive at 10 Hz, as long as the paper's longest sequence. The batch is solved once, at the end,
which is what the paper timed; a planner that wants an answer in every frame would have to solve it in every frame.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from birdslam.baselines import batch_se3, nair
from birdslam.baselines.trajectories import Trajectories
from birdslam.camera import Camera
from birdslam.graph import PoseGraph
from birdslam.simulation.drive import DriveConfig, drive
from birdslam.slam import SlamConfig
from birdslam.tracking_evaluation import PAPER, Live, ours

label = "batch over incremental: the time of a whole sequence"

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, height_m=1.65)  # the batches read no pixel
PUBLISHED_RATIO = 1.9 / 0.016
REPEATS = 3


def run(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m perf incremental", description=__doc__)
    parser.add_argument("--frames", type=int, default=414)
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args(arguments)
    config = DriveConfig(frames=options.frames, vehicles=options.vehicles, rate_hz=10.0)
    log = drive(config, options.seed).measurements

    def live(method: Live) -> Callable[[], object]:
        return lambda: [graph.update(m) for graph in (PoseGraph(method.graph, method.weights),) for m in log]

    def batch(solve: Callable[..., Trajectories]) -> Callable[[], object]:
        return lambda: solve(log, CAMERA)

    seconds = {
        "incremental": _median_s(live(ours(SlamConfig()))),
        "incremental, paper mode": _median_s(live(PAPER)),
        "batch SE(3), metric odometry": _median_s(batch(nair.run)),
        "batch SE(3), unscaled odometry, lanes": _median_s(batch(batch_se3.run)),
    }
    fastest = seconds["incremental"]
    rows = [{"method": name, "seconds": took, "ratio": took / fastest} for name, took in seconds.items()]
    for row in rows:
        print(f"{row['method']:40} {row['seconds']:8.3f} s  {row['ratio']:7.1f}")
    print(f"{'published':40} {'':10}  {PUBLISHED_RATIO:7.1f}")
    if options.output:
        options.output.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def _median_s(work: Callable[[], object]) -> float:
    took = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return float(np.median(took))
