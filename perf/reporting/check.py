"""Times of this checkout over those of another commit, measured in turn: `python -m perf check [--base REV]`.

The commit is checked out beside a copy of its packages, and runs with the libraries of this environment. Rounds
alternate between both, so that a load of the machine affects both alike; a ratio is the median over the rounds.
Exit status: 1 if a ratio exceeds LIMIT.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from birdslam.perf.errors import PerfError
from birdslam.perf.latency.drive import DriveConfig
from birdslam.perf.latency.optimizer import write_log
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "times of this checkout over those of another commit, measured in turn"

LIMIT = 1.15
ROOT = Path(__file__).resolve().parents[2]
# One process of either version prints a list of times in ms
_OPTIMIZER = """
import msgspec, sys, time
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.types import Measurements
decoder, graph, times = msgspec.msgpack.Decoder(Measurements), PoseGraph(GraphConfig(), WeightsConfig()), []
for record in msgspec.msgpack.decode(open(sys.argv[1], "rb").read(), type=list[bytes]):
    measurements, before_ns = decoder.decode(record), time.perf_counter_ns()
    graph.optimise(measurements)
    times.append((time.perf_counter_ns() - before_ns) / 1e6)
    graph.map_update()
print(times[100:])
"""
_FRAMES = """
import sys, time
from itertools import islice
from birdslam import BirdSLAM, open_recording
recording, times = open_recording("demo"), []
slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
for frame in islice(recording.undistorted_frames(), int(sys.argv[1])):
    before_ns = time.perf_counter_ns()
    slam.step(frame)
    times.append((time.perf_counter_ns() - before_ns) / 1e6)
print(times[10:])
"""


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("check", label)
    parser.add_argument("--base", default="HEAD^", metavar="REV", help="the other commit (default: HEAD^)")
    parser.add_argument("--rounds", type=int, default=5, help="runs of each version")
    parser.add_argument("--frames", type=int, default=300, help="frames of the demo in a run; 1000 at most")
    options = parser.parse_args(arguments)
    with (
        tempfile.TemporaryDirectory() as folder,
        checkout(options.base, Path(folder) / "base") as base,
        Ledger(options.output, label, base=options.base) as ledger,
    ):
        log = Path(folder) / "10.log"
        write_log(log, DriveConfig(frames=1000, vehicles=10, traffic="convoy"), 1)
        worst = 0.0
        for name, program, argument in (
            ("optimizer, 10 vehicles", _OPTIMIZER, str(log)),
            ("a frame of the demo, all steps", _FRAMES, str(options.frames)),
        ):
            times = [(_times(base, program, argument), _times(ROOT, program, argument)) for _ in range(options.rounds)]
            for percent in (50, 99):
                row = ratio(times, percent)
                worst = max(worst, row["ratio"])
                shown = f"{row['base_ms']:.2f} -> {row['ms']:.2f} ms, ratio {row['ratio']:.2f}"
                ledger.add(f"{name}, p{percent}", shown, **row)
    return int(worst > LIMIT)


def ratio(times: Sequence[tuple[Sequence[float], Sequence[float]]], percent: float) -> dict[str, float]:
    """Returns the percentile of the base and of this version (ms, medians over the rounds) and their median ratio."""
    base, this = (np.array([np.percentile(each, percent) for each in side]) for side in zip(*times, strict=True))
    return {"base_ms": float(np.median(base)), "ms": float(np.median(this)), "ratio": float(np.median(this / base))}


@contextmanager
def checkout(revision: str, folder: Path) -> Iterator[Path]:
    """Checks a commit out, with the links that make its folders subpackages. Raises PerfError."""
    _git("worktree", "add", "--detach", "--quiet", str(folder), revision)
    try:
        for name in ("runtime", "perf", "deploy", "configs"):
            (folder / "birdslam" / name).symlink_to(folder / name)
        yield folder
    finally:
        _git("worktree", "remove", "--force", str(folder))


def _git(*arguments: str) -> None:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PerfError(f"git {' '.join(arguments)}: {done.stderr.strip()}")


def _times(tree: Path, program: str, argument: str) -> list[float]:
    """Runs a program on the packages of a checkout; returns the times that it prints. Raises PerfError."""
    environment = os.environ | {"PYTHONPATH": str(tree)} if tree != ROOT else os.environ
    command = [sys.executable, "-c", program, argument]
    done = subprocess.run(command, env=environment, cwd=tree.parent, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PerfError(f"{tree}: {done.stderr.strip().splitlines()[-1]}")
    times: list[float] = json.loads(done.stdout.splitlines()[-1])
    return times
