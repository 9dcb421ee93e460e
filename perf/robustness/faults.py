"""The fault suite: a running vehicle, one fault after the other, and what its planner sees of each.

    python -m perf faults [--models DIR] [--markdown FILE] [NAME ...]

Each row: how long until the planner has a valid estimate again (from the fault's beginning where a process is hit, from
its end where the world is), the statuses meanwhile, how far the poses that were marked valid were off, and whether
anything was marked valid that was not: by its own status, or by where the car really was (perf/robustness/judge.py).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from birdslam.perf.accuracy.street import FRAME_M
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.machine import describe
from birdslam.perf.robustness.faulty_vehicle import (
    PATIENCE_S,
    Vehicle,
    ends_with_its_vehicle,
    model_options,
    record_options,
)
from birdslam.perf.robustness.injection import FAULTS, Fault
from birdslam.perf.robustness.judge import Judge
from birdslam.types import Estimate

label = "a running vehicle, one fault after the other, and what its planner sees of each"

PAGE = """\
# Faults

Made by `make faults`, which breaks a running vehicle in {faults} ways and looks on as its planner. A test holds the
rows to the suite (`perf/robustness/injection.py` has the faults, `perf/robustness/judge.py` the planner that judges).

{machine}

*Valid again after* counts from the fault's beginning where it hits a process, and from its end where it hits the world
(a camera that is gone, frames that come late). *Off by* is the largest distance between a pose that was called valid
and where the car was. A *wrong pose* was called valid and off by more than 5 % of the way; a *wrongly valid* one came
while nothing could be known.

{table}
"""
BEFORE_S, AFTER_S = 0.3, 1.5  # so long before and after, estimates are collected: a wrong pose may come late


@dataclass
class Row:
    """One line of the table."""

    fault: str
    node: str
    valid_after_ms: float | None
    seen: str
    error_m: float
    wrong_poses: int
    wrongly_valid: int
    backwards: int
    promise_s: float | None = None


def measure(vehicle: Vehicle, fault: Fault) -> Row:
    """One fault, from before its beginning until the planner drives on."""
    judge = Judge(vehicle.truth_m, FRAME_M)

    def observe(estimate: Estimate | None) -> bool:
        judge.see(estimate)
        return False

    vehicle.watch(observe, BEFORE_S)
    begun_ns = time.monotonic_ns()
    with fault.inject(vehicle):
        if fault.lasts_s:
            vehicle.watch(observe, fault.lasts_s)
        ended_ns = time.monotonic_ns()
    blind = (begun_ns + 3 * vehicle.period_ns, ended_ns - vehicle.period_ns) if fault.blind else None

    def well(estimate: Estimate | None) -> bool:
        judge.see(estimate)
        return estimate is not None and estimate.valid and estimate.t_capture_ns >= ended_ns

    # A fault of a process is over when it begins: it counts from there; one of the world counts from its end
    back = vehicle.watch(well, PATIENCE_S)
    after_ms = (judge.estimates[-1][0] - ended_ns) / 1e6 if back else None
    seen = judge.summary()
    vehicle.watch(observe, AFTER_S)
    return Row(
        fault=fault.name,
        node=fault.node,
        valid_after_ms=after_ms,
        seen=seen,
        error_m=judge.error_m,
        wrong_poses=judge.wrong,
        wrongly_valid=judge.wrongly_valid(blind),
        backwards=judge.backwards,
        promise_s=fault.promise_s,
    )


def page(rows: list[Row]) -> str:
    """A page: the table with its head."""
    m = describe()
    machine = f"Measured {m['utc']} on {m['cpu']}, {m['cores']} cores, {m['kernel']}, at commit {m['commit']}."
    return PAGE.format(faults=len(rows), machine=machine, table=markdown(rows))


def markdown(rows: list[Row]) -> str:
    """The table of such a page."""
    lines = [
        "| fault | hits | valid again after | what the planner saw meanwhile "
        "| valid poses off by | wrong poses | wrongly valid |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        after = "not within its patience" if row.valid_after_ms is None else f"{row.valid_after_ms:.0f} ms"
        promise = f" (promise {row.promise_s:g} s)" if row.promise_s else ""
        back = f"; frame numbers fell {row.backwards} times" if row.backwards else ""
        lines.append(
            f"| {row.fault} | {row.node} | {after}{promise} | {row.seen}{back} | {row.error_m:.1f} m | "
            f"{row.wrong_poses} | {row.wrongly_valid} |"
        )
    return "\n".join(lines)


def run(arguments: list[str]) -> int:
    """0 where every fault was survived, within its promise, and nothing wrong was marked valid."""
    parser = benchmark_parser("faults", label, output="")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only faults whose name contains one of these")
    parser.add_argument("--models", type=Path, help="folder of networks, for perceive to carry their weight")
    parser.add_argument("--markdown", type=Path, help="the page goes there, table and head")
    options = parser.parse_args(arguments)
    ends_with_its_vehicle()
    chosen = [f for f in FAULTS if not options.names or any(name in f"{f.name} {f.node}" for name in options.names)]
    rows: list[Row] = []
    with (
        tempfile.TemporaryDirectory(prefix="faults") as place,
        Vehicle(Path(place), *model_options(options.models), *record_options(Path(place))) as vehicle,
    ):
        for number, fault in enumerate(chosen):
            if number:
                vehicle.settle()
            rows.append(measure(vehicle, fault))
            print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    print(f"\n{markdown(rows)}")
    if options.markdown:
        options.markdown.write_text(page(rows))
    return int(not all(survived(row) for row in rows))


def survived(row: Row, slack: float = 1.0) -> bool:
    """Valid again, within its promise (times `slack`), nothing marked valid that was not, no frame number fell."""
    limit_ms = None if row.promise_s is None else row.promise_s * slack * 1e3
    in_time = row.valid_after_ms is not None and (limit_ms is None or row.valid_after_ms <= limit_ms)
    return in_time and row.wrongly_valid == 0 and row.wrong_poses == 0 and row.backwards == 0
