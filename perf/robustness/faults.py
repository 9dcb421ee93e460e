"""The fault suite: injects faults into a running vehicle and records what its planner receives.

    python -m perf faults [--models DIR] [--markdown FILE] [NAME ...]

Each row has the time until the next valid estimate (from the start of a fault of a process, from the end of a fault of
the environment), the statuses, the error of valid poses, and the number of wrong valid ones (judge.py).
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
    exit_on_sigterm,
    model_options,
    record_options,
)
from birdslam.perf.robustness.injection import FAULTS, Fault
from birdslam.perf.robustness.judge import Judge
from birdslam.types import Estimate

label = "faults of a running vehicle, and what its planner receives"

PAGE = """\
# Faults

Written by `make faults`, which injects {faults} faults into a running vehicle (`perf/robustness/injection.py`) and
evaluates the estimates at its planner (`perf/robustness/judge.py`).

{machine}

*Valid again after* counts from the start of a fault of a process, and from the end of a fault of the environment
(a missing camera, late frames). *Off by* is the largest error of a pose marked valid. A *wrong pose* is marked valid
with an error over 5 % of the distance travelled; a *wrongly valid* one is marked valid without any usable image.

{table}
"""
BEFORE_S, AFTER_S = 0.3, 1.5  # estimates are collected this long before and after: a wrong pose may come late


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
    """Injects one fault and observes until estimates are valid again."""
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

    def is_well(estimate: Estimate | None) -> bool:
        judge.see(estimate)
        return estimate is not None and estimate.valid and estimate.t_capture_ns >= ended_ns

    # Time counts from the start of a fault of a process, from the end of a fault of the environment
    back = vehicle.watch(is_well, PATIENCE_S)
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
    """The page with the table."""
    m = describe()
    machine = f"Measured {m['utc']} on {m['cpu']}, {m['cores']} cores, {m['kernel']}, at commit {m['commit']}."
    return PAGE.format(faults=len(rows), machine=machine, table=markdown(rows))


def markdown(rows: list[Row]) -> str:
    """The table."""
    lines = [
        "| fault | hits | valid again after | what the planner received "
        "| valid poses off by | wrong poses | wrongly valid |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        after = "not within the time limit" if row.valid_after_ms is None else f"{row.valid_after_ms:.0f} ms"
        promise = f" (promise {row.promise_s:g} s)" if row.promise_s else ""
        back = f"; frame numbers fell {row.backwards} times" if row.backwards else ""
        lines.append(
            f"| {row.fault} | {row.node} | {after}{promise} | {row.seen}{back} | {row.error_m:.1f} m | "
            f"{row.wrong_poses} | {row.wrongly_valid} |"
        )
    return "\n".join(lines)


def run(arguments: list[str]) -> int:
    """Returns 0 if the vehicle survived every fault in time and no wrong estimate was marked valid."""
    parser = benchmark_parser("faults", label, output="")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only faults whose name contains one of these")
    parser.add_argument("--models", type=Path, help="folder of networks for perceive")
    parser.add_argument("--markdown", type=Path, help="file for the page")
    options = parser.parse_args(arguments)
    exit_on_sigterm()
    chosen = [f for f in FAULTS if not options.names or any(name in f"{f.name} {f.node}" for name in options.names)]
    rows: list[Row] = []
    with (
        tempfile.TemporaryDirectory(prefix="faults") as place,
        Vehicle(Path(place), *model_options(options.models), *record_options(Path(place))) as vehicle,
    ):
        for number, fault in enumerate(chosen):
            if number:
                vehicle.wait_until_valid()
            rows.append(measure(vehicle, fault))
            print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    print(f"\n{markdown(rows)}")
    if options.markdown:
        options.markdown.write_text(page(rows))
    return int(not all(survived(row) for row in rows))


def survived(row: Row, slack: float = 1.0) -> bool:
    """Whether estimates were valid again in time (times `slack`), none wrongly, and frame numbers never fell."""
    limit_ms = None if row.promise_s is None else row.promise_s * slack * 1e3
    in_time = row.valid_after_ms is not None and (limit_ms is None or row.valid_after_ms <= limit_ms)
    return in_time and row.wrongly_valid == 0 and row.wrong_poses == 0 and row.backwards == 0
