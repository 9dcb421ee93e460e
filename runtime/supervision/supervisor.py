"""Starts, watches and ends the three processes of a run, its recorder and its map process.

Event driven: pidfds, signals, the logbook. On SIGINT, SIGTERM and SIGHUP capture ends the source, so that the frames
in flight are processed; on a second signal all processes end at once.
"""

from __future__ import annotations

import select
import selectors
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.environment import INTERRUPTED_STATUS, USER_ERROR_STATUS
from birdslam.runtime.process.notify import Notifier
from birdslam.runtime.supervision.live import LiveLine
from birdslam.runtime.supervision.logbook import Logbook
from birdslam.runtime.supervision.map_station import map_station
from birdslam.runtime.supervision.recording_files import RecordingFiles
from birdslam.runtime.supervision.stations import Station

START_ORDER = ("optimize", "perceive", "capture")  # each waits for the one before it (runner.py)
BEFORE = {"perceive": "capture", "optimize": "perceive"}  # node -> its sender
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CHECK_S = 0.1  # max. interval of the watchdog
MAX_WARNINGS = 5  # printed at a time; the log has all


class Supervisor:
    """The nodes of one run, its recorder and its map process, from start to end."""

    def __init__(
        self,
        configuration: Configuration,
        logbook: Logbook,
        live: LiveLine,
        files: RecordingFiles | None = None,
        frames: int | None = None,
    ) -> None:
        """`frames`: number of frames of the source, for the remaining time; None if unknown."""
        self.failure = ""
        self.exit_status = 0
        self._config = configuration
        self._logbook = logbook
        self._live = live
        self._files = files
        self._frames = frames
        self.recorder: Station | None = None
        self.map: Station | None = None
        self._notifier = Notifier()
        self._has_reported_disk = False
        self.nodes: dict[str, Station] = {}
        self._stopped_by: signal.Signals | None = None
        self._deadline_s: float | None = None  # of a requested stop
        self._selector = selectors.DefaultSelector()

    def run(self, logs: Path) -> None:
        """Starts all nodes; returns when all have ended."""
        runtime = self._config.runtime
        with _signals() as signals, self._selector, ExitStack() as stack:
            self._selector.register(signals, selectors.EVENT_READ, self._signal)
            self._selector.register(self._logbook.event_fd, selectors.EVENT_READ, self._logbook_event)
            if self._files is not None:
                self.recorder = self._files.station(self._config, logs)
                self._add(self.recorder, stack)
            if self._config.maps_live:
                self.map = map_station(self._config, logs)
                self._add(self.map, stack)
            for name in START_ORDER:
                self.nodes[name] = Station(name, self._config, logs)
                self._add(self.nodes[name], stack)
            while any(station.working for station in self.nodes.values()):
                for key, _ in self._selector.select(min(self._live.period_s, CHECK_S)):
                    key.data(key.fileobj)
                self._watch()
                self._show()
            if not self.failure and self.nodes["capture"].process.ready:
                self._logbook.wait_over(runtime.drain_timeout_s, runtime.stop_timeout_s)
            self._end_beside(runtime.stop_timeout_s)
            self._show()
            self._notifier.once("STOPPING=1")
        if not self.failure and not self._logbook.ended and self._stopped_by is None:
            self.fail("all nodes ended, but END_OF_SOURCE was not received", 1)

    def _add(self, station: Station, stack: ExitStack) -> None:
        stack.callback(station.close)
        self._selector.register(station.process.pidfd, selectors.EVENT_READ, self._process_ended)

    @property
    def _stations(self) -> tuple[Station, ...]:
        return (*self.nodes.values(), *self._beside)

    @property
    def _beside(self) -> tuple[Station, ...]:
        return tuple(station for station in (self.recorder, self.map) if station is not None)

    def _end_beside(self, timeout_s: float) -> None:
        """Lets recorder and map process write what they have received and close their files."""
        self._stop_by(timeout_s)
        for station in self._beside:
            station.process.send(signal.SIGTERM)
        until_s = time.monotonic() + timeout_s
        for station in self._beside:
            pidfd = station.process.pidfd
            left_s = max(0.0, until_s - time.monotonic())
            if pidfd in self._selector.get_map() and select.select([pidfd], [], [], left_s)[0]:
                self._process_ended(pidfd)

    def _signal(self, signals: socket.socket) -> None:
        for number in signals.recv(64):
            if self._stopped_by is not None:  # second signal: end at once
                self._send_all(signal.SIGTERM)
                continue
            self._stopped_by = signal.Signals(number)
            self._notifier.once("STOPPING=1")
            self.exit_status = self.exit_status or (INTERRUPTED_STATUS if number == signal.SIGINT else 0)
            capture = self.nodes.get("capture")
            if capture is not None and capture.process.ready and capture.process.exit_status is None:
                capture.process.send(signal.SIGINT)  # END_OF_SOURCE then passes through all nodes
            else:
                self._send_all(signal.SIGTERM)
            self._stop_by(self._config.runtime.stop_timeout_s)

    def _stop_by(self, timeout_s: float) -> None:
        self._deadline_s = time.monotonic() + timeout_s
        for station in self._stations:
            station.due_s = None  # none is restarted

    def _logbook_event(self, event_fd: int) -> None:
        self._selector.unregister(event_fd)
        if self._logbook.error is not None:
            self.fail(f"recording failed: {self._logbook.error}", 1)
        elif self._deadline_s is None:
            self._stop_by(self._config.runtime.stop_timeout_s)

    def _process_ended(self, pidfd: int) -> None:
        """Restarts an unfinished process if allowed; else the run fails, or continues without it."""
        self._selector.unregister(pidfd)
        station = next(station for station in self._stations if station.process.pidfd == pidfd)
        process, essential = station.process, station.duty.essential
        stopping = self._deadline_s is not None
        status, at_first = process.exit_status, not process.ready and not station.restarts.count
        if station.finished or (stopping and essential and status in (0, None, -signal.SIGTERM)):
            return  # -SIGTERM: it ended before its signal handler was set
        may_restart = self._config.restarts and not stopping and not (essential and at_first)
        if may_restart and station.plan_restart():
            self._live.say(process.failure(station.cause, "; it is being restarted"))
            if station.due_s is not None and station.due_s <= time.monotonic():
                self._restart(station)
        elif not essential:
            self._live.say(process.failure(station.cause, f"; {station.duty.without}, the run continues"))
        elif may_restart:
            window_s = self._config.runtime.restart_window_s
            again = f"{self._config.runtime.restarts_max + 1} times in {window_s:g} s: it is not restarted"
            self.fail(f"{process.failure()}, {again}", 1)
        else:
            self.fail(process.failure(), USER_ERROR_STATUS if status == USER_ERROR_STATUS and not stopping else 1)

    def _restart(self, station: Station) -> None:
        station.restart()
        self._selector.register(station.process.pidfd, selectors.EVENT_READ, self._process_ended)

    def _watch(self) -> None:
        now_s = time.monotonic()
        nodes = self.nodes.values()
        for station in self._stations:
            before = self.nodes.get(BEFORE.get(station.name, ""))
            stall = "" if self.failure else station.stalled(before)
            if stall and station.duty.essential and not self._config.restarts:
                self.fail(f"{station.name} {stall}", 1)
            if stall:
                station.end(stall)
            station.enforce()
            if station.due_s is not None and station.due_s <= now_s:
                self._restart(station)
        if self._deadline_s is None and all(node.process.ready for node in nodes):
            self._notifier.once("READY=1")
            if self._config.spares:  # one after the other, so that loading takes at most one core
                all(node.keep_spare() for node in nodes)
        if self._deadline_s is not None and now_s > self._deadline_s:
            still = [node.name for node in nodes if node.process.exit_status is None]
            if still:
                limit_s = self._config.runtime.stop_timeout_s
                self.fail(f"{', '.join(still)} did not end within {limit_s:g} s of the signal", 1)
            self._send_all(signal.SIGKILL)

    def fail(self, reason: str, exit_status: int) -> None:
        """Ends the run with a failure; later failures are ignored as its consequences."""
        if self.failure:
            return
        self.failure, self.exit_status = reason, exit_status
        self._notifier.once("STOPPING=1")
        self._stop_by(self._config.runtime.stop_timeout_s)
        self._send_all(signal.SIGTERM)

    def _send_all(self, number: signal.Signals) -> None:
        for station in self.nodes.values():
            station.process.send(number)

    def _show(self) -> None:
        for station in self._stations:
            warnings = station.log.new_warnings()
            for line in warnings[:MAX_WARNINGS]:
                self._live.say(f"{station.name}: {line}")
            if len(warnings) > MAX_WARNINGS:
                self._live.say(f"{station.name}: {len(warnings) - MAX_WARNINGS} more warnings in {station.log.path}")
        if self._logbook.unwritten is not None and not self._has_reported_disk:
            self._has_reported_disk = True
            self._live.say(f"results are no longer written: {self._logbook.unwritten}")
        status = self._logbook.status_line(self._frames)
        if self._files is not None and self.recorder is not None:
            status = f"{status}  {self._files.status(self.recorder)}"
        self._live.update(status)
        self._notifier.alive(status)

    @property
    def ended(self) -> str:
        """The reason for the end of the run, for the summary."""
        if self.failure:
            return self.failure
        if self._stopped_by is not None:
            return self._stopped_by.name
        return "end of source" if self._logbook.ended else "cut short"


@contextmanager
def _signals() -> Iterator[socket.socket]:
    """Redirects STOP_SIGNALS to a socket, from which their numbers are read."""
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
    """Does nothing: the wake-up socket has the signal."""
