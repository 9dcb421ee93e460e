"""A long drive: what memory, descriptors and age of every process gain in an hour, with its sigma; watchdogs, drops.

    python -m perf soak [--minutes 30] [--rate 33] [--source demo] [--map] [--record] [--models DIR] [...]

Further options are those of `birdslam run`; without `--source` the software camera of the fault suite drives down its
street. Ends with status 1, and says why, where after the first minute a process grew by more than 1 %, or would in
eight hours by what its second half gained (beyond 3 sigma), held more descriptors, was restarted or missed a watchdog
(the soak stands in systemd's place), or estimates came later.
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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import ArrayLike

from birdslam.geometry.arrays import Floats
from birdslam.loops.map_file import MapError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import BLOCKS
from birdslam.perf.robustness.faulty_vehicle import Vehicle, ends_with_its_vehicle, model_options, record_options
from birdslam.runtime.maps.map_store import read_map
from birdslam.runtime.transport.closing import Closing

label = "memory, descriptors, watchdogs and drops of every process over a long drive"

MAP_FILE = "soak.map"
WARM_S, SAMPLE_S, SAID_S = 60.0, 5.0, 30.0
SPAN = 6  # samples at either end whose medians are compared: what a process holds swings by its garbage
GROWTH = 0.01
SHIFT_H = 8.0  # of driving, to which the second half is carried on: by then what a start makes once is made
SIGMAS = 3.0  # of that growth, before it counts as one: eight processes, each a chance
AGE_GROWTH = 0.1  # of the age's median, first quarter to last
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
        """That the supervisor is started with."""
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
    """One process, sample by sample from the end of the first minute on."""

    t_s: list[float] = field(default_factory=list)
    mib: list[float] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)
    pids: set[int] = field(default_factory=set)

    def ends(self) -> tuple[float, float]:
        """Resident memory (MiB) at the beginning and at the end."""
        span = max(1, min(SPAN, len(self.mib) // 2))
        return float(np.median(self.mib[:span])), float(np.median(self.mib[-span:]))

    @property
    def growth(self) -> float:
        before, after = self.ends()
        return after / before - 1.0

    def in_a_shift(self) -> tuple[float, float]:
        """By what share it would grow in SHIFT_H as in its second half, and the sigma; NaN: too short to tell."""
        half = len(self.mib) // 2
        gain, sigma = drift(self.t_s[half:], self.mib[half:])
        return gain * SHIFT_H / self.mib[0], sigma * SHIFT_H / self.mib[0]

    @property
    def leaked(self) -> int:
        """Descriptors that it holds at the end and did not at the beginning."""
        span = max(1, min(SPAN, len(self.descriptors) // 2))
        return min(self.descriptors[-span:]) - max(self.descriptors[:span])


@dataclass
class Ages:
    """Of estimates at the planner, from the end of the first minute on."""

    t_s: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    begin_ns: int = 0  # the source's time of the first one, and how far it is from there
    driven_ns: int = 0


def slope(t_s: ArrayLike, values: ArrayLike, of: Callable[[Floats], float] = np.mean) -> tuple[float, float]:
    """What a series gains in an hour, and the sigma of that; NaN where it is too short to tell.

    A line through blocks of the series, each by its mean or what else stands for it: samples that follow each other are
    not independent, blocks nearly are. The sigma is by what the blocks are off that line.
    """
    t, y = np.asarray(t_s, dtype=np.float64) / 3600.0, np.asarray(values, dtype=np.float64)
    if t.size < 2 * BLOCKS:
        return float("nan"), float("nan")
    x = np.array([block.mean() for block in np.array_split(t, BLOCKS)])
    z = np.array([of(block) for block in np.array_split(y, BLOCKS)])
    x -= x.mean()
    gain = float(x @ z / (x @ x))
    left = z - z.mean() - gain * x
    return gain, float(np.sqrt(left @ left / (BLOCKS - 2) / (x @ x)))


def drift(t_s: ArrayLike, values: ArrayLike) -> tuple[float, float]:
    """What a series that keeps what it gains will gain in an hour, and the sigma of that; NaN: it is too short to tell.

    Memory goes up in steps and stays there: what each block of it gains is independent, what it is off a line is not.
    So one step, of a table that doubles or of more images at once than ever before, is one sigma.
    """
    t, y = np.asarray(t_s, dtype=np.float64) / 3600.0, np.asarray(values, dtype=np.float64)
    if t.size < 2 * BLOCKS:
        return float("nan"), float("nan")
    gained = np.diff([np.median(block) for block in np.array_split(y, BLOCKS)])
    hours = np.diff([block.mean() for block in np.array_split(t, BLOCKS)])
    return float(gained.sum() / hours.sum()), float(gained.std(ddof=1) * np.sqrt(gained.size) / hours.sum())


def sample(processes: Mapping[str, psutil.Process], into: Mapping[str, Series]) -> None:
    """Adds what each process holds now."""
    for name, process in processes.items():
        with contextlib.suppress(psutil.NoSuchProcess), process.oneshot():
            into[name].t_s.append(time.monotonic())
            into[name].mib.append(process.memory_info().rss / 2**20)
            into[name].descriptors.append(process.num_fds())
            into[name].pids.add(process.pid)


def faults(series: Mapping[str, Series], summary: dict[str, Any], systemd: Systemd) -> Iterator[str]:
    """What a soak must not show, a line each."""
    for name, one in series.items():
        if one.growth > GROWTH:
            yield f"{name} grew by {one.growth:.1%}"
        gain, sigma = one.in_a_shift()
        if gain - SIGMAS * sigma > GROWTH:
            yield f"{name} would grow by {gain:.1%} +- {sigma:.1%} in {SHIFT_H:g} hours"
        if one.leaked > 0:
            yield f"{name} holds {one.leaked} descriptors more"
        if len(one.pids) > 1:
            yield f"{name} was {len(one.pids)} processes, one after the other"
    for name, count in restarts(summary).items():
        if count:
            yield f"{name} was restarted {count} times"
    if systemd.missed:
        yield f"the supervisor missed its watchdog {systemd.missed} times"


def ages(found: Ages) -> tuple[str, list[str]]:
    """Of estimates after the first minute: p50 and p99 in the first and the last quarter, and what is not well."""
    quarter = max(1, len(found.ms) // 4)
    p50, p99 = np.percentile(found.ms[:quarter], (50, 99))
    end_p50, end_p99 = np.percentile(found.ms[-quarter:], (50, 99))
    said = f"age at the planner, first quarter p50 {p50:.1f}, p99 {p99:.1f} ms; last {end_p50:.1f}, {end_p99:.1f} ms"
    for percent in (50, 99):
        gain, sigma = slope(found.t_s, found.ms, partial(np.percentile, q=percent))
        said += f"; p{percent} {gain:+.1f} +- {sigma:.1f} ms an hour"
    grew = end_p50 > (1.0 + AGE_GROWTH) * p50
    return said, [f"the age grew from {p50:.1f} to {end_p50:.1f} ms in the median"] if grew else []


def keyframes_in(file: Path) -> int:
    """Of the map as it was last saved.

    A recording that goes round is a new street to it each time, since the car is elsewhere at once.
    """
    try:
        return len(read_map(file))
    except MapError:  # none was saved yet
        return 0


def restarts(summary: dict[str, Any]) -> dict[str, int]:
    """Of each node, and of the recorder where there is one: dead, or ended by its watchdog."""
    recorder = {"record": summary["recording"]["restarts"]} if "recording" in summary else {}
    return {**summary["restarts"], **recorder}


def table(series: Mapping[str, Series], summary: dict[str, Any], systemd: Systemd) -> str:
    """For a person."""
    begun_anew = restarts(summary) | {"supervisor": systemd.missed}
    dropped = summary["dropped_by"] | {"record": summary.get("recording", {}).get("dropped", 0)}
    columns = (
        *("MiB at 1 min", "MiB at end", "growth", "MiB an hour", f"in {SHIFT_H:g} h by the second half"),
        *("descriptors", "descriptors an hour", "watchdogs missed", "drops"),
    )
    lines = ["| process | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, one in series.items():
        before, after = one.ends()
        mib, descriptors = drift(one.t_s, one.mib), slope(one.t_s, one.descriptors)
        cells = (
            *(f"{before:.1f}", f"{after:.1f}", f"{one.growth:+.2%}", "{:+.2f} +- {:.2f}".format(*mib)),
            "{:+.1%} +- {:.1%}".format(*one.in_a_shift()),
            *(f"{one.descriptors[0]} -> {one.descriptors[-1]}", "{:+.2f} +- {:.2f}".format(*descriptors)),
            *(str(begun_anew.get(name, "")), str(dropped.get(name, ""))),
        )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def drive(vehicle: Vehicle, minutes: float) -> tuple[dict[str, Series], Ages]:
    """Samples until the time is over, and the ages of estimates; both after the first minute.

    Raises RuntimeError where the run ends before.
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
            raise RuntimeError(f"the run has ended by itself: {(vehicle.place / 'run.log').read_text()[-1000:]}")
        if now_s >= due_s:
            keyframes = keyframes if series else keyframes_in(map_file)
            due_s += SAMPLE_S
            sample(vehicle.processes(), series)
        if now_s >= said_s + SAID_S:
            said_s += SAID_S
            held = ", ".join(f"{name} {one.mib[-1]:.1f} ({one.growth:+.2%})" for name, one in series.items())
            print(f"{(now_s - begun_s) / 60.0:5.1f} min  {frames} estimates  {held or 'warming up'}", flush=True)
    if keyframes:  # one comes into the file within ten seconds or so
        print(f"map: {keyframes} keyframes after the first minute, {keyframes_in(map_file)} at the end")
    return dict(series), found


def run(arguments: list[str]) -> int:
    """Gives the exit status."""
    parser = benchmark_parser("soak", label, output="")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=33.0, metavar="HZ", help="above the recording's: faster")
    parser.add_argument("--source", default="", metavar="URI", help="goes round and round; left out: a software camera")
    parser.add_argument("--map", action="store_true", help="localised in a map that it makes")
    parser.add_argument("--record", action="store_true", help="with a recorder beside it")
    parser.add_argument("--models", type=Path, help="folder of networks")
    options, more = parser.parse_known_args(arguments)
    ends_with_its_vehicle()
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
    print(
        f"driven: {driven_h:.3f} h of the source's time, {60.0 * driven_h / options.minutes:.2f} times as fast as it is"
    )
    said, late = ages(found_ages)
    print(said)
    found = [*faults(series, summary, systemd), *late, *([f"the run ended with status {status}"] if status else [])]
    for line in found:
        print(f"NOT WELL: {line}")
    return int(bool(found))
