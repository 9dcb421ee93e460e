"""The optimizer against gtsam's own: time, memory and exceptions over a long drive.

Every contender takes the same log of `Measurements` in a fresh process with one BLAS thread, as the optimize node runs.
What is timed is one frame from decoded record to the poses and covariances of the newest ego and of every vehicle in
Python: for ours the whole `PoseGraph.update`, with landmarks, lanes, velocities and the finished `Estimate`; for gtsam
CC, CV and VV factors (Eq. 6) without CP. `BatchFixedLagSmoother` gives no covariances. A contender that takes longer
than `--limit-s` is stopped; its `frames` say how far it got. One that raises begins anew on the next frame.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import gtsam
import msgspec
import numpy as np
import psutil

from birdslam.graph import GraphConfig, PoseGraph
from birdslam.simulation.drive import DriveConfig, drive
from birdslam.types import Measurements
from birdslam.weights import WeightsConfig
from perf.figures import curve, noise, write_json

label = "the pose graph's update against gtsam's smoothers"


class Contender(Protocol):
    def step(self, m: Measurements, /) -> object: ...

    def between(self) -> None: ...


_WARM_UP = 100  # frames before memory is looked at
_PARTS = 50  # of a drive, for the plot over its frames
_PRIOR = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)


def run(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m perf optimizer", description=label)
    parser.add_argument("--vehicles", default="0,1,3,6,10,15", help="in sight, a list")
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--contenders", default=",".join(CONTENDERS), help="a list")
    parser.add_argument("--limit-s", type=float, default=60.0, help="time for each contender's frames")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="JSON, a list of objects")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for vehicles in (int(n) for n in options.vehicles.split(",")):
            log = Path(folder) / f"{vehicles}.log"
            config = DriveConfig(frames=options.frames, vehicles=vehicles, traffic="convoy")
            write_log(log, config, options.seed)
            for contender in options.contenders.split(","):
                row = measure(contender, vehicles, log, options.limit_s)
                rows.append({"name": f"{contender} {vehicles} vehicles", **row})
                print(f"{rows[-1]['name']:44} {told(row)}", flush=True)
                if options.output is not None:
                    write_json(options.output, rows)  # after each: Ctrl-C keeps what was measured


def write_log(log: Path, config: DriveConfig, seed: int) -> None:
    """What every contender takes."""
    records = [msgspec.msgpack.encode(m) for m in drive(config, seed).measurements]
    log.write_bytes(msgspec.msgpack.encode(records))


def told(row: dict[str, Any]) -> str:
    """For a person."""
    times = "  ".join(f"{name} {row[f'{name}_us'] / 1e3:.2f}" for name in ("p50", "p99", "max"))
    grown = f"frames {row['frames']}  memory {row['rss_growth_mb']:+.0f} MB  exceptions {row['exceptions']}"
    return f"{times} ms  {grown}"


def measure(contender: str, vehicles: int, log: Path, limit_s: float) -> dict[str, Any]:
    """One contender in a process of its own."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "perf.optimizer", contender, str(vehicles), str(log), str(limit_s)]
    done = subprocess.run(command, env=os.environ | one_thread, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{contender} with {vehicles} vehicles: {done.stderr}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def _drive_through(contender: str, vehicles: int, log: Path, limit_s: float) -> dict[str, Any]:
    records = msgspec.msgpack.decode(log.read_bytes(), type=list[bytes])
    decoder = msgspec.msgpack.Decoder(Measurements)
    make, lag_frames = CONTENDERS[contender]
    solver, exceptions = make(), 0
    gc.collect()
    gc.freeze()
    process = psutil.Process()
    times_us = np.zeros(len(records))
    rss_before = rss = process.memory_info().rss
    begun_s = time.perf_counter()
    frames = 0
    for frame, record in enumerate(records):
        measurements = decoder.decode(record)
        before_ns = time.perf_counter_ns()
        try:
            solver.step(measurements)
        except RuntimeError:
            exceptions += 1
            solver = make()
        times_us[frame] = (time.perf_counter_ns() - before_ns) / 1e3
        frames = frame + 1
        solver.between()
        if frame == _WARM_UP:
            rss_before = process.memory_info().rss
        if time.perf_counter() - begun_s > limit_s:
            break
    rss = process.memory_info().rss
    times_us = times_us[:frames]
    p50, p99, p999 = np.percentile(times_us, [50.0, 99.0, 99.9])
    return {
        "contender": contender,
        "vehicles": vehicles,
        "frames": frames,
        "lag_frames": lag_frames,
        "p50_us": round(p50, 1),
        "p99_us": round(p99, 1),
        "p999_us": round(p999, 1),
        "max_us": round(times_us.max(), 1),
        "first_thousand_p50_us": round(np.median(times_us[:1000]), 1),
        "last_thousand_p50_us": round(np.median(times_us[-1000:]), 1),
        "rss_growth_mb": round((rss - rss_before) / 2**20, 2),
        "exceptions": exceptions,
        "curve_us": curve(times_us),
        "over_frames_us": [round(float(np.median(part)), 1) for part in np.array_split(times_us, _PARTS) if part.size],
        "noise": noise("time_us", times_us),
    }


# --- the contenders ---


class _Ours:
    def __init__(self) -> None:
        self.graph = PoseGraph(GraphConfig(), WeightsConfig())
        self.step = self.graph.update

    def between(self) -> None:
        """The node publishes the map beside the estimate; it is not part of the update."""
        self.graph.map_update()


class _Gtsam:
    """The graph of Eq. 6 from records, and its newest poses back, by one of gtsam's own incremental solvers."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        params = gtsam.ISAM2Params()
        params.setFactorization("QR" if kind.endswith("qr") else "CHOLESKY")
        params.relinearizeSkip = 1 if kind == "isam2" else 10
        params.findUnusedFactorSlots = True
        self.solver: Any
        if kind == "isam2":
            self.solver = gtsam.ISAM2(params)
        elif kind == "batch_fixed_lag":
            self.solver = gtsam.BatchFixedLagSmoother(_LAG_FRAMES)
        else:
            self.solver = gtsam.IncrementalFixedLagSmoother(_LAG_FRAMES, params)
        self.frame: int | None = None
        self.ego = gtsam.Pose2()
        self.seen: dict[int, int] = {}

    def step(self, m: Measurements) -> list[tuple[gtsam.Pose2, Any]]:
        factors, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.FixedLagSmootherKeyTimestampMap()
        ego = gtsam.symbol("x", m.frame_id)
        if self.frame is None or m.cc is None:
            factors.add(gtsam.PriorFactorPose2(ego, self.ego, _PRIOR))
        else:
            motion = _pose(m.cc.T_from_to)
            factors.add(gtsam.BetweenFactorPose2(gtsam.symbol("x", m.cc.from_frame), ego, motion, _noise(m.cc.cov)))
            self.ego = self.ego.compose(motion)
        values.insert(ego, self.ego)
        stamps.insert((ego, float(m.frame_id)))
        keys = [ego]
        for edge in m.cv:
            key, seen = _vehicle(edge.vehicle, m.frame_id), _pose(edge.T_ego_vehicle)
            factors.add(gtsam.BetweenFactorPose2(ego, key, seen, _noise(edge.cov)))
            values.insert(key, self.ego.compose(seen))
            stamps.insert((key, float(m.frame_id)))
            keys.append(key)
        for link in m.vv:
            if self.frame is not None and self.seen.get(link.vehicle) == link.from_frame == self.frame:
                before, key = _vehicle(link.vehicle, link.from_frame), _vehicle(link.vehicle, m.frame_id)
                factors.add(gtsam.BetweenFactorPose2(before, key, _pose(link.T_from_to), _noise(link.cov)))
        if self.kind == "isam2":
            self.solver.update(factors, values)
        else:
            self.solver.update(factors, values, stamps)
        self.frame, self.seen = m.frame_id, {edge.vehicle: m.frame_id for edge in m.cv}
        poses = [self.solver.calculateEstimatePose2(key) for key in keys]
        self.ego = poses[0]
        if self.kind == "batch_fixed_lag":
            return [(pose, None) for pose in poses]
        return [(pose, self.solver.marginalCovariance(key)) for pose, key in zip(poses, keys, strict=True)]

    def between(self) -> None:
        """Nothing to do between frames."""


def _pose(T: Any) -> gtsam.Pose2:
    return gtsam.Pose2(T.x_m, T.y_m, T.yaw_rad)


def _noise(cov: tuple[float, ...]) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(np.array(cov).reshape(3, 3))


def _vehicle(vehicle: int, frame: int) -> int:
    key: int = gtsam.symbol(chr(ord("A") + vehicle), frame)
    return key


_LAG_FRAMES = GraphConfig().ego_nodes
CONTENDERS: dict[str, tuple[Callable[[], Contender], int | None]] = {
    "ours": (_Ours, _LAG_FRAMES),
    "isam2": (lambda: _Gtsam("isam2"), None),
    "incremental_fixed_lag_qr": (lambda: _Gtsam("incremental_fixed_lag_qr"), _LAG_FRAMES),
    "incremental_fixed_lag_cholesky": (lambda: _Gtsam("incremental_fixed_lag_cholesky"), _LAG_FRAMES),
    "batch_fixed_lag": (lambda: _Gtsam("batch_fixed_lag"), _LAG_FRAMES),
}

if __name__ == "__main__":
    name, count, path, limit = sys.argv[1:]
    print(json.dumps(_drive_through(name, int(count), Path(path), float(limit))))
