"""A node's heartbeat and counters, in memory that it shares with the supervisor.

The memory is an anonymous file whose descriptor the child inherits: it needs no cleanup, and the counters of a killed
node remain readable. Each counter has one writer; an aligned 8-byte store is atomic.
"""

from __future__ import annotations

import mmap
import os
import time

import numpy as np

COUNTERS = (
    *("beat_ns", "prepared", "ready", "ended"),
    *("frames", "dropped", "malformed", "torn"),
    *("next_frame", "t_source_ns", "t_capture_ns", "coasted", "outrun", "looks", "speeds", "speeds_dropped"),
)


class Vitals:
    """Counters of one node, starting at zero.

    `beat_ns`: CLOCK_MONOTONIC of the last heartbeat. Flags: `prepared` after loading, `ready` at work, `ended` after
    END_OF_SOURCE. `next_frame`: the last sent frame plus one, stored before sending, with that frame's times.
    """

    def __init__(self, fd: int | None = None) -> None:
        """Maps the inherited descriptor; creates new memory if `fd` is None."""
        size = 8 * len(COUNTERS)
        self.fd = os.memfd_create("birdslam-vitals") if fd is None else fd
        if fd is None:
            os.ftruncate(self.fd, size)
        self._counters = np.frombuffer(mmap.mmap(self.fd, size), dtype=np.int64)

    def beat(self) -> None:
        """Records the time of the heartbeat."""
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
