"""Runs all benchmarks, each in a fresh process, and writes a short report.

    python -m perf all --output DIR [--source URI] [--model ROLE=PATH]...

The default source is the shipped drive with the shipped network. DIR gets the JSON of each benchmark, and report.md has
what they print. After Ctrl-C the report has the results so far and names the missing ones. Takes about 20 minutes.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.machine import describe, describe_text
from birdslam.runtime.environment import INTERRUPTED_STATUS

label = "all benchmarks, and their report"

END_S = 60.0  # time for a benchmark to save its results


@dataclass(frozen=True)
class Step:
    """One benchmark with its options."""

    file: str
    benchmark: str
    options: str
    on_source: bool = False


STEPS = (
    Step("system", "system", "--seconds 120", on_source=True),
    Step("system-loaded", "system", "--seconds 60 --load 1", on_source=True),
    Step(
        "optimizer",
        "optimizer",
        "--frames 10000 --vehicles 0,5,10,15 --limit-s 15 --contenders ours,isam2,incremental_fixed_lag_qr",
    ),
    Step("batch", "optimizer", "--batch 200"),
    Step("transport", "transport", "--seconds 0.8"),
)


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("all", label, output="")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--source", default="demo", metavar="URI", help="default: demo, the shipped drive")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="default: the shipped one")
    parser.add_argument("--only", default="", help="a list of steps: " + ",".join(step.file for step in STEPS))
    options = parser.parse_args(arguments)
    only = options.only.split(",") if options.only else [step.file for step in STEPS]
    unknown = sorted(set(only) - {step.file for step in STEPS})
    if unknown:
        parser.error(f"{unknown[0]!r} is not a step")
    options.output.mkdir(parents=True, exist_ok=True)
    command = f"python -m perf {shlex.join(sys.argv[1:])}"
    parts = [f"# BirdSLAM's performance on this machine\n\n    {command}\n\n{describe_text(describe())}"]
    chosen = [step for step in STEPS if step.file in only]
    outcomes = []
    for number, step in enumerate(chosen, 1):
        print(f"\n[{number}/{len(chosen)}] {step.file}", flush=True)
        begun_s = time.monotonic()
        outcome, printed = run_step(step, options)
        print(f"[{number}/{len(chosen)}] {step.file}: {outcome} in {time.monotonic() - begun_s:.0f} s")
        parts.append(f"## {step.file}: {outcome}\n\n```text\n{printed.strip()}\n```")
        (options.output / "report.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        if outcome == "interrupted":
            return INTERRUPTED_STATUS
        outcomes.append(outcome)
    return int(any(outcome.startswith("failed") for outcome in outcomes))


def run_step(step: Step, options: argparse.Namespace) -> tuple[str, str]:
    """Runs a step, with its output on the terminal; returns its outcome and the output."""
    file = options.output / f"{step.file}.json"
    file.unlink(missing_ok=True)
    command = [sys.executable, "-m", "birdslam.perf", step.benchmark, "--output", str(file)]
    command += shlex.split(step.options)
    if step.on_source:
        command += ["--source", options.source, *(part for model in options.model for part in ("--model", model))]
    printed = []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            print(line, end="", flush=True)
            printed.append(line)
        status = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        try:
            printed.append(process.communicate(timeout=END_S)[0])
        finally:
            process.kill()
        return "interrupted", "".join(printed)
    if status == 0:
        return "complete", "".join(printed)
    missed = status == 1 and file.is_file()
    return "complete, but a budget or bound is not met" if missed else f"failed ({status})", "".join(printed)
