"""Runs `birdslam run` with its real processes; this process is the planner."""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import msgspec
import psutil

from birdslam.perf.errors import PerfError
from birdslam.perf.processes import birdslam_command, processes_of
from birdslam.runtime.client import Planner
from birdslam.runtime.topology import MAP, NODES
from birdslam.runtime.transport.bus import Message
from birdslam.types import Status

START_S, END_S = 90.0, 120.0  # max. times of start and end; at the end results are written
_SAMPLE_S = 1.0
_PSS_EVERY = 8  # samples
_VEHICLE = "perf"


class Ask(msgspec.Struct, frozen=True, kw_only=True):
    """What to run; all other settings are the defaults."""

    source: str
    rate: float
    seconds: float
    models: tuple[str, ...] = ()  # ROLE=PATH
    settings: tuple[str, ...] = ()  # KEY=VALUE
    config: str = ""  # a file

    def command(self, place: Path) -> list[str]:
        """The command line of `birdslam`, with all its files under `place`."""
        settings = [
            f"runtime.runtime_dir={place / 'rt'}",
            f"source.frames={max(1, round(self.rate * self.seconds))}",
            "source.loop=true",
            *self.settings,
        ]
        return [
            *birdslam_command("run", *([self.config] if self.config else [])),
            *("--source", self.source, "--rate", str(self.rate), "--vehicle", _VEHICLE, "--output", str(place / "out")),
            *(part for model in self.models for part in ("--model", model)),
            *(part for setting in settings for part in ("--set", setting)),
        ]


@dataclass
class Sample:
    """CPU time and memory of the processes at one time."""

    t_s: float
    cpu_s: dict[str, float]  # process -> processor time so far
    rss_mb: dict[str, float]
    pss_mb: dict[str, float] = field(default_factory=dict)  # proportional set size; not in every sample


@dataclass
class Run:
    """The result of a run."""

    messages: list[Message] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    place: Path = Path()
    complete: bool = False  # not cut short by Ctrl-C
    rate_hz: float | None = None  # requested rate

    def after(self, warm_up_s: float) -> Self:
        """The run without its first seconds, in which caches fill and spares load."""
        first_ns = self.messages[0].t_received_ns if self.messages else 0
        begun_s = first_ns / 1e9 + warm_up_s
        self.messages = [m for m in self.messages if m.t_received_ns / 1e9 >= begun_s]
        self.samples = [sample for sample in self.samples if sample.t_s >= begun_s]
        return self


@contextlib.contextmanager
def drive(ask: Ask) -> Iterator[Run]:
    """Runs to the end; Ctrl-C shuts down in order and keeps what was received.

    The run's files exist as long as the context. Raises PerfError with the message of `birdslam run` if it fails.
    """
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        run = Run(place=Path(folder), rate_hz=ask.rate)
        log = run.place / "run.log"
        (run.place / "rt").mkdir(mode=0o700)
        with log.open("wb") as output:
            process = subprocess.Popen(ask.command(run.place), stdout=output, stderr=output, start_new_session=True)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                run.complete = _receive(run, process)
            _finish(process, run.complete)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        summary = run.place / "out" / "summary.json"
        if not run.messages or not summary.is_file():
            raise PerfError(f"birdslam run: {log.read_text(errors='replace').strip()[-2000:] or 'gave no estimate'}")
        run.summary = json.loads(summary.read_text())
        yield run


def _receive(run: Run, process: subprocess.Popen[bytes]) -> bool:
    """Receives all estimates; returns whether the source ended before the process did."""
    sample_s, until_s = 0.0, time.monotonic() + START_S
    with Planner(_VEHICLE, run.place / "rt") as planner:
        while process.poll() is None and (run.messages or time.monotonic() < until_s):
            message = planner.wait_message(0.1)
            if message is not None:
                if Status.END_OF_SOURCE in message.record.status:
                    return True
                run.messages.append(message)
            now_s = time.monotonic()
            if run.messages and now_s - sample_s >= _SAMPLE_S:
                run.samples.append(_sample(process.pid, now_s, len(run.samples) % _PSS_EVERY == _PSS_EVERY - 1))
                sample_s = now_s
    return False


def _finish(process: subprocess.Popen[bytes], ended: bool) -> None:
    """Waits for the end of the process, which then has written its results."""
    if process.poll() is None and not ended:
        process.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(END_S)


def _sample(pid: int, now_s: float, with_pss: bool) -> Sample:
    sample = Sample(now_s, {}, {})
    with contextlib.suppress(psutil.NoSuchProcess):
        for name, process in processes_of(pid, (*NODES, MAP.name)).items():
            with contextlib.suppress(psutil.NoSuchProcess), process.oneshot():
                times = process.cpu_times()
                sample.cpu_s[name] = times.user + times.system
                sample.rss_mb[name] = process.memory_info().rss / 2**20
                if with_pss:  # slow: the kernel walks all pages
                    sample.pss_mb[name] = process.memory_full_info().pss / 2**20
    return sample


def add_run_options(add: Any) -> None:
    """Adds the options of an Ask to a parser with its add_argument `add`."""
    sources = "demo (the default: the shipped drive), kitti:DIR or video:FILE"
    add("--source", default="demo", metavar="URI", help=sources)
    add("--config", default="", metavar="CONFIG.toml", help="configuration file")
    add("--model", action="append", default=[], metavar="ROLE=PATH")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="any field of the configuration")
