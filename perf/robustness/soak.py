"""A long drive: growth of memory, descriptors and age per hour with its sigma; watchdogs and drops.

    python -m perf soak [--minutes 30] [--rate 33] [--source demo] [--map] [--record] [--models DIR] [...]

Other options are those of `birdslam run`; the default source is the fault suite's software camera. Exits with 1 if
after the first minute a process grew by over 1 %, would do so in eight hours at the rate of the second half (beyond 3
sigma), held more descriptors, restarted or missed a watchdog, or if the age of estimates grew. Replaces systemd.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import ArrayLike

from birdslam.loops.map_file import MapError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.robustness.faulty_vehicle import Vehicle, exit_on_sigterm, model_options, record_options
from birdslam.runtime.maps.map_store import read_map
from birdslam.runtime.transport.closing import Closing

label = "memory, descriptors, watchdogs and drops of every process over a long drive"

MAP_FILE = "soak.map"
WARM_S, SAMPLE_S, PRINT_S = 60.0, 5.0, 30.0
BLOCKS = 10  # consecutive parts of a series, for slopes
SPAN = 6  # samples at either end whose medians are compared, to average garbage collection
GROWTH = 0.01
SHIFT_H = 8.0  # duration for the extrapolation of the second half
SIGMAS = 3.0  # min. significance of growth
AGE_GROWTH = 0.1  # max. growth of the median age, first to last quarter
WATCHDOG_S = 5.0  # of the supervisor, as in deploy/birdslam.service


class Systemd(Closing):
    """Receives the supervisor's notifications (sd_notify), and measures the gaps between them; a context manager."""

    def __init__(self, place: Path) -> None:
        self.longest_s, self.missed = 0.0, 0
        self._address = str(place / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._address)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables of the supervisor."""
        return {"NOTIFY_SOCKET": self._address, "WATCHDOG_USEC": str(round(WATCHDOG_S * 1e6))}

    def _listen(self) -> None:
        last_s: float | None = None
        while message := self._socket.recv(4096):
            now_s = time.monotonic()
            if b"READY=1" in message or b"WATCHDOG=1" in message:
                if last_s is not None:
                    self.longest_s = max(self.longest_s, now_s - last_s)
                    self.missed += now_s - last_s > WATCHDOG_S
                last_s = now_s
            if b"STOPPING=1" in message:
                last_s = None

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
            end.sendto(b"", self._address)
        self._thread.join()
        self._socket.close()


@dataclass
class Series:
    """Samples of one process after the first minute."""

    t_s: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)
    pids: set[int] = field(default_factory=set)

    def ends(self) -> tuple[float, float]:
        """Resident memory (MiB) at start and end."""
        span = max(1, min(SPAN, len(self.mib) // 2))
        return float(np.median(self.mib[:span])), float(np.median(self.mib[-span:]))

    @property
    def growth(self) -> float:
        before, after = self.ends()
        return after / before - 1.0

    def in_a_shift(self) -> tuple[float, float]:
        """Relative growth in SHIFT_H at the rate of the second half, and its sigma; NaN if the series is too short."""
        half = len(self.mib) // 2
        gain, sigma = drift(self.t_s[half:], self.mib[half:])
        return gain * SHIFT_H / self.mib[0], sigma * SHIFT_H / self.mib[0]

    @property
    def leaked(self) -> int:
        """Growth of the number of descriptors from start to end."""
        span = max(1, min(SPAN, len(self.descriptors) // 2))
        return min(self.descriptors[-span:]) - max(self.descriptors[:span])


@dataclass
class Ages:
    """Ages of estimates at the planner after the first minute."""

    t_s: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    begin_ns: int = 0  # source time of the first one
    driven_ns: int = 0


def drift(t_s: ArrayLike, values: ArrayLike) -> tuple[float, float]:
    """Growth per hour of a series that may rise in steps, and its sigma; NaN if the series is too short.

    The gains of blocks are independent, residuals of a line are not. A single step is one sigma.
    """
    t, y = np.asarray(t_s, dtype=np.float64) / 3600.0, np.asarray(values, dtype=np.float64)
    if t.size < 2 * BLOCKS:
        return float("nan"), float("nan")
    gained = np.diff([np.median(block) for block in np.array_split(y, BLOCKS)])
    hours = np.diff([block.mean() for block in np.array_split(t, BLOCKS)])
    return float(gained.sum() / hours.sum()), float(gained.std(ddof=1) * np.sqrt(gained.size) / hours.sum())


def sample(processes: Mapping[str, psutil.Process], into: Mapping[str, Series]) -> None:
    """Adds a sample of each process."""
    for name, process in processes.items():
        with contextlib.suppress(psutil.NoSuchProcess), process.oneshot():
            into[name].t_s.append(time.monotonic())
            into[name].mib.append(process.memory_info().rss / 2**20)
            into[name].descriptors.append(process.num_fds())
            into[name].pids.add(process.pid)


def faults(series: Mapping[str, Series], summary: dict[str, Any], systemd: Systemd) -> Iterator[str]:
    """Yields a line for each failed check."""
    for name, one in series.items():
        if one.growth > GROWTH:
            yield f"{name} grew by {one.growth:.1%}"
        gain, sigma = one.in_a_shift()
        if gain - SIGMAS * sigma > GROWTH:
            yield f"{name} would grow by {gain:.1%} +- {sigma:.1%} in {SHIFT_H:g} hours"
        if one.leaked > 0:
            yield f"{name} holds {one.leaked} more descriptors"
        if len(one.pids) > 1:
            yield f"{name} ran as {len(one.pids)} successive processes"
    for name, count in restarts(summary).items():
        if count:
            yield f"{name} was restarted {count} times"
    if systemd.missed:
        yield f"the supervisor missed its watchdog {systemd.missed} times"


def ages(found: Ages) -> tuple[str, list[str]]:
    """Text with p50 and p99 of the estimates' ages in the first and last quarter, and failed checks."""
    quarter = max(1, len(found.ms) // 4)
    p50, p99 = np.percentile(found.ms[:quarter], (50, 99))
    end_p50, end_p99 = np.percentile(found.ms[-quarter:], (50, 99))
    text = f"age at the planner, first quarter p50 {p50:.1f}, p99 {p99:.1f} ms; last {end_p50:.1f}, {end_p99:.1f} ms"
    text += "; p50 {:+.1f} +- {:.1f} ms an hour".format(*drift(found.t_s, found.ms))
    grew = end_p50 > (1.0 + AGE_GROWTH) * p50
    return text, [f"the median age grew from {p50:.1f} to {end_p50:.1f} ms"] if grew else []


def keyframes_in(file: Path) -> int:
    """Number of keyframes in the map as last saved.

    A looped recording adds a new street each time, since the position jumps.
    """
    try:
        return len(read_map(file))
    except MapError:  # not saved yet
        return 0


def restarts(summary: dict[str, Any]) -> dict[str, int]:
    """Restarts of each node, and of the recorder if there is one, after a crash or a watchdog."""
    recorder = {"record": summary["recording"]["restarts"]} if "recording" in summary else {}
    return {**summary["restarts"], **recorder}


def table(series: Mapping[str, Series], summary: dict[str, Any], systemd: Systemd) -> str:
    """The results as a table."""
    begun_anew = restarts(summary) | {"supervisor": systemd.missed}
    dropped = summary["dropped_by"] | {"record": summary.get("recording", {}).get("dropped", 0)}
    columns = (
        *("MiB at 1 min", "MiB at end", "growth", "MiB an hour", f"in {SHIFT_H:g} h by the second half"),
        *("descriptors", "descriptors an hour", "watchdogs missed", "drops"),
    )
    lines = ["| process | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, one in series.items():
        before, after = one.ends()
        mib, descriptors = drift(one.t_s, one.mib), drift(one.t_s, one.descriptors)
        cells = (
            *(f"{before:.1f}", f"{after:.1f}", f"{one.growth:+.2%}", "{:+.2f} +- {:.2f}".format(*mib)),
            "{:+.1%} +- {:.1%}".format(*one.in_a_shift()),
            *(f"{one.descriptors[0]} -> {one.descriptors[-1]}", "{:+.2f} +- {:.2f}".format(*descriptors)),
            *(str(begun_anew.get(name, "")), str(dropped.get(name, ""))),
        )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def drive(vehicle: Vehicle, minutes: float) -> tuple[dict[str, Series], Ages]:
    """Samples of the processes and ages of estimates, both after the first minute.

    Raises RuntimeError if the run ends early.
    """
    begun_s = time.monotonic()
    until_s = begun_s + max(60.0 * minutes, WARM_S + 2 * SAMPLE_S)
    due_s, said_s, frames = begun_s + WARM_S, begun_s, 0
    series: dict[str, Series] = defaultdict(Series)
    found, map_file, keyframes = Ages(), vehicle.place / MAP_FILE, 0
    while (now_s := time.monotonic()) < until_s:
        estimate = vehicle.planner.wait(1.0)
        if estimate is not None:
            frames += 1
            found.driven_ns = estimate.t_source_ns - found.begin_ns if found.begin_ns else 0
            found.begin_ns = found.begin_ns or estimate.t_source_ns
        if estimate is not None and now_s >= begun_s + WARM_S:
            found.t_s.append(now_s)
            found.ms.append((time.monotonic_ns() - estimate.t_capture_ns) / 1e6)
        if vehicle.process.poll() is not None:
            raise RuntimeError(f"the run ended early: {(vehicle.place / 'run.log').read_text()[-1000:]}")
        if now_s >= due_s:
            keyframes = keyframes if series else keyframes_in(map_file)
            due_s += SAMPLE_S
            sample(vehicle.processes(), series)
        if now_s >= said_s + PRINT_S:
            said_s += PRINT_S
            held = ", ".join(f"{name} {one.mib[-1]:.1f} ({one.growth:+.2%})" for name, one in series.items())
            print(f"{(now_s - begun_s) / 60.0:5.1f} min  {frames} estimates  {held or 'warming up'}", flush=True)
    if keyframes:  # written to the file within about ten seconds
        print(f"map: {keyframes} keyframes after the first minute, {keyframes_in(map_file)} at the end")
    return dict(series), found


def run(arguments: list[str]) -> int:
    """Returns the exit status."""
    parser = benchmark_parser("soak", label, output="")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument(
        "--rate", type=float, default=33.0, metavar="HZ", help="of playback; above the recording's rate: faster"
    )
    parser.add_argument("--source", default="", metavar="URI", help="played in a loop; default: the software camera")
    parser.add_argument("--map", action="store_true", help="build a map and localize in it")
    parser.add_argument("--record", action="store_true", help="run a recorder too")
    parser.add_argument("--models", type=Path, help="folder of networks")
    options, more = parser.parse_known_args(arguments)
    exit_on_sigterm()
    with tempfile.TemporaryDirectory(prefix="soak") as folder, Systemd(Path(folder)) as systemd:
        place = Path(folder)
        recorded = record_options(place) if options.record else []
        os.environ.update(systemd.environment)
        mapped = ["--set", f"results.map={place / MAP_FILE}"] if options.map else []
        extra = [*model_options(options.models), *recorded, *mapped, *more]
        with Vehicle(place, *extra, rate_hz=options.rate, source=options.source) as vehicle:
            series, found_ages = drive(vehicle, options.minutes)
            status = vehicle.stop()
            summary = json.loads((vehicle.output / "summary.json").read_text())
    print(table(series, summary, systemd))
    print(
        f"frames {summary['frames_in']}, rate {summary['rate_hz']} Hz, age {summary['age_ms']} ms, {summary['budget']}"
    )
    print(f"longest silence of the supervisor's watchdog: {systemd.longest_s:.1f} s of {WATCHDOG_S:g}")
    driven_h = found_ages.driven_ns / 3.6e12
    print(f"driven: {driven_h:.3f} h of the source's time, {60.0 * driven_h / options.minutes:.2f} times real time")
    text, late = ages(found_ages)
    print(text)
    found = [*faults(series, summary, systemd), *late, *([f"the run ended with status {status}"] if status else [])]
    for line in found:
        print(f"FAILED: {line}")
    return int(bool(found))
