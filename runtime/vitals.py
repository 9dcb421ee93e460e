"""A node's signs of life, in memory that it shares with the supervisor.

The memory is an anonymous file whose descriptor the supervisor hands down: it has no name to clean up, and what a
killed node counted can still be read. Each counter has one writer; an aligned 8-byte store is never seen by halves.
"""

from __future__ import annotations

import mmap
import os
import time

import numpy as np

COUNTERS = ("beat_ns", "ready", "frames", "dropped", "malformed", "torn")


class Vitals:
    """Counters of one node: `beat_ns` is CLOCK_MONOTONIC of its loop's last turn, `ready` is 1 once it is at work."""

    def __init__(self, fd: int | None = None) -> None:
        """Maps what the supervisor handed down; without `fd`, makes new memory."""
        size = 8 * len(COUNTERS)
        self.fd = os.memfd_create("birdslam-vitals") if fd is None else fd
        if fd is None:
            os.ftruncate(self.fd, size)
        self._counters = np.frombuffer(mmap.mmap(self.fd, size), dtype=np.uint64)

    def beat(self) -> None:
        """The loop is alive."""
        self._counters[0] = time.monotonic_ns()

    def count(self, **counters: int) -> None:
        """Stores new values."""
        for name, value in counters.items():
            self._counters[COUNTERS.index(name)] = value

    def __getitem__(self, name: str) -> int:
        return int(self._counters[COUNTERS.index(name)])

    def close(self) -> None:
        """Closes the descriptor; the counters stay readable."""
        os.close(self.fd)
