"""Runs all benchmarks, each in a fresh process, and writes a short report.

    python -m perf all --output DIR [--source URI] [--model ROLE=PATH]... [--thorough]

The default source is the shipped drive with the shipped network. DIR gets report.json, report.md and the JSON of each
benchmark. After Ctrl-C the report has the results so far and names the missing ones. Takes about 20 minutes without
`--thorough`.
"""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from birdslam.perf.reporting import report
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import write_json
from birdslam.perf.reporting.machine import describe

label = "all benchmarks, and their report"

END_S = 60.0  # time for a benchmark to save its results


@dataclass(frozen=True)
class Step:
    """One benchmark with its options for a quick and for a thorough run."""

    file: str
    benchmark: str
    quick: str
    thorough: str
    on_source: bool = False


STEPS = (
    Step("system", "system", "--seconds 120", "--seconds 600", on_source=True),
    Step("system-loaded", "system", "--seconds 60 --load 1", "--seconds 120 --load 1", on_source=True),
    Step("system-planners", "system", "--seconds 10 --planners 4", "--seconds 60 --planners 4", on_source=True),
    Step(
        "optimizer",
        "optimizer",
        "--frames 10000 --vehicles 0,5,10,15 --limit-s 15 --contenders ours,isam2,incremental_fixed_lag_qr",
        "--frames 10000 --limit-s 60",
    ),
    Step("batch", "optimizer", "--batch 200", "--batch 50,100,200,414"),
    Step("transport", "transport", "--seconds 0.8", "--seconds 10"),
)


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("all", label, output="")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--source", default="demo", metavar="URI", help="default: demo, the shipped drive")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="default: the shipped one")
    parser.add_argument("--thorough", action="store_true", help="longer runs, for publication")
    parser.add_argument("--only", default="", help="a list of steps: " + ",".join(step.file for step in STEPS))
    options = parser.parse_args(arguments)
    only = options.only.split(",") if options.only else [step.file for step in STEPS]
    unknown = sorted(set(only) - {step.file for step in STEPS})
    if unknown:
        parser.error(f"{unknown[0]!r} is not a step")
    options.output.mkdir(parents=True, exist_ok=True)
    command = f"python -m perf {shlex.join(sys.argv[1:])}"
    head = {"command": command, "source": options.source, "models": options.model, "machine": describe()}
    outcome: dict[str, str] = {}
    chosen = [step for step in STEPS if step.file in only]
    for number, step in enumerate(chosen, 1):
        print(f"\n[{number}/{len(chosen)}] {step.file}", flush=True)
        begun_s = time.monotonic()
        outcome[step.file] = run_step(step, options)
        print(f"[{number}/{len(chosen)}] {step.file}: {outcome[step.file]} in {time.monotonic() - begun_s:.0f} s")
        _write(options.output, head, outcome)
        if outcome[step.file] == "interrupted":
            return 130
    return int(any(how.startswith("failed") for how in outcome.values()))


def run_step(step: Step, options: argparse.Namespace) -> str:
    """Runs a step, with its output on the terminal; returns its outcome."""
    file = options.output / f"{step.file}.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, "-m", "birdslam.perf", step.benchmark, "--output", str(file)]
    command += shlex.split(step.thorough if options.thorough else step.quick)
    if step.on_source:
        command += ["--source", options.source, *(part for model in options.model for part in ("--model", model))]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        status = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(END_S)
        finally:
            process.kill()
        return "interrupted"
    if status == 0:
        return "complete"
    return "complete, but a budget or bound is not met" if status == 1 and file.is_file() else f"failed ({status})"


def _write(folder: Path, head: dict[str, Any], outcome: dict[str, str]) -> None:
    """Writes the report, after each step."""
    benchmarks = {}
    for name in outcome:
        file = folder / f"{name}.json"
        if file.is_file():
            benchmarks[name] = json.loads(file.read_text(encoding="utf-8"))
    content = {**head, "outcome": outcome, "benchmarks": benchmarks}
    write_json(folder / "report.json", content)
    report.write(folder, content)
