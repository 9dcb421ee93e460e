"""What a listener knows of one vehicle: its newest estimate, decoded when it is read, and how many were lost."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

import zenoh

from birdslam.runtime.transport.endpoints import attached
from birdslam.runtime.wire import Trace, WireError, decode
from birdslam.types import INVALIDATING, Estimate

CLOCKS_APART_MS = 50.0  # an estimate that is younger than now by more is not on time: one of the two clocks is wrong
_NO_TRACE = Trace()

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FleetReading:
    """The newest estimate of one vehicle, and three different things to know about it.

    `alive`: its optimizer runs, and is reached. `on_time`: the estimate is young enough. `valid`: it says that it may
    be driven by. `age_ms` is the time since the camera took the frame (Estimate.t_utc_ns): keep the clocks of both
    computers synchronised (PTP, NTP). `silent_ms` needs only this computer's: the time since its last message came.
    Both are infinite where there is none.
    """

    vehicle: str
    estimate: Estimate | None
    alive: bool
    on_time: bool
    valid: bool
    age_ms: float
    silent_ms: float
    lost: int = 0  # of its estimates, on the way here, since this client listens: its sender numbers them
    trace: Trace = _NO_TRACE  # where its time went; the stamps are of the vehicle's own clock

    @property
    def usable(self) -> bool:
        """Alive, on time and valid, all three."""
        return self.alive and self.on_time and self.valid


@dataclass(frozen=True)
class Received:
    """How much has been received of one vehicle since this client listens."""

    estimates: int
    received_bytes: int  # payloads and attachments of all its messages
    lost: int
    malformed: int


@dataclass
class VehicleSlot:
    """One vehicle. `fresh`: its newest estimate has not been read; `waiting`: those bytes have not been decoded."""

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
    t_reported_ns: int = 0  # when a reading of it was last given by `estimates`
    healths: dict[str, bytes] = field(default_factory=dict)

    @property
    def received(self) -> Received:
        """Counts so far."""
        return Received(self.estimates, self.received_bytes, self.lost, self.malformed)

    def receive(self, vehicle: str, sample: zenoh.Sample, t_received_ns: int) -> bool:
        """Takes an estimate in, undecoded, in place of the one before; False where it is malformed."""
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
        """The same of a node's health."""
        self.healths[node] = self._payload(sample)

    def _payload(self, sample: zenoh.Sample) -> bytes:
        payload = bytes(sample.payload)
        self.received_bytes += len(payload) + (0 if sample.attachment is None else len(sample.attachment))
        return payload

    def _count_malformed(self, vehicle: str, error: WireError) -> None:
        self.malformed += 1
        if self.malformed == 1:
            log.warning("vehicle %s: a malformed message is ignored, and all that follow: %s", vehicle, error)

    def reading(self, vehicle: str, max_age_ms: float) -> FleetReading:
        """Of now. An estimate that turns out malformed counts as such, and the one before it stays."""
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
        on_time = -CLOCKS_APART_MS <= age_ms <= max_age_ms
        valid = estimate.valid and INVALIDATING.isdisjoint(estimate.status)
        return FleetReading(vehicle, estimate, alive, on_time, valid, age_ms, silent_ms, self.lost, self.trace)
