"""Readings of the car's own speed from the bus, attached to the frames of a live drive."""

from __future__ import annotations

import logging
from collections import deque
from typing import Protocol

import msgspec

from birdslam.runtime.transport.bus import Message
from birdslam.sources.speed_log import MAX_AGE_NS, MAX_READINGS, shifted
from birdslam.types import SpeedReading

log = logging.getLogger(__name__)


class Readings(Protocol):
    """The used interface of a bus.Subscriber of the topic `speed`."""

    dropped: int
    malformed: int

    def recv(self, timeout_s: float | None = None) -> Message | None: ...


class CarSpeeds:
    """The readings that arrived in the last second, at most MAX_READINGS."""

    def __init__(self, subscriber: Readings) -> None:
        self._subscriber = subscriber
        self._recent: deque[tuple[int, SpeedReading]] = deque(maxlen=MAX_READINGS)  # arrival on CLOCK_MONOTONIC
        self._taken = 0
        self._warned = False

    def at(self, t_source_ns: int, t_capture_ns: int) -> tuple[SpeedReading, ...]:
        """Returns the readings for a frame, on the clock of its source.

        Readings arrive on CLOCK_MONOTONIC; a reading with time 0 gets its time of arrival.
        """
        for _ in range(MAX_READINGS):  # bounded, so that a flood of readings does not delay the frame
            message = self._subscriber.recv(0.0)
            if message is None:
                break
            reading: SpeedReading = message.record
            if reading.t_ns == 0:
                reading = msgspec.structs.replace(reading, t_ns=message.t_received_ns)
            if t_source_ns != t_capture_ns:
                reading = shifted(reading, t_source_ns - t_capture_ns)
            self._recent.append((message.t_received_ns, reading))
            self._taken += 1
        while self._recent and self._recent[0][0] <= t_capture_ns - MAX_AGE_NS:
            self._recent.popleft()
        if self._subscriber.dropped and not self._warned:
            self._warned = True
            log.warning("the car's speed: readings are lost: more arrive than fit into a frame, or the bus drops some")
        return tuple(reading for _, reading in self._recent)

    def counters(self) -> dict[str, int]:
        """Returns the counters since the start, named as in wire.Health."""
        taken = self._subscriber
        return {"speeds": self._taken, "speeds_dropped": taken.dropped, "malformed": taken.malformed}
