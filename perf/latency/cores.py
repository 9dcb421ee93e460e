"""The system on one, two and four cores of this computer, by affinity: what it carries and what that costs in accuracy.

    python -m perf cores [--source demo] [--cores 1,2,4] [--rate 33] [--load 0] [--output F.json]

The source runs once from its beginning to its end on the first so many cores that this process may use; this process,
which is its planner, has the same. More cores than there are is a row that says so.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Iterator
from typing import Any

from birdslam.perf.accuracy.accuracy import graded
from birdslam.perf.latency.live import add_run_options, drive, once
from birdslam.perf.latency.system import figures
from birdslam.perf.reporting.arguments import benchmark_parser, numbers
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.doctor.costs import busy_cores
from birdslam.sources.opening import open_recording

label = "rate, drops, age, vehicles found and the ego's error on 1, 2 and 4 cores, by affinity"

KEPT = (
    "rate_hz",
    "frames",
    "dropped",
    "predicted",
    "coasted",
    "cpu_cores",
    "rss_mb",
    "pss_mb",
    "age_ms",
    "stages",
    "noise",
)


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("cores", label)
    add_run_options(parser.add_argument)
    parser.add_argument("--cores", type=numbers, default=(1, 2, 4), help="a list")
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--load", type=int, default=0, help="so many busy processes on the same cores")
    options = parser.parse_args(arguments)
    there = len(os.sched_getaffinity(0))
    with Ledger(options.output, label, source=options.source, rate=options.rate, load=options.load) as ledger:
        for cores in options.cores:
            name = f"{cores} cores" if cores > 1 else "1 core"
            if cores > there:
                reason = f"{there} cores are at hand"
                ledger.add(name, f"missing: {reason}", cores=cores, missing=reason)
                continue
            with on_first(cores), busy_cores(options.load):
                row, complete = measure(options)
            ledger.add(name, summary(row), cores=cores, **row)
            if not complete:
                raise KeyboardInterrupt


@contextlib.contextmanager
def on_first(cores: int) -> Iterator[None]:
    """A context: this process and its children run on the first `cores` of its cores."""
    all_of_them = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(all_of_them)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, all_of_them)


def measure(options: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """One run's figures, and whether it went to its end."""
    recording = open_recording(options.source)
    with drive(once(options, options.source, recording, options.rate)) as result:
        graded_row: dict[str, Any] = {}
        if recording.truth_poses() is not None:
            graded_row = graded(recording, result.place / "out", result.summary)
        measured = figures(result)
        return {**graded_row, **{name: measured[name] for name in KEPT}}, result.complete


def summary(row: dict[str, Any]) -> str:
    """For a person."""
    age = row["age_ms"]
    parts = [
        f"{row['rate_hz']:.1f} Hz",
        f"dropped {row['dropped']} of {row['frames']}, predicted {row['predicted']}, coasted {row['coasted']}",
        f"age p50 {age['p50']:.1f} p99 {age['p99']:.1f} ms",
        f"{row['cpu_cores']:.2f} cores",
        f"{row['rss_mb']:.0f} MB, shared once {row['pss_mb'] or 0:.0f}",
    ]
    if "found" in row:
        parts.append(f"vehicles seen in the very frame {row['found']:.0%}, reported {row['reported']:.0%}")
    if "ate_m" in row:
        parts.append(f"ATE {row['ate_m']:.2f} m")
    return "  ".join(parts)
