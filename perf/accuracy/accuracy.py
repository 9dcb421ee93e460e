"""How accurate the system is: offline, where no frame is dropped, and live at a rate and under load.

    python -m perf accuracy [--source demo] [--source kitti:DIR] [--labels DIR] [--load 1] [--output F.json]

One table. Of each source: the odometry against its true poses and, on the shipped drive, the vehicles against theirs,
of `birdslam run --rate max` (the bytes of `birdslam evaluate odometry`) and of live runs, whose rows of dropped frames
hold the last pose; all by the same functions. Of the labels of KITTI tracking: `birdslam evaluate localisation` and
`birdslam evaluate tracking`; they read boxes, not images, so no load can change them. What is missing is a row.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.bench.ego.trajectory_errors import OdometryReport, compare, from_first, in_camera0
from birdslam.bench.tracking.benchmark import EGO as EGO_BODY
from birdslam.perf.errors import PerfError
from birdslam.perf.latency.live import add_run_options, drive, once, setting_options
from birdslam.perf.latency.system import age_of
from birdslam.perf.processes import run_birdslam
from birdslam.perf.reporting.arguments import benchmark_parser, numbers
from birdslam.perf.reporting.figures import Ledger, spread
from birdslam.runtime.doctor.costs import busy_cores
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import as_poses, read_kitti

label = "errors of ego, vehicles and places offline, beside the live run under real-time load"

EGO = ("ate_m", "ate_se3_m", "scale_error", "rpe_t_m", "rpe_r_deg")
VEHICLES = ("vehicle_ate_m", "vehicle_centre_rel", "found", "reported", "false_movers", "missed_movers")
COLUMNS = (*EGO, *VEHICLES)
SEQUENCES = "0000,0001,0002,0003,0004,0005,0006,0008"  # of KITTI tracking, with detections
SEEDS = 2  # of the simulated odometry

Row = dict[str, Any]


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("accuracy", label)
    add_run_options(parser.add_argument, many=True)
    parser.add_argument("--labels", type=Path, help="KITTI tracking's training folder")
    parser.add_argument("--rates", type=numbers, default=(33,), help="Hz of the live runs beside the source's own")
    parser.add_argument("--load", type=int, default=1, help="busy cores in one more run at the highest rate; 0: none")
    options = parser.parse_args(arguments)
    sources = options.source or ["demo"]
    with Ledger(options.output, label, sources=sources, models=options.model, labels=str(options.labels)) as ledger:
        for source in sources:
            _source(ledger, options, source)
        for name, measure in (("localisation", _localisation), ("tracking", _tracking)) if options.labels else ():
            _labels(ledger, options.labels, name, measure)


def _source(ledger: Ledger, options: argparse.Namespace, source: str) -> None:
    name = source if ":" not in source else f"{source.partition(':')[0]}:{Path(source).name}"
    try:
        recording = open_recording(source)
    except DatasetError as error:
        _missing(ledger, name, str(error))
        return
    if recording.truth_poses() is None:
        _missing(ledger, name, "has no true poses to compare with")
        return
    row = _offline(options, source, recording)
    ledger.add(
        f"{name} offline", summary(row), **row, exact={key: row[key] for key in COLUMNS if row.get(key) is not None}
    )
    rates = sorted({round(recording.rate_hz), *options.rates})
    for rate, load in [(rate, 0) for rate in rates] + ([(rates[-1], options.load)] if options.load else []):
        with busy_cores(load), drive(once(options, source, recording, rate)) as result:
            row = graded(recording, result.place / "out", result.summary)
            ages_ms = [age_of(message) for message in result.messages]
            row |= {"epochs": len({m.record.epoch for m in result.messages}), "age_ms": spread(ages_ms)}
            beside = f", {load} busy" if load else ""
            ledger.add(f"{name} live {rate} Hz{beside}", summary(row), rate_hz=rate, load=load, **row)
            if not result.complete:
                raise KeyboardInterrupt


def _missing(ledger: Ledger, name: str, reason: str) -> None:
    ledger.add(name, f"missing: {reason}", missing=reason)


def _offline(options: argparse.Namespace, source: str, recording: Recording) -> Row:
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        given = ["run", *([options.config] if options.config else []), "--source", source, "--rate", "max"]
        given += [part for model in options.model for part in ("--model", model)]
        given += setting_options(options.set)
        given += ["--set", f"runtime.runtime_dir={folder}/rt", "--vehicle", "perf", "--output", f"{folder}/out"]
        (Path(folder) / "rt").mkdir(mode=0o700)
        run_birdslam(*given)
        out = Path(folder) / "out"
        return graded(recording, out, json.loads((out / "summary.json").read_text()))


def graded(recording: Recording, output: Path, summary: Row) -> Row:
    """A run's files in `output` against the truth of its recording."""
    truth = recording.truth_poses()
    assert truth is not None
    rows = as_poses(read_kitti(output / "ego.kitti.txt"))
    estimated = in_camera0(rows, recording.T_cam0_cam())
    goal = from_first(as_poses(truth[: len(estimated)]))  # frames that were dropped at the very end have no row
    report: OdometryReport = compare(recording.name, goal, estimated, summary["statuses"])
    errors = {name: msgspec.structs.asdict(report)[name] for name in ("frames", *EGO, "statuses")}
    of_vehicles = {name: summary["truth"][name] for name in VEHICLES} if "truth" in summary else {}
    return {**errors, **of_vehicles, "dropped": summary["frames_dropped"]}


def _labels(ledger: Ledger, labels: Path, name: str, measure: Callable[[Path, Path], dict[str, Row]]) -> None:
    """The rows of an evaluation against labels."""
    if not labels.is_dir():
        _missing(ledger, name, f"{labels}: no such directory")
        return
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        try:
            rows = measure(labels, Path(folder))
        except PerfError as error:
            _missing(ledger, name, str(error))
            return
    for row_name, row in rows.items():
        exact = {key: value for key, value in row.items() if isinstance(value, float)}
        ledger.add(f"{name} {row_name}", summary(row), **row, exact=exact)


def _localisation(labels: Path, folder: Path) -> dict[str, Row]:
    """Range -> medians of the centres' errors over all sequences."""
    given = ("evaluate", "localisation", str(labels), "--sequences", SEQUENCES, "--detections", "rrc")
    run_birdslam(*given, "--output", str(folder / "out"))
    rows = json.loads((folder / "out" / "report.json").read_text())
    return {
        f"{row['range']} m": {"frames": row["n"], "vehicle_centre_rel": row["depth_error_median_rel"]}
        for row in rows
        if row["sequence"] == "all"
    }


def _tracking(labels: Path, folder: Path) -> dict[str, Row]:
    """Method -> mean of the egos' errors, median of the vehicles', on simulated odometry."""
    methods = {"birdslam": "as configured", "paper": "as published"}
    given = ("evaluate", "tracking", str(labels), "--frames", "paper", "--seeds", str(SEEDS))
    run_birdslam(*given, "--methods", ",".join(methods), "--output", str(folder / "out"))
    rows = json.loads((folder / "out" / "report.json").read_text())
    out: dict[str, Row] = {}
    for method, name in methods.items():
        egos = [row for row in rows if row["method"] == method and row["body"] == EGO_BODY]
        vehicles = [row for row in rows if row["method"] == method and row["body"] != EGO_BODY]
        out[name] = {
            "frames": round(sum(row["frames"] for row in egos)),
            **{key: float(np.mean([row[key] for row in egos])) for key in ("ate_m", "rpe_t_m", "rpe_r_deg")},
            "vehicle_ate_m": float(np.median([row["ate_m"] for row in vehicles])),
        }
    return out


def summary(row: Row) -> str:
    """For a person."""
    errors = "  ".join(f"{name} {row[name]:.4g}" for name in COLUMNS if row.get(name) is not None)
    return errors + (f"  dropped {row['dropped']} frames" if "dropped" in row else "")
