"""The planner's client: live estimates, with separate states alive, on time and valid.

A planner can start before the system and survives its restarts (`Estimate.epoch` then increases). It cannot slow the
vehicle down: a busy planner receives only the newest estimate. A late planner receives the last estimate at once and
queries the rest: `map`, `trajectory`, `nearby`, `configuration`, `health`.
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
    """The newest estimate with three separate states.

    `alive`: the optimizer runs. `on_time`: the estimate is not older than allowed. `valid`: the estimate is valid.
    `age_ms`: time since the capture of the frame (Estimate.t_capture_ns) on CLOCK_MONOTONIC, meaningful on the same
    machine only; infinite without an estimate.
    """

    estimate: Estimate | None
    alive: bool
    on_time: bool
    valid: bool
    age_ms: float
    left_ms: float | None = None  # rest of its latency budget when it was sent; negative: it is late
    trace: Trace = _NO_TRACE  # its stages, node by node

    @property
    def usable(self) -> bool:
        """Alive, on time and valid, all three."""
        return self.alive and self.on_time and self.valid


def reading_of(message: Message | None, alive: bool, max_age_ms: float) -> Reading:
    """Returns the reading of the newest message (None: no message); `alive`: whether the optimizer runs."""
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
            for reading in planner.estimates(max_age_ms=150):      # each estimate on arrival, and each missing one
                if reading.usable:
                    drive(reading.estimate)
                else:
                    slow_down(reading)                             # not alive, not on time, or not valid
        reading = planner.latest(max_age_ms=150)                   # or the newest one, whenever you need it

    Raises ValueError for an invalid vehicle name, PermissionError if other users can access the runtime directory.
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
        """Returns the newest estimate without waiting; `on_time` if it is not older than `max_age_ms`."""
        return self._reading(self._subscriber.newest, max_age_ms)

    def _reading(self, message: Message | None, max_age_ms: float) -> Reading:
        return reading_of(message, "optimize" in self._bus.alive, max_age_ms)

    def wait(self, timeout_s: float | None = None) -> Estimate | None:
        """Waits for the next estimate; returns None if none arrives in time. Raises BusClosed after `close`.

        Of several estimates since the last call only the newest is returned. Only one thread may wait.
        """
        message = self.wait_message(timeout_s)
        return message.record if message else None

    def wait_message(self, timeout_s: float | None = None) -> Message | None:
        """Like `wait`, but returns the message with its trace."""
        return self._subscriber.recv(timeout_s)

    def estimates(self, max_age_ms: float = 200.0) -> Iterator[Reading]:
        """Yields a reading of each estimate on arrival, until the planner is closed; also across restarts.

        If no estimate arrives for `max_age_ms`, it yields a reading that is not on time, every `max_age_ms`.
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
        """Returns the newest estimate, or another one, in the map frame (REP-105), without waiting.

        `lost`, with an infinite covariance, if the map process does not run, is lost, or is in another epoch. The pose
        may jump when `map_epoch` increases; the estimate does not.
        """
        newest, pose = self._subscriber.newest, self._map_poses.newest
        estimate = estimate or (newest.record if newest is not None else None)
        return NOWHERE if estimate is None else in_map(pose.record if pose is not None else None, estimate)

    def map(self, timeout_s: float = 2.0) -> MapSnapshot | None:
        """Returns the whole map of the newest epoch; None without a reply.

        Raises BusError with the reason if the query is refused or a part is lost.
        """
        parts = self._bus.query("map", timeout_s)
        return whole_map(parts) if parts else None

    def trajectory(self, last_s: float | None = None, timeout_s: float = 2.0) -> Trajectory | None:
        """Returns all trajectories of the newest epoch, or of its last `last_s` of source time; else as `map`."""
        parts = self._bus.query("trajectory", timeout_s, **({} if last_s is None else {"last_s": last_s}))
        return whole_trajectory(parts) if parts else None

    def nearby(self, timeout_s: float = 2.0) -> Nearby | None:
        """Returns all road users by closest approach, not a safety function; else as `map`."""
        parts = self._bus.query("nearby", timeout_s)
        return parts[0] if parts else None

    def configuration(self, timeout_s: float = 2.0) -> dict[str, Any] | None:
        """Returns the configuration of the run as plain data, as in summary.json; else as `map`."""
        parts = self._bus.query("configuration", timeout_s)
        return parts[0] if parts else None

    def health(self, node: str, timeout_s: float = 2.0) -> Health | None:
        """Returns a node's last health, about one second old; None without a reply."""
        healths = self._bus.retained(f"health/{node}", timeout_s)
        return healths[-1].record if healths else None

    def close(self) -> None:
        """Closes the connection; waiting calls raise BusClosed. A second call does nothing."""
        self._bus.close()
