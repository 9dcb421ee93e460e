"""Restart policy of a node, and the frame at which it resumes."""

from __future__ import annotations

import mmap
import os
from collections import deque
from pathlib import Path

import msgspec
import numpy as np

from birdslam.runtime.configuration import RuntimeConfig
from birdslam.runtime.process.vitals import Vitals


class Resume(msgspec.Struct, frozen=True):
    """The frame after the last one of a dead node, and the times of that last frame."""

    next_frame: int
    t_source_ns: int
    t_capture_ns: int


class Assignment(msgspec.Struct, frozen=True):
    """The message that starts the work of a prepared process."""

    restarts: int = 0  # of this node in this run
    cause: str = ""  # of the last restart
    resume: Resume | None = None


FIRST = Assignment()


class Restarts:
    """The restart policy of one node: immediately, then with exponential delay, up to a limit within a time window."""

    def __init__(self, config: RuntimeConfig) -> None:
        self.count = 0
        self.cause = ""
        self._config = config
        self._recent_s: deque[float] = deque()
        self._resume: Resume | None = None

    def died(self, now_s: float, cause: str, vitals: Vitals) -> float | None:
        """Returns the time of the next start, on the clock of `now_s`; None if the limit of restarts is reached."""
        config = self._config
        while self._recent_s and now_s - self._recent_s[0] > config.restart_window_s:
            self._recent_s.popleft()
        if len(self._recent_s) >= config.restarts_max:
            return None
        before = len(self._recent_s)
        self._recent_s.append(now_s)
        self.count += 1
        self.cause = cause
        if vitals["next_frame"]:  # else it died before its first frame: keep the previous resume point
            self._resume = Resume(vitals["next_frame"], vitals["t_source_ns"], vitals["t_capture_ns"])
        delay_ms = config.restart_backoff_ms * 2 ** (before - 1) if before else 0.0
        return now_s + min(delay_ms, config.restart_backoff_max_ms) / 1e3

    def assignment(self) -> Assignment:
        """Returns the assignment of the next process."""
        return Assignment(self.count, self.cause, self._resume)


class EpochFile:
    """The last published epoch, in a memory-mapped file of the vehicle's runtime directory; -1 if there is none.

    The epoch is stored before the first estimate that has it and survives a kill -9 of all processes, so epochs never
    repeat until the computer restarts.
    """

    def __init__(self, path: Path) -> None:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            os.posix_fallocate(fd, 0, 8)
            self._next = np.frombuffer(mmap.mmap(fd, 8), dtype=np.int64)
        finally:
            os.close(fd)
        self.last = max(-1, int(self._next[0]) - 1)

    def store(self, epoch: int) -> None:
        """Stores an epoch before it is published; ignores smaller ones."""
        if epoch > self.last:
            self.last = epoch
            self._next[0] = epoch + 1
