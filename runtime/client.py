"""The planner's client: live estimates, with alive, on time and valid as separate answers.

A planner can start before the system does, and lives through its restarts (`Estimate.epoch` then says that the world
frame restarted). It can never slow the vehicle down: a planner that is busy gets only the newest estimate. One that
comes late has the last estimate at once, and queries the rest: `map`, `trajectory`, `nearby`, `configuration`,
`health`.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from birdslam.loops.map_pose import NOWHERE, InMap, in_map
from birdslam.queries import MapSnapshot, Nearby, Trajectory
from birdslam.runtime.transport.bus import Bus, BusClosed, Message
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.transport.reply_parts import whole_map, whole_trajectory
from birdslam.runtime.wire import Health, Trace
from birdslam.types import INVALIDATING, Estimate

_NO_TRACE = Trace()
_number = itertools.count()  # distinguishes the planners of one process


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
    trace: Trace = _NO_TRACE  # where its time went, node by node

    @property
    def usable(self) -> bool:
        """Alive, on time and valid, all three."""
        return self.alive and self.on_time and self.valid


def reading_of(message: Message | None, alive: bool, max_age_ms: float) -> Reading:
    """The newest message (None: none has come) with its age and validity; `alive`: whether the optimizer runs."""
    if message is None:
        return Reading(None, alive, on_time=False, valid=False, age_ms=float("inf"))
    estimate: Estimate = message.record
    age_ms = (time.monotonic_ns() - estimate.t_capture_ns) / 1e6
    valid = estimate.valid and INVALIDATING.isdisjoint(estimate.status)
    left_ms = None if message.trace.left_ns is None else message.trace.left_ns / 1e6
    return Reading(estimate, alive, 0.0 <= age_ms <= max_age_ms, valid, age_ms, left_ms, message.trace)


class Planner(Closing):
    """A subscriber of one vehicle's estimates; a context manager.

        with Planner("car") as planner:
            for reading in planner.estimates(max_age_ms=150):      # each as it comes, or that none came in time
                if reading.usable:
                    drive(reading.estimate)
                else:
                    slow_down(reading)                             # not alive, not on time, or not valid
        reading = planner.latest(max_age_ms=150)                   # or the newest one, whenever you need it

    Raises ValueError for a bad vehicle name, PermissionError where the runtime directory is open to other users.
    """

    def __init__(self, vehicle: str = "car", runtime_dir: Path | None = None) -> None:
        self._bus = Bus(vehicle, f"planner-{os.getpid()}-{next(_number)}", runtime_dir=runtime_dir)
        self._subscriber = self._bus.subscriber("estimate")
        self._map_poses = self._bus.subscriber("map_pose")
        self._bus.on_alive(self._catch_up)

    def _catch_up(self, node: str, alive: bool) -> None:
        if node == "optimize" and alive and self._subscriber.newest is None:
            self._bus.catch_up("estimate", self._subscriber)
        if node == "map" and alive and self._map_poses.newest is None:
            self._bus.catch_up("map_pose", self._map_poses)

    def latest(self, max_age_ms: float = 200.0) -> Reading:
        """The newest estimate so far, at once; `on_time` where it is no older than `max_age_ms`."""
        return self._reading(self._subscriber.newest, max_age_ms)

    def _reading(self, message: Message | None, max_age_ms: float) -> Reading:
        return reading_of(message, "optimize" in self._bus.alive, max_age_ms)

    def wait(self, timeout_s: float | None = None) -> Estimate | None:
        """The next estimate, as soon as there is one; None where none came in time. Raises BusClosed once closed.

        Of those that came since the last call only the newest is left. One thread may wait, others use `latest`.
        """
        message = self.wait_message(timeout_s)
        return message.record if message else None

    def wait_message(self, timeout_s: float | None = None) -> Message | None:
        """Like `wait`, with the message's trace: where the estimate's time went."""
        return self._subscriber.recv(timeout_s)

    def estimates(self, max_age_ms: float = 200.0) -> Iterator[Reading]:
        """A reading of each estimate as it comes, for as long as the planner is open; through restarts of the system.

        Never silence: when the newest estimate grows older than `max_age_ms` (or there is none for so long), a reading
        says that it is not on time, and again after each further `max_age_ms`.
        """
        while True:
            age_ms = self.latest().age_ms
            fresh_ms = max_age_ms - age_ms if 0.0 <= age_ms < max_age_ms else max_age_ms
            try:
                message = self.wait_message(fresh_ms / 1e3)
            except BusClosed:
                return
            if message is not None:
                yield self._reading(message, max_age_ms)
            elif not (reading := self.latest(max_age_ms)).on_time:
                yield reading

    def in_map(self, estimate: Estimate | None = None) -> InMap:
        """The newest estimate, or another one, in the map of places (REP-105's map frame), at once.

        `lost`, with an infinite covariance, where the map process does not know, was never there, or knows another
        epoch. Its pose may jump where `map_epoch` rises; the estimate itself never does.
        """
        newest, pose = self._subscriber.newest, self._map_poses.newest
        estimate = estimate or (newest.record if newest is not None else None)
        return NOWHERE if estimate is None else in_map(pose.record if pose is not None else None, estimate)

    def map(self, timeout_s: float = 2.0) -> MapSnapshot | None:
        """The whole map of the newest epoch; None where no reply comes.

        Raises BusError with the reason where it is refused, or where a part of it was lost.
        """
        parts = self._bus.query("map", timeout_s)
        return whole_map(parts) if parts else None

    def trajectory(self, last_s: float | None = None, timeout_s: float = 2.0) -> Trajectory | None:
        """Where everybody has been in the newest epoch, or in its last `last_s` of the source's time; else as `map`."""
        parts = self._bus.query("trajectory", timeout_s, **({} if last_s is None else {"last_s": last_s}))
        return whole_trajectory(parts) if parts else None

    def nearby(self, timeout_s: float = 2.0) -> Nearby | None:
        """Every road user by its closest approach, an aid and no safety function; else as `map`."""
        parts = self._bus.query("nearby", timeout_s)
        return parts[0] if parts else None

    def configuration(self, timeout_s: float = 2.0) -> dict[str, Any] | None:
        """The configuration of the run as plain data, as in summary.json; else as `map`."""
        parts = self._bus.query("configuration", timeout_s)
        return parts[0] if parts else None

    def health(self, node: str, timeout_s: float = 2.0) -> Health | None:
        """A node's last health, of the last second or so; None where it does not answer."""
        healths = self._bus.retained(f"health/{node}", timeout_s)
        return healths[-1].record if healths else None

    def close(self) -> None:
        """Leaves the bus, and wakes who waits; a second call does nothing."""
        self._bus.close()
