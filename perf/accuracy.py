"""The trajectory offline, where nothing is lost, beside live runs at a rate and under load, with what they dropped.

    python -m perf accuracy --source kitti:DIR --model detector=F.onnx [--rates 10,33] [--load 1] [--output F.json]

Offline is `birdslam evaluate odometry`; live is `birdslam run`, whose rows of dropped frames hold the last pose. Both
against KITTI's truth by the same functions. Localisation and tracking read labels, not images: their tables don't
change under load, and come from `birdslam evaluate localisation` and `birdslam evaluate tracking`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgspec

from birdslam.datasets import DatasetError, Recording, open_recording
from birdslam.evaluation import OdometryReport, compare, from_first, in_camera0
from birdslam.trajectory import as_poses, read_kitti
from perf.errors import PerfError
from perf.figures import Ledger, numbers, spread
from perf.live import DEMO, Ask, Run, add_run_options, drive
from perf.machine import loaded
from perf.system import age_of

label = "the odometry's errors offline, beside the live run under real-time load"

COLUMNS = ("ate_m", "ate_se3_m", "scale_error", "rpe_t_m", "rpe_r_deg")


def run(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m perf accuracy", description=label)
    add_run_options(parser.add_argument)
    parser.add_argument("--rates", type=numbers, default=(10, 33), help="Hz of the live runs, a list")
    parser.add_argument("--load", type=int, default=1, help="busy cores in one more run at the highest rate; 0: none")
    parser.add_argument("--output", type=Path, help="JSON")
    options = parser.parse_args(arguments)
    if options.source.partition(":")[0] == "demo":
        raise PerfError(DEMO)
    try:
        recording = open_recording(options.source)
    except DatasetError as error:
        raise PerfError(str(error)) from error
    if recording.truth_poses() is None:
        raise PerfError(f"{options.source}: has no true poses to compare with")
    with Ledger(options.output, label, source=options.source, models=options.model) as ledger:
        offline = _offline(options)
        exact = {name: offline[name] for name in COLUMNS if offline[name] is not None}  # it repeats to the bit
        ledger.add("offline", _told(offline), **offline, exact=exact)
        runs = [(rate, 0) for rate in options.rates] + ([(max(options.rates), options.load)] if options.load else [])
        for rate, load in runs:
            with loaded(load), drive(_ask(options, recording, rate)) as result:
                row = _live(result, recording)
                beside = f", {load} busy" if load else ""
                ledger.add(f"live {rate} Hz{beside}", _told(row), rate_hz=rate, load=load, **row)
                if not result.complete:
                    raise KeyboardInterrupt


def _ask(options: argparse.Namespace, recording: Recording, rate: float) -> Ask:
    return Ask(
        source=options.source,
        rate=rate,
        seconds=len(recording) / rate,
        models=tuple(options.model),
        settings=tuple(options.set),
        config=options.config,
        loop=False,
    )


def _offline(options: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        command = [sys.executable, "-m", "runtime.cli", "evaluate", "odometry", options.source, "--output", folder]
        command += ["--config", options.config] if options.config else []
        command += [part for model in options.model for part in ("--model", model)]
        command += [part for setting in options.set for part in ("--set", setting)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise PerfError(done.stderr.strip())
        report = json.loads((Path(folder) / "report.json").read_text())[0]
    return {**{name: report[name] for name in ("frames", *COLUMNS)}, "dropped": 0, "statuses": report["statuses"]}


def _live(result: Run, recording: Recording) -> dict[str, Any]:
    truth = recording.truth_poses()
    assert truth is not None
    rows = as_poses(read_kitti(result.place / "out" / "ego.kitti.txt"))
    estimated = in_camera0(rows, recording.T_cam0_cam())
    goal = from_first(as_poses(truth[: len(estimated)]))  # frames that were dropped at the very end have no row
    report: OdometryReport = compare(recording.name, goal, estimated, result.summary["statuses"])
    errors = {name: msgspec.structs.asdict(report)[name] for name in ("frames", *COLUMNS, "statuses")}
    ages_ms = [age_of(message) for message in result.messages]
    epochs = len({message.record.epoch for message in result.messages})
    return {**errors, "dropped": result.summary["frames_dropped"], "epochs": epochs, "age_ms": spread(ages_ms)}


def _told(row: dict[str, Any]) -> str:
    errors = "  ".join(f"{name} {row[name]:.4g}" for name in COLUMNS if row[name] is not None)
    return f"{errors}  dropped {row['dropped']} frames"
