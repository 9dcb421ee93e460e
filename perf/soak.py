"""A long drive at the full rate: memory, descriptors, restarts and drops of every process, from the first minute on.

    python -m perf.soak [--minutes 30] [--rate 33] [--models DIR]

Ends with status 1 where a process has grown by more than 1 % (and 2 MiB) or holds more descriptors, or was begun anew.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import psutil

from perf.faulty_vehicle import Vehicle, model_options
from runtime.topology import NODES

WARM_S, SAMPLE_S = 60.0, 5.0
GROWTH, GROWTH_MIB = 0.01, 2.0


def sample(vehicle: Vehicle) -> dict[str, tuple[float, int]]:
    """Process -> resident memory (MiB) and descriptors."""
    processes = {"supervisor": psutil.Process(vehicle.process.pid), **{name: vehicle.node(name) for name in NODES}}
    return {name: (p.memory_info().rss / 2**20, p.num_fds()) for name, p in processes.items()}


def main(arguments: list[str]) -> int:
    """Gives the exit status."""
    parser = argparse.ArgumentParser(prog="python -m perf.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=33.0, metavar="HZ")
    parser.add_argument("--models", type=Path, help="folder of networks")
    options = parser.parse_args(arguments)
    with (
        tempfile.TemporaryDirectory(prefix="soak") as place,
        Vehicle(Path(place), *model_options(options.models), rate_hz=options.rate) as vehicle,
    ):
        begun_s = time.monotonic()
        first: dict[str, tuple[float, int]] = {}
        last: dict[str, tuple[float, int]] = {}
        due_s = begun_s + WARM_S
        while time.monotonic() < begun_s + max(60.0 * options.minutes, WARM_S + SAMPLE_S):
            if vehicle.planner.wait(1.0) is None and vehicle.process.poll() is not None:
                print("the run has ended by itself")
                return 1
            if time.monotonic() >= due_s:
                due_s += SAMPLE_S
                last = sample(vehicle)
                first = first or last
        vehicle.stop()
        summary = json.loads((vehicle.output / "summary.json").read_text())
    print(f"{'process':12}{'MiB at 1 min':>14}{'MiB at end':>12}{'growth':>9}{'descriptors':>16}")
    bad = bool(sum(summary["restarts"].values()))
    for name, (mib, fds) in last.items():
        before_mib, before_fds = first[name]
        growth = mib / before_mib - 1.0
        bad = bad or (growth > GROWTH and mib - before_mib > GROWTH_MIB) or fds > before_fds
        print(f"{name:12}{before_mib:14.1f}{mib:12.1f}{growth:9.2%}{before_fds:8} -> {fds:4}")
    print(f"frames {summary['frames_in']}, dropped {summary['dropped_by']}, restarts {summary['restarts']}")
    print(f"rate {summary['rate_hz']} Hz, age {summary['age_ms']} ms, budget {summary['budget']}")
    return int(bad)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
