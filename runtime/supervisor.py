"""`birdslam run`: checks what it was given, starts the three processes, watches them, and writes down what came out.

Exit status: 0 at the end of the source, and after SIGTERM (a service's ordered stop); 130 after Ctrl-C; in each case
the frames in flight are processed and the results written. 1 where a node failed for good, 2 where what the user gave
can't be used; the reason is one line on standard error. Everything here waits by events: pidfds, signals, the logbook.
"""

from __future__ import annotations

import importlib.metadata
import platform
import selectors
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from birdslam.perception import load_network
from birdslam.results import Recorder, claim_directory
from runtime.bus import Bus
from runtime.cli import INTERRUPTED_STATUS, USER_ERROR_STATUS
from runtime.configuration import Configuration, ConfigurationError, complete, dump
from runtime.live import LiveLine
from runtime.logbook import Logbook
from runtime.presence import VehicleLock, runtime_dir_of, socket_path
from runtime.processes import NodeProcess
from runtime.sources import CameraSource, open_source
from runtime.topology import NODES

START_ORDER = ("optimize", "perceive", "capture")  # each awaits the one before it (runner.py)
LIBRARIES = ("birdslam", "numpy", "opencv-python-headless", "onnxruntime", "gtsam", "eclipse-zenoh")
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
WITHOUT_MODELS = "no --model given: odometry only, without vehicles and lanes"
WARNINGS_SHOWN = 5  # at a time; the log has all of them


def run(configuration: Configuration) -> int:
    """A whole run; gives the exit status. Raises what a user has to mend before anything is started."""
    configuration, models = check(configuration)
    output = Path(configuration.output)
    live = LiveLine(sys.stdout)
    with ExitStack() as stack:
        stack.enter_context(VehicleLock(configuration.vehicle, configuration.runtime_dir))
        claim_directory(output / "logs")
        if not models:
            live.say(WITHOUT_MODELS)
        assert configuration.camera is not None
        recorder = Recorder(output, configuration.camera)
        bus = stack.enter_context(
            Bus(
                configuration.vehicle,
                "supervisor",
                hub=True,
                runtime_dir=configuration.runtime_dir,
                lossless=configuration.lossless,
            )
        )
        logbook = Logbook(bus, recorder)
        stack.callback(logbook.close)
        bus.declare_alive()
        supervisor = Supervisor(configuration, logbook, live)
        supervisor.run(output / "logs")
    live.clear()
    summary = supervisor.summary(models)
    try:
        recorder.finish(summary)
    except OSError as error:
        supervisor.fail(f"results can't be written: {error}", 1)
    live.say(table(summary, output))
    if supervisor.failure:
        print(f"birdslam: {supervisor.failure}", file=sys.stderr)
    return supervisor.exit_status


def check(configuration: Configuration) -> tuple[Configuration, dict[str, Any]]:
    """Everything that can be wrong before a process is started; fills in the source's own camera.

    Gives the networks' descriptions too. Raises ConfigurationError, SourceError, datasets.DatasetError or
    perception.ModelError.
    """
    check_runtime_dir(configuration.vehicle, configuration.runtime_dir)
    source = open_source(configuration)
    configuration = complete(configuration, source.camera, source.rate_hz)
    if isinstance(source, CameraSource):
        source.close()  # capture opens it for itself
    models: dict[str, Any] = {
        role: load_network(role, spec).describe() for role, spec in configuration.models.given().items()
    }
    return configuration, models


def check_runtime_dir(vehicle: str, runtime_dir: Path | None) -> None:
    """Raises ConfigurationError where sockets can't lie there."""
    try:
        for name in NODES:
            socket_path(runtime_dir_of(vehicle, runtime_dir), name)
    except (ValueError, OSError) as error:
        raise ConfigurationError(f"vehicle {vehicle!r}, runtime directory: {error}") from error


class Supervisor:
    """The nodes of one run, from their start to their end."""

    def __init__(self, configuration: Configuration, logbook: Logbook, live: LiveLine) -> None:
        self.failure = ""
        self.exit_status = 0
        self._config = configuration
        self._logbook = logbook
        self._live = live
        self._nodes: dict[str, NodeProcess] = {}
        self._stopped_by: signal.Signals | None = None
        self._deadline_s: float | None = None  # of a stop that was asked for
        self._selector = selectors.DefaultSelector()

    def run(self, logs: Path) -> None:
        """Starts all nodes; returns when all have ended."""
        with _signals() as signals, self._selector, ExitStack() as stack:
            self._selector.register(signals, selectors.EVENT_READ, self._signal)
            self._selector.register(self._logbook.event_fd, selectors.EVENT_READ, self._logbook_event)
            for name in START_ORDER:
                node = self._nodes[name] = NodeProcess(name, self._config, logs)
                stack.callback(node.close)
                self._selector.register(node.pidfd, selectors.EVENT_READ, self._node_ended)
            while any(node.exit_status is None for node in self._nodes.values()):
                for key, _ in self._selector.select(self._live.period_s):
                    key.data(key.fileobj)
                self._watch()
                self._show()
            if not self.failure and self._nodes["capture"].ready:
                self._logbook.wait_over(self._config.runtime.drain_timeout_s)
            self._show()
        if not self.failure and not self._logbook.ended and self._stopped_by is None:
            self.fail("all nodes ended, but the end of the source never came back", 1)

    def _signal(self, signals: socket.socket) -> None:
        for number in signals.recv(64):
            if self._stopped_by is not None:  # asked twice: no more patience
                self._send_all(signal.SIGTERM)
                continue
            self._stopped_by = signal.Signals(number)
            self.exit_status = self.exit_status or (INTERRUPTED_STATUS if number == signal.SIGINT else 0)
            capture = self._nodes.get("capture")
            if capture is not None and capture.ready:  # END_OF_SOURCE then runs through all
                capture.send(signal.SIGINT)
            else:
                self._send_all(signal.SIGTERM)
            self._deadline_s = time.monotonic() + self._config.runtime.stop_timeout_s

    def _logbook_event(self, event_fd: int) -> None:
        self._selector.unregister(event_fd)
        if self._logbook.error is not None:
            self.fail(f"recording failed: {self._logbook.error}", 1)
        elif self._deadline_s is None:
            self._deadline_s = time.monotonic() + self._config.runtime.stop_timeout_s

    def _node_ended(self, pidfd: int) -> None:
        self._selector.unregister(pidfd)
        node = next(node for node in self._nodes.values() if node.pidfd == pidfd)
        status = node.exit_status
        told = self._deadline_s is not None and status == -signal.SIGTERM  # before it could handle the signal
        if status not in (0, None) and not told:
            self.fail(node.failure(), USER_ERROR_STATUS if status == USER_ERROR_STATUS else 1)

    def _watch(self) -> None:
        now_s, limit_s = time.monotonic(), self._config.runtime.watchdog_s
        for node in self._nodes.values():
            if node.exit_status is None and node.silent_s() > limit_s and not self.failure:
                self.fail(f"{node.name} is stalled: its loop has shown no life for {limit_s:g} s", 1)
                node.send(signal.SIGKILL)
        if self._deadline_s is not None and now_s > self._deadline_s:
            still = [node.name for node in self._nodes.values() if node.exit_status is None]
            if still:
                limit_s = self._config.runtime.stop_timeout_s
                self.fail(f"{', '.join(still)} did not end within {limit_s:g} s of being told to", 1)
            self._send_all(signal.SIGKILL)

    def fail(self, reason: str, exit_status: int) -> None:
        """The first failure is the reason; what follows is its consequence."""
        if self.failure:
            return
        self.failure, self.exit_status = reason, exit_status
        self._deadline_s = time.monotonic() + self._config.runtime.stop_timeout_s
        self._send_all(signal.SIGTERM)

    def _send_all(self, number: signal.Signals) -> None:
        for node in self._nodes.values():
            node.send(number)

    def _show(self) -> None:
        for node in self._nodes.values():
            warnings = node.new_warnings()
            for line in warnings[:WARNINGS_SHOWN]:
                self._live.say(f"{node.name}: {line}")
            if len(warnings) > WARNINGS_SHOWN:
                self._live.say(f"{node.name}: {len(warnings) - WARNINGS_SHOWN} more warnings in {node.log_path}")
        self._live.update(self._logbook.status_line())

    def summary(self, models: dict[str, Any]) -> dict[str, Any]:
        """What summary.json says of the run, beside the recorder's counts."""
        vitals = {name: node.vitals for name, node in self._nodes.items()}
        sent = {name: vitals[name]["frames"] for name in NODES}
        by = {
            "capture": vitals["capture"]["dropped"],
            "perceive": sent["capture"] - sent["perceive"],
            "optimize": sent["perceive"] - sent["optimize"],
            "supervisor": sent["optimize"] - self._logbook.recorded,
        }
        ended = "end of source" if self._logbook.ended else "cut short"
        if self._stopped_by is not None:
            ended = self._stopped_by.name
        return {
            "ended": self.failure or ended,
            "source": self._config.source.uri,
            "frames_in": sent["capture"] + by["capture"],
            "frames_processed": self._logbook.recorded,
            "frames_dropped": sum(by.values()),
            "dropped_by": by,
            "torn": vitals["perceive"]["torn"],
            "malformed": sum(v["malformed"] for v in vitals.values()),
            **self._logbook.figures(),
            "models": models,
            "configuration": dump(self._config),
            "versions": {"python": platform.python_version(), **{n: importlib.metadata.version(n) for n in LIBRARIES}},
        }


@contextmanager
def _signals() -> Iterator[socket.socket]:
    """A socket from which the numbers of these signals are read, instead of what they do otherwise."""
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        handlers = {number: signal.signal(number, _ignore) for number in STOP_SIGNALS}
        try:
            yield reader
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(before)


def _ignore(number: int, frame: FrameType | None) -> None:
    """The wake-up socket has it."""


def table(summary: dict[str, Any], output: Path) -> str:
    """The figures of a run for a person."""

    def spread(figures: dict[str, float]) -> str:
        if not figures:
            return "-"
        return f"p50 {figures['p50']:.1f}  p99 {figures['p99']:.1f}  max {figures['max']:.1f} ms"

    dropped = {name: n for name, n in summary["dropped_by"].items() if n}
    by = f" ({', '.join(f'{n} by {name}' for name, n in dropped.items())})" if dropped else ""
    rows = [
        ("ended", summary["ended"]),
        (
            "frames",
            f"{summary['frames_in']} in, {summary['frames_processed']} processed, "
            f"{summary['frames_dropped']} dropped{by}",
        ),
        ("rate", f"{summary['rate_hz']:.2f} Hz"),
        ("age at the planner", spread(summary["age_ms"])),
        *((f"  {name}", spread(figures)) for name, figures in summary["stages_ms"].items()),
        *((f"  {status}", f"{n} frames") for status, n in summary["statuses"].items()),
        ("results in", str(output)),
    ]
    return "\n".join(f"{name:24}{value}" for name, value in rows)
