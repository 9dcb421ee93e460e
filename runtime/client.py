"""The planner's door: live estimates, with alive, on time and valid kept apart.

    from runtime.client import Planner

    with Planner("car") as planner:
        for estimate in planner.estimates():                   # each as it comes
            drive(estimate)

    reading = planner.latest(max_age_ms=100)                   # or the newest one, whenever you need it
    if reading.usable:
        drive(reading.estimate)

A planner can start before the system does, and lives through its restarts (`Estimate.epoch` then says that the world
frame began anew). It can never slow the vehicle down: a planner that is busy gets only the newest estimate.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from birdslam.types import INVALIDATING, Estimate
from runtime.bus import Bus, BusClosed, Message

_number = itertools.count()  # tells the planners of one process apart


@dataclass(frozen=True)
class Reading:
    """The newest estimate, and three different things to know about it.

    `alive`: the optimizer runs. `on_time`: the estimate is young enough. `valid`: it is one that may be driven by.
    `age_ms` is the time since the camera took the frame (Estimate.t_capture_ns), on CLOCK_MONOTONIC, which all
    processes of one machine share: it means nothing on another machine. Without an estimate it is infinite.
    """

    estimate: Estimate | None
    alive: bool
    on_time: bool
    valid: bool
    age_ms: float
    left_ms: float | None = None  # of its latency budget when it was sent; negative: it is late

    @property
    def usable(self) -> bool:
        """Alive, on time and valid, all three."""
        return self.alive and self.on_time and self.valid


class Planner:
    """A subscriber of one vehicle's estimates; a context manager.

    Raises ValueError for a bad vehicle name, PermissionError where the runtime directory is open to other users.
    """

    def __init__(self, vehicle: str = "car", runtime_dir: Path | None = None) -> None:
        self._bus = Bus(vehicle, f"planner-{os.getpid()}-{next(_number)}", runtime_dir=runtime_dir)
        self._subscriber = self._bus.subscriber("estimate")

    def latest(self, max_age_ms: float = 200.0) -> Reading:
        """The newest estimate so far, at once; `on_time` where it is no older than `max_age_ms`."""
        newest = self._subscriber.newest
        estimate: Estimate | None = newest.record if newest else None
        alive = "optimize" in self._bus.alive
        if estimate is None:
            return Reading(None, alive, on_time=False, valid=False, age_ms=float("inf"))
        age_ms = (time.monotonic_ns() - estimate.t_capture_ns) / 1e6
        valid = estimate.valid and INVALIDATING.isdisjoint(estimate.status)
        left_ns = newest.trace.left_ns if newest else None
        left_ms = None if left_ns is None else left_ns / 1e6
        return Reading(estimate, alive, 0.0 <= age_ms <= max_age_ms, valid, age_ms, left_ms)

    def wait(self, timeout_s: float | None = None) -> Estimate | None:
        """The next estimate, as soon as there is one; None where none came in time. Raises BusClosed once closed.

        Of those that came since the last call only the newest is left. One thread may wait, others use `latest`.
        """
        message = self.wait_message(timeout_s)
        return message.record if message else None

    def wait_message(self, timeout_s: float | None = None) -> Message | None:
        """Like `wait`, with the message's trace: where the estimate's time went."""
        return self._subscriber.recv(timeout_s)

    def estimates(self) -> Iterator[Estimate]:
        """Each estimate as it comes, for as long as the planner is open; through restarts of the system."""
        while True:
            try:
                estimate = self.wait()
            except BusClosed:
                return
            if estimate is not None:
                yield estimate

    def close(self) -> None:
        """Leaves the bus, and wakes who waits; a second call does nothing."""
        self._bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
