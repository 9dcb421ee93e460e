"""One node of a run with its processes: the active one, the spare, restarts and watchdog."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process import realtime
from birdslam.runtime.process.restarts import Assignment, Restarts
from birdslam.runtime.supervision.processes import NodeLog, NodeProcess, waited_s
from birdslam.runtime.transport.presence import remove_socket, runtime_dir_of

_SUMMED = ("frames", "dropped", "malformed", "torn", "coasted", "outrun", "speeds", "speeds_dropped")

MAX_MISSED_RECORDS = 10  # consecutive records sent to a node and not received; fewer may be in transit


def _assignment_alone(assignment: Assignment) -> msgspec.Struct:
    return assignment


@dataclass(frozen=True)
class Duty:
    """What the processes of a station run, and whether the run can continue without them."""

    module: str = "birdslam.runtime.nodes.runner"
    first_message: Callable[[Assignment], msgspec.Struct] = _assignment_alone  # sent at the start of its work
    final_statuses: tuple[int, ...] = ()  # exit statuses without a restart
    without: str = ""  # message when the run continues without it; "": the run fails with it
    watchdog_s: float | None = None  # limit of the heartbeat; None: the configured one

    @property
    def essential(self) -> bool:
        """Whether the run fails without it."""
        return not self.without


class Intake:
    """Detects a node that has a heartbeat but has lost its input."""

    def __init__(self) -> None:
        self._sent = self._taken = -1
        self._since_s = 0.0

    def missed(self, sent: int, taken: int, silent_s: float, now_s: float, limit_s: float) -> int:
        """Returns the number of consecutive records not received for longer than `limit_s`, else 0.

        A decreasing counter restarts. A node without a heartbeat for half the limit does not count: it may be stalled.
        """
        if taken != self._taken or sent < self._sent:
            self._sent, self._taken, self._since_s = sent, taken, now_s
        missed = sent - self._sent
        late = now_s - self._since_s > limit_s and silent_s <= limit_s / 2.0
        return missed if missed >= MAX_MISSED_RECORDS and late else 0


class Silence:
    """The time without a heartbeat of a low-priority process, less the time that it waited for a core.

    Between two calls the thread that waited longest counts: the main thread, or one that held the interpreter's lock.
    """

    def __init__(self) -> None:
        self._beat_ns, self._starved_s = -1, 0.0
        self._waited_s: Mapping[int, float] = {}

    def own_s(self, beat_ns: int, silent_s: float, waited_s: Mapping[int, float]) -> float:
        """Returns the time in s; `waited_s` is the total wait for a core of each thread."""
        gained_s = max((s - self._waited_s.get(thread, s) for thread, s in waited_s.items()), default=0.0)
        self._starved_s = gained_s + (self._starved_s if beat_ns == self._beat_ns else 0.0)
        self._beat_ns, self._waited_s = beat_ns, waited_s
        return silent_s - self._starved_s


class Station:
    """One node of a run, or its recorder, with all of its processes; starts at once."""

    def __init__(self, name: str, configuration: Configuration, directory: Path, duty: Duty = Duty()) -> None:
        self.name = name
        self.duty = duty
        self.log = NodeLog(directory / f"{name}.log")
        self.restarts = Restarts(configuration.runtime)
        self.due_s: float | None = None  # start of the next process, if none runs
        self._config = configuration
        self._intake, self._silence = Intake(), Silence()
        self._spare: NodeProcess | None = None
        self._spare_due_s = 0.0
        self.stall = ""  # why the watchdog ended the active process
        self._kill_s: float | None = None  # when a stalled process gets SIGKILL after SIGTERM
        self.was_ready = False  # the active process has been ready; a recorder is no longer ready while it closes
        self._before: Counter[str] = Counter()
        self.process = self._started()
        self._begin()

    def _started(self) -> NodeProcess:
        return NodeProcess(self.name, self._config, self.log, self.duty.module)

    def _begin(self) -> None:
        self.process.begin(self.duty.first_message(self.restarts.assignment()))

    @property
    def working(self) -> bool:
        """Whether it runs, or will be restarted."""
        return self.due_s is not None or self.process.exit_status is None

    def total(self, counter: str) -> int:
        """Returns a counter summed over all processes of the node."""
        return self._before[counter] + self.process.vitals[counter]

    # --- restarts ---

    @property
    def finished(self) -> bool:
        """Whether its process has ended and a restart is pointless.

        After the end of the source a node is finished even if the watchdog ended it; a recorder is not.
        """
        status, ended = self.process.exit_status, bool(self.process.vitals["ended"])
        in_order = ended and (status == 0 if self.duty.essential else not self.stall)
        return in_order or status in self.duty.final_statuses

    @property
    def cause(self) -> str:
        """The reason why its process ended."""
        return self.stall or self.process.how()

    def plan_restart(self) -> bool:
        """Sets when the next process starts; returns False after too many restarts."""
        self.due_s = self.restarts.died(time.monotonic(), self.cause, self.process.vitals)
        return self.due_s is not None

    def restart(self) -> None:
        """Starts the next process: the spare or a new one."""
        self.due_s = self._kill_s = None
        self.stall, self.was_ready = "", False
        for counter in _SUMMED:
            self._before[counter] += self.process.vitals[counter]
        self.process.close()
        remove_socket(runtime_dir_of(self._config.vehicle, self._config.runtime_dir), self.name)
        spare, self._spare = self._spare, None
        if spare is not None and spare.exit_status is not None:
            spare.close()
            spare = None
        if spare is not None:
            realtime.raise_from_idle(spare.pid)  # before the assignment: it may still be loading
        self.process = spare or self._started()
        self._begin()

    def keep_spare(self) -> bool:
        """Starts a spare if there is none; returns whether one is loaded."""
        now_s = time.monotonic()
        if self._spare is not None and self._spare.exit_status is not None:  # it could not load: wait before the next
            self._spare.close()
            self._spare = None
            self._spare_due_s = now_s + self._config.runtime.restart_backoff_max_ms / 1e3
        if self._spare is None and now_s >= self._spare_due_s:
            self._spare = self._started()
            realtime.lower_to_idle(self._spare.pid)
        return self._spare is not None and bool(self._spare.vitals["prepared"])

    # --- watchdog ---

    def stalled(self, before: Station | None) -> str:
        """Returns why the active process must be ended, or ""; `before` is the node that sends to it."""
        runtime, process = self._config.runtime, self.process
        limit_s, now_s = self.duty.watchdog_s or self._config.watchdog_s, time.monotonic()
        if process.exit_status is not None or process.begun_s is None or self._kill_s is not None:
            return ""
        self.was_ready = self.was_ready or process.ready
        silent_s = process.silent_s()
        if not self.duty.essential:
            silent_s = self._silence.own_s(process.vitals["beat_ns"], silent_s, waited_s(process.pid))
        if silent_s > limit_s:
            return f"is stalled: no heartbeat for {1e3 * limit_s:g} ms"
        if before is not None and process.ready:
            sent = before.process.vitals["frames"]
            taken = sum(process.vitals[counter] for counter in ("frames", "torn", "outrun"))
            missed = self._intake.missed(sent, taken, silent_s, now_s, limit_s)
            if missed:
                return f"has received none of the last {missed} frames of {before.name}"
        since_s = now_s - process.begun_s
        if not self.was_ready and since_s > runtime.ready_timeout_s + runtime.stop_timeout_s:
            return f"was not ready within {since_s:.0f} s"
        return ""

    def end(self, stall: str) -> None:
        """Sends SIGTERM now, and SIGKILL after the grace period (`enforce`)."""
        self.stall = stall
        self.process.send(signal.SIGTERM)
        self._kill_s = time.monotonic() + self._config.runtime.term_grace_ms / 1e3

    def enforce(self) -> None:
        """Kills a process whose grace period is over."""
        if self._kill_s is not None and time.monotonic() > self._kill_s:
            self.process.send(signal.SIGKILL)

    def close(self) -> None:
        """Kills the processes that still run."""
        self.process.close()
        if self._spare is not None:
            self._spare.close()
