"""The place of a node in a run: the process at work, the spare beside it, and the rule by which it is begun anew."""

from __future__ import annotations

import signal
import time
from collections import Counter
from pathlib import Path

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process.restarts import FIRST, Restarts
from birdslam.runtime.supervision.processes import NodeLog, NodeProcess
from birdslam.runtime.transport.presence import remove_socket, runtime_dir_of

_SUMMED = ("frames", "dropped", "malformed", "torn", "coasted", "outrun")

DEAF_RECORDS = 10  # sent to a node that has taken up none of them


class Hearing:
    """Whether a node takes up what is sent to it: a loop that beats may still have lost its ears.

    Stale input is another thing: nothing was sent then.
    """

    def __init__(self) -> None:
        self._sent = self._taken = -1
        self._since_s = 0.0

    def missed(self, sent: int, taken: int, silent_s: float, now_s: float, limit_s: float) -> int:
        """How many records in a row, where that has gone on for too long; else 0. Counters that fall begin anew.

        A loop that has not beaten for half the limit is not deaf, it may be about to count as stalled.
        """
        if taken != self._taken or sent < self._sent:
            self._sent, self._taken, self._since_s = sent, taken, now_s
        missed = sent - self._sent
        late = now_s - self._since_s > limit_s and silent_s <= limit_s / 2.0
        return missed if missed >= DEAF_RECORDS and late else 0


class Station:
    """One node of a run, through all of its processes; it begins at once."""

    def __init__(self, name: str, configuration: Configuration, directory: Path) -> None:
        self.name = name
        self.log = NodeLog(directory / f"{name}.log")
        self.restarts = Restarts(configuration.runtime)
        self.due_s: float | None = None  # of the next process, where there is none
        self._config = configuration
        self._hearing = Hearing()
        self._spare: NodeProcess | None = None
        self._spare_due_s = 0.0
        self.stall = ""  # why the process at work was ended by the watchdog
        self._kill_s: float | None = None  # when a stalled process that did not heed SIGTERM is killed
        self._before: Counter[str] = Counter()
        self.process = NodeProcess(name, configuration, self.log)
        self.process.begin(FIRST)

    @property
    def working(self) -> bool:
        """It runs, or will again."""
        return self.due_s is not None or self.process.exit_status is None

    def total(self, counter: str) -> int:
        """One of the counters over all processes of the node."""
        return self._before[counter] + self.process.vitals[counter]

    # --- restarts ---

    def died(self, cause: str) -> bool:
        """Plans the next process; False where the node has died too often of late."""
        self.due_s = self.restarts.died(time.monotonic(), cause, self.process.vitals)
        return self.due_s is not None

    def begin_again(self) -> None:
        """The next process goes to work: the spare, or a new one."""
        self.due_s = self._kill_s = None
        self.stall = ""
        for counter in _SUMMED:
            self._before[counter] += self.process.vitals[counter]
        self.process.close()
        remove_socket(runtime_dir_of(self._config.vehicle, self._config.runtime_dir), self.name)
        spare, self._spare = self._spare, None
        if spare is not None and spare.exit_status is not None:
            spare.close()
            spare = None
        self.process = spare or NodeProcess(self.name, self._config, self.log)
        self.process.begin(self.restarts.assignment())

    def keep_spare(self) -> bool:
        """Starts a spare where there is none; whether one stands by, loaded."""
        now_s = time.monotonic()
        if self._spare is not None and self._spare.exit_status is not None:  # it could not load: no hurry with another
            self._spare.close()
            self._spare = None
            self._spare_due_s = now_s + self._config.runtime.restart_backoff_max_ms / 1e3
        if self._spare is None and now_s >= self._spare_due_s:
            self._spare = NodeProcess(self.name, self._config, self.log)
        return self._spare is not None and bool(self._spare.vitals["prepared"])

    # --- watchdog ---

    def stalled(self, before: Station | None) -> str:
        """Why the process at work is to be ended, or nothing; `before` is the node that sends to it."""
        runtime, process = self._config.runtime, self.process
        limit_s, now_s = runtime.watchdog_ms / 1e3, time.monotonic()
        if process.exit_status is not None or process.begun_s is None or self._kill_s is not None:
            return ""
        silent_s = process.silent_s()
        if silent_s > limit_s:
            return f"is stalled: its loop has shown no life for {runtime.watchdog_ms:g} ms"
        if before is not None and process.ready:
            sent = before.process.vitals["frames"]
            taken = sum(process.vitals[counter] for counter in ("frames", "torn", "outrun"))
            missed = self._hearing.missed(sent, taken, silent_s, now_s, limit_s)
            if missed:
                return f"is deaf: has taken up none of the last {missed} frames of {before.name}"
        waited_s = now_s - process.begun_s
        if not process.ready and waited_s > runtime.ready_timeout_s + runtime.stop_timeout_s:
            return f"was not ready within {waited_s:.0f} s"
        return ""

    def end(self, stall: str) -> None:
        """SIGTERM now, SIGKILL after its grace (`enforce`)."""
        self.stall = stall
        self.process.send(signal.SIGTERM)
        self._kill_s = time.monotonic() + self._config.runtime.term_grace_ms / 1e3

    def enforce(self) -> None:
        """Kills a process whose grace is over."""
        if self._kill_s is not None and time.monotonic() > self._kill_s:
            self.process.send(signal.SIGKILL)

    def close(self) -> None:
        """Kills what still runs."""
        self.process.close()
        if self._spare is not None:
            self._spare.close()
