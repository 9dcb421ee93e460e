"""When a node is restarted, and from which frame it resumes."""

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
    """Where a node that died had come to: one more than its last frame, and that frame's times."""

    next_frame: int
    t_source_ns: int
    t_capture_ns: int


class Assignment(msgspec.Struct, frozen=True):
    """What a prepared process is sent when its work begins."""

    restarts: int = 0  # of this node in this run
    cause: str = ""  # of the last one
    resume: Resume | None = None


FIRST = Assignment()


class Restarts:
    """The rule of one node: at once, then after a growing delay, and no more when it keeps failing.

    Raises nothing: `died` says when the next process is due, or that there is none.
    """

    def __init__(self, config: RuntimeConfig) -> None:
        self.count = 0
        self.cause = ""
        self._config = config
        self._recent_s: deque[float] = deque()
        self._resume: Resume | None = None

    def died(self, now_s: float, cause: str, vitals: Vitals) -> float | None:
        """When the next one is due, on the clock of `now_s`; None where it died too often of late."""
        config = self._config
        while self._recent_s and now_s - self._recent_s[0] > config.restart_window_s:
            self._recent_s.popleft()
        if len(self._recent_s) >= config.restarts_max:
            return None
        before = len(self._recent_s)
        self._recent_s.append(now_s)
        self.count += 1
        self.cause = cause
        if vitals["next_frame"]:  # else it died before its first frame: what the one before it left still holds
            self._resume = Resume(vitals["next_frame"], vitals["t_source_ns"], vitals["t_capture_ns"])
        delay_ms = config.restart_backoff_ms * 2 ** (before - 1) if before else 0.0
        return now_s + min(delay_ms, config.restart_backoff_max_ms) / 1e3

    def assignment(self) -> Assignment:
        """For the next process."""
        return Assignment(self.count, self.cause, self._resume)


class EpochFile:
    """The last epoch that planners may have seen, in a file of the vehicle's runtime directory.

    It is mapped: a store takes no time, comes before the estimate that bears the epoch, and outlives a kill -9 of
    everything, so that epochs never repeat while the computer is up. -1 where there was none.
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
        """Notes an epoch, before it is sent; a smaller one is no news."""
        if epoch > self.last:
            self.last = epoch
            self._next[0] = epoch + 1
