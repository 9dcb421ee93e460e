"""The incremental optimizer compared with the batch solver on one sequence: time, and accuracy on the same edges.

    python -m perf incremental [--frames 50,100,200,414] [--vehicles 3] [--seeds 8] [--output F.json]

Time (the paper: 0.016 s versus 1.9 s for 414 frames): all updates versus one batch solve, and one update versus one
batch solve. Accuracy of each pose, RMS over seeds and frames, no alignment: live; gtsam's batch of the same edges; the
batch `--lag` frames later; the batch of the whole sequence. perf/README.md discusses the results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from birdslam.bench.baselines import batch_se3, nair
from birdslam.bench.baselines.posegraph3 import Convergence, solve_batch
from birdslam.bench.tracking.benchmark import PAPER, ours
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.latency import batch_se2
from birdslam.perf.latency.batch_se2 import Solution
from birdslam.perf.latency.drive import Drive, DriveConfig, drive
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.slam import SlamConfig
from birdslam.types import Measurements

label = "batch over incremental: time and accuracy on one sequence"

PUBLISHED_RATIO = 1.9 / 0.016
REPEATS = 3
SAMPLES = 8  # frames of a drive whose poses are compared
EQ_6 = GraphConfig(constant_velocity=False), WeightsConfig(leave_out=("cp",))
WHO = ("incremental", "batch of the same edges", "batch after the lag", "batch of the whole sequence")


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("incremental", label)
    parser.add_argument("--frames", default="50,100,200,414", help="a list")
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0, help="of the timed drive")
    parser.add_argument("--seeds", type=int, default=8, help="number of drives for accuracy; 0: only time")
    parser.add_argument("--lag", type=int, default=10, help="frames")
    options = parser.parse_args(arguments)
    print(f"{'':44} {'frames':>6} {'sequence':>10} {'ratio':>8} {'newest pose':>12} {'ratio':>8}  iterations")
    with Ledger(options.output, label, vehicles=options.vehicles, seeds=options.seeds, lag=options.lag) as ledger:
        for frames in sorted(int(n) for n in options.frames.split(",")):
            config = DriveConfig(frames=frames, vehicles=options.vehicles, rate_hz=10.0)
            for row in time_rows(drive(config, options.seed).measurements):
                times = f"{row['seconds']:8.3f} s {_ratio(row['ratio'])} {row['newest_s'] * 1e3:9.2f} ms"
                line = f"{row['frames']:6} {times} {_ratio(row['newest_ratio'])}  {_ended(row)}"
                ledger.add(row["method"], line, **row)
        print(f"{'published (one figure, either reading)':44} {414:6} {'':10} {PUBLISHED_RATIO:8.1f}")
        ledger.set(accuracy=accuracy_rows(config, options.seeds, options.lag) if options.seeds else [])
    if options.seeds:
        title = f"ATE over {options.seeds} drives, m"
        print(f"\n{title:44} {'ego':>8} {'ratio':>8} {'vehicles':>9} {'ratio':>8}")
    for row in ledger.content["accuracy"]:
        ratios = f"{row['ego_ratio']:8.3f} {row['vehicle_ate_m']:9.3f} {row['vehicle_ratio']:8.3f}"
        print(f"{row['method']:44} {row['ego_ate_m']:8.3f} {ratios}")


# --- time ---


def time_rows(log: Sequence[Measurements]) -> list[dict[str, Any]]:
    """Time of each method for the whole log and for the newest pose, and its ratio to the live graph's."""
    live = {"incremental": ours(SlamConfig()), "incremental, paper mode": PAPER}
    batches = {"batch SE(3), metric odometry": nair.CONFIG, "batch SE(3), unscaled odometry, lanes": batch_se3.CONFIG}
    took: dict[str, tuple[float, float]] = {}
    for name, method in live.items():
        whole = [_updates_s(PoseGraph(method.graph, method.weights), log) for _ in range(REPEATS)]
        took[name] = float(np.median([updates.sum() for updates in whole])), float(np.median(np.concatenate(whole)))
    ended: dict[str, Convergence] = {}
    for name, config in batches.items():
        _, ended[name] = solve_batch(log, config, check=True)
        seconds = float(np.median([_seconds(lambda c=config: solve_batch(log, c)) for _ in range(REPEATS)]))  # type: ignore[misc]
        took[name] = seconds, seconds
    whole_s, newest_s = took["incremental"]
    return [
        {
            "method": name,
            "frames": len(log),
            "seconds": s,
            "ratio": s / whole_s if name not in ended or ended[name].converged else None,
            "newest_s": newest,
            "newest_ratio": newest / newest_s if name not in ended or ended[name].converged else None,
            "iterations": ended[name].iterations if name in ended else None,
            "last_step": ended[name].step if name in ended else None,
            "converged": ended[name].converged if name in ended else None,
        }
        for name, (s, newest) in took.items()
    ]


def _ratio(ratio: float | None) -> str:
    return f"{'-':>8}" if ratio is None else f"{ratio:8.1f}"


def _ended(row: dict[str, Any]) -> str:
    if row["iterations"] is None:
        return ""
    return f"{row['iterations']}, {'converged' if row['converged'] else 'NOT CONVERGED'}"


def _updates_s(graph: PoseGraph, log: Sequence[Measurements]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([_seconds(lambda m=m: graph.optimise(m)) for m in log])  # type: ignore[misc]


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


# --- accuracy ---


def accuracy_rows(config: DriveConfig, seeds: int, lag: int) -> list[dict[str, Any]]:
    """ATE of the ego and of all vehicles per method, and its ratio to that of the batch of the same edges."""
    errors: dict[str, dict[str, list[float]]] = {who: {"ego": [], "vehicle": []} for who in WHO}
    for seed in range(seeds):
        for who, body, error_m in _errors(drive(config, seed), lag):
            errors[who][body].append(error_m)
    ate = {who: {body: float(np.sqrt(np.mean(np.square(e)))) for body, e in of.items()} for who, of in errors.items()}
    same = ate[WHO[1]]
    return [
        {
            "method": who,
            "ego_ate_m": of["ego"],
            "ego_ratio": of["ego"] / same["ego"],
            "vehicle_ate_m": of["vehicle"],
            "vehicle_ratio": of["vehicle"] / same["vehicle"],
        }
        for who, of in ate.items()
    ]


def _errors(world: Drive, lag: int) -> list[tuple[str, str, float]]:
    """(method, body, error in metres) at the sampled frames, for all methods in `WHO`."""
    log, out = world.measurements, []
    graph = PoseGraph(*EQ_6)
    live = [graph.optimise(m) for m in log]
    whole = batch_se2.solve(log, *EQ_6)
    for k in np.linspace(0, len(log) - 1 - lag, SAMPLES + 1).astype(int)[1:].tolist():
        so_far, later = (batch_se2.solve(log[: n + 1], *EQ_6) for n in (k, k + lag))
        answers: list[tuple[str, SE2, list[tuple[int, SE2]]]] = []
        seen = [(v.vehicle, v.T_world_vehicle) for v in live[k].vehicles if v.age_ns == 0]
        answers.append((WHO[0], live[k].T_world_ego, seen))
        batches: tuple[Solution, ...] = (so_far, later, whole)
        for who, batch in zip(WHO[1:], batches, strict=True):
            answers.append((who, batch.ego(k), [(vehicle, batch.vehicle(vehicle, k)) for vehicle, _ in seen]))
        for who, ego, vehicles in answers:
            out.append((who, "ego", _away_m(ego, world.ego[k])))
            out += [(who, "vehicle", _away_m(pose, world.vehicles[vehicle][k])) for vehicle, pose in vehicles]
    return out


def _away_m(pose: SE2, truth: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.hypot(pose.x_m - truth[0], pose.y_m - truth[1]))
