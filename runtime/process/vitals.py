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
    """Counters of one node, all from zero.

    `beat_ns` is CLOCK_MONOTONIC of its loop's last turn. `prepared` turns 1 when all that takes long is loaded, `ready`
    when it is at work, `ended` when the end of the source went through. `next_frame` is one more than the last frame
    that it sent, stored before it was sent, with that frame's times.
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
