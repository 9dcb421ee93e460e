"""The listener's state of one vehicle: its newest estimate, decoded on reading, and the number of lost ones."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

import zenoh

from birdslam.runtime.transport.endpoints import attached
from birdslam.runtime.wire import Trace, WireError, decode
from birdslam.types import INVALIDATING, Estimate

MAX_CLOCK_OFFSET_MS = 50.0  # an estimate from further in the future is not on time: a clock is wrong
_NO_TRACE = Trace()

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FleetReading:
    """The newest estimate of one vehicle with three separate states.

    `alive`: its optimizer runs and is connected. `on_time`: the estimate is not older than allowed. `valid`: the
    estimate is valid. `age_ms`: time since the capture of the frame (Estimate.t_utc_ns), which needs synchronized
    clocks (PTP, NTP). `silent_ms`: time since its last message, by this computer's clock. Both are infinite without a
    message.
    """

    vehicle: str
    estimate: Estimate | None
    alive: bool
    on_time: bool
    valid: bool
    age_ms: float
    silent_ms: float
    lost: int = 0  # estimates lost since the start of this client, by their numbers
    trace: Trace = _NO_TRACE  # stages of the estimate, by the vehicle's clock

    @property
    def usable(self) -> bool:
        """Alive, on time and valid, all three."""
        return self.alive and self.on_time and self.valid


@dataclass(frozen=True)
class Received:
    """Counts of messages received from one vehicle."""

    estimates: int
    received_bytes: int  # payloads and attachments of all its messages
    lost: int
    malformed: int


@dataclass
class VehicleSlot:
    """One vehicle. `fresh`: its newest estimate is unread; `waiting`: its encoded bytes."""

    alive: set[str] = field(default_factory=set)
    fresh: bool = False
    waiting: bytes | None = None
    estimate: Estimate | None = None
    trace: Trace = _NO_TRACE
    t_received_ns: int = 0
    estimates: int = 0
    received_bytes: int = 0
    lost: int = 0
    malformed: int = 0
    t_reported_ns: int = 0  # when `estimates` last yielded a reading of it
    healths: dict[str, bytes] = field(default_factory=dict)

    @property
    def received(self) -> Received:
        """Counts so far."""
        return Received(self.estimates, self.received_bytes, self.lost, self.malformed)

    def receive(self, vehicle: str, sample: zenoh.Sample, t_received_ns: int) -> bool:
        """Stores an encoded estimate in place of the previous one; returns False if it is malformed."""
        payload = self._payload(sample)
        try:
            trace = attached(sample, Trace) or _NO_TRACE
            if sample.kind != zenoh.SampleKind.PUT:
                raise WireError(f"sent as {sample.kind}")
        except WireError as error:
            self._count_malformed(vehicle, error)
            return False
        if self.trace.number and trace.number:
            self.lost += max(0, trace.number - self.trace.number - 1)  # a restarted sender counts from 1 on
        self.waiting, self.trace, self.t_received_ns = payload, trace, t_received_ns
        self.estimates += 1
        return True

    def receive_health(self, node: str, sample: zenoh.Sample) -> None:
        """Stores a node's health."""
        self.healths[node] = self._payload(sample)

    def _payload(self, sample: zenoh.Sample) -> bytes:
        payload = bytes(sample.payload)
        self.received_bytes += len(payload) + (0 if sample.attachment is None else len(sample.attachment))
        return payload

    def _count_malformed(self, vehicle: str, error: WireError) -> None:
        self.malformed += 1
        if self.malformed == 1:
            log.warning("vehicle %s: ignored a malformed message; later ones are only counted: %s", vehicle, error)

    def reading(self, vehicle: str, max_age_ms: float) -> FleetReading:
        """Returns the current reading. A malformed estimate is counted, and the previous one is kept."""
        if self.waiting is not None:
            try:
                self.estimate = decode(self.waiting, Estimate)
            except WireError as error:
                self._count_malformed(vehicle, error)
            self.waiting = None
        alive, estimate = "optimize" in self.alive, self.estimate
        silent_ms = (time.monotonic_ns() - self.t_received_ns) / 1e6 if self.t_received_ns else float("inf")
        if estimate is None:
            return FleetReading(vehicle, None, alive, False, False, float("inf"), silent_ms, self.lost)
        age_ms = (time.time_ns() - estimate.t_utc_ns) / 1e6
        on_time = -MAX_CLOCK_OFFSET_MS <= age_ms <= max_age_ms
        valid = estimate.valid and INVALIDATING.isdisjoint(estimate.status)
        return FleetReading(vehicle, estimate, alive, on_time, valid, age_ms, silent_ms, self.lost, self.trace)
