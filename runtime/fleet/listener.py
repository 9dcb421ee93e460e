"""The client of a fleet: each vehicle's newest estimate, with separate states alive, on time and valid.

It stores the newest message of each vehicle and decodes it on reading; vehicles are read in turn, so that a flood of
one does not affect the others.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import zenoh

from birdslam.queries import MapSnapshot, Trajectory
from birdslam.runtime.configuration import FleetConfig
from birdslam.runtime.fleet.link import open_link
from birdslam.runtime.fleet.reading import FleetReading, Received, VehicleSlot
from birdslam.runtime.topology import TOPICS, check_name, every_key, key_of, vehicle_and_topic
from birdslam.runtime.transport.bus import BusClosed
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.transport.replies import REPLY_S, query_in_background, whole_reply
from birdslam.runtime.transport.reply_parts import whole_map, whole_trajectory
from birdslam.runtime.transport.session import close_session
from birdslam.runtime.wire import Health, WireError, decode

MAX_VEHICLES = 1_000  # unexpected ones; messages of more are counted and dropped
_SWEEPS = 4  # checks for silent vehicles per max_age_ms

__all__ = ["Fleet", "FleetReading", "Received"]

log = logging.getLogger(__name__)


class Fleet(Closing):
    """A subscriber of all vehicles' estimates at one router; a context manager.

        here = FleetConfig(router="tls/10.0.0.1:7448", ca="ca.pem", certificate="operator.pem", key="operator.key")
        with Fleet(here) as fleet:
            for reading in fleet.estimates(max_age_ms=500):    # each estimate on arrival, and each missing one
                if not reading.usable:
                    look_after(reading.vehicle)                # not alive, not on time, or not valid
        for reading in fleet.readings(max_age_ms=500):         # or the newest one of each, whenever you need them

    Vehicles in `config.vehicles` are reported from the start, others after their first message. Raises
    ConfigurationError for an invalid table, BusError without a connection within `timeout_s`.
    """

    def __init__(self, config: FleetConfig, timeout_s: float = 10.0) -> None:
        self._slots: dict[str, VehicleSlot] = {check_name("vehicle", name): VehicleSlot() for name in config.vehicles}
        self._unread: deque[str] = deque()  # vehicles with unread estimates, oldest first
        self._changed = threading.Condition()
        self._closed = False
        self.refused = 0  # messages with invalid keys, or of too many vehicles
        self._session = open_link(config, timeout_s)
        declare = self._session.declare_subscriber
        self._subscribers: list[Any] = [
            declare(every_key("estimate"), zenoh.handlers.Callback(self._receive, indirect=False)),
            declare(every_key("health/*"), zenoh.handlers.Callback(self._receive_health, indirect=False)),
            self._session.liveliness().declare_subscriber(
                every_key("alive/*"), zenoh.handlers.Callback(self._liveliness_changed, indirect=False), history=True
            ),
        ]

    # --- callbacks on zenoh's threads ---

    def _slot_of(self, key: str) -> tuple[str, str, VehicleSlot] | None:
        """Returns (vehicle, topic, slot) of a key, with the lock held; None for an ignored key."""
        named = vehicle_and_topic(key)
        if named is None or (named[0] not in self._slots and len(self._slots) >= MAX_VEHICLES):
            self.refused += 1
            if self.refused == 1:
                log.warning("%.100s: ignored, as are further such messages", key)
            return None
        return named[0], named[1], self._slots.setdefault(named[0], VehicleSlot())

    def _receive(self, sample: zenoh.Sample) -> None:
        t_received_ns = time.monotonic_ns()
        with self._changed:
            found = self._slot_of(str(sample.key_expr))
            if found is None:
                return
            vehicle, _, slot = found
            if slot.receive(vehicle, sample, t_received_ns) and not slot.fresh:
                slot.fresh = True
                self._unread.append(vehicle)
                self._changed.notify_all()

    def _receive_retained(self, reply: zenoh.Reply) -> None:
        """Receives a vehicle's last estimate from before this client, unless a newer one has arrived."""
        if reply.ok is not None:
            named = vehicle_and_topic(str(reply.ok.key_expr))
            with self._changed:
                missed = named is not None and named[0] in self._slots and not self._slots[named[0]].t_received_ns
            if missed:
                self._receive(reply.ok)

    def _receive_health(self, sample: zenoh.Sample) -> None:
        with self._changed:
            found = self._slot_of(str(sample.key_expr))
            if found is not None and found[1] in TOPICS:
                found[2].receive_health(found[1].rpartition("/")[2], sample)

    def _liveliness_changed(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        with self._changed:
            found = self._slot_of(str(sample.key_expr))
            if found is None:
                return
            vehicle, topic, slot = found
            node = topic.rpartition("/")[2]
            (slot.alive.add if alive else slot.alive.discard)(node)
            asks = alive and node == "optimize" and not slot.t_received_ns
            self._changed.notify_all()
        if asks:
            query_in_background(self._session, key_of(vehicle, "estimate"), self._receive_retained)

    # --- public methods ---

    @property
    def connected(self) -> bool:
        """Whether the router is connected. Without it all vehicles are soon not alive."""
        return bool(self._session.info.routers_zid())

    @property
    def vehicles(self) -> tuple[str, ...]:
        """The vehicles that are expected or have sent a message, by name."""
        with self._changed:
            return tuple(sorted(self._slots))

    def alive(self, vehicle: str) -> frozenset[str]:
        """Returns the alive nodes of a vehicle. Raises KeyError for an unknown one."""
        with self._changed:
            return frozenset(self._slots[vehicle].alive)

    def received(self, vehicle: str) -> Received:
        """Returns the counts of messages received from a vehicle. Raises KeyError for an unknown one."""
        with self._changed:
            slot = self._slots[vehicle]
            return slot.received

    def latest(self, vehicle: str, max_age_ms: float = 500.0) -> FleetReading:
        """Returns the newest estimate of one vehicle, without waiting. Raises KeyError for an unknown one."""
        with self._changed:
            return self._slots[vehicle].reading(vehicle, max_age_ms)

    def readings(self, max_age_ms: float = 500.0) -> tuple[FleetReading, ...]:
        """Returns the newest estimate of each vehicle by name, without waiting; also of silent vehicles."""
        return tuple(self.latest(vehicle, max_age_ms) for vehicle in self.vehicles)

    def wait(self, timeout_s: float | None = None, max_age_ms: float = 500.0) -> FleetReading | None:
        """Returns the newest estimate of the vehicle that has waited longest; None if none arrives in time.

        Raises BusClosed after `close`, also from another thread.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._unread, timeout_s)
            if self._closed:
                raise BusClosed("the client of the fleet is closed")
            if not self._unread:
                return None
            vehicle = self._unread.popleft()
            slot = self._slots[vehicle]
            slot.fresh = False
            return slot.reading(vehicle, max_age_ms)

    def estimates(self, max_age_ms: float = 500.0) -> Iterator[FleetReading]:
        """Yields a reading of each vehicle's estimates on arrival, until the client is closed.

        For a vehicle without an estimate younger than `max_age_ms` it yields a reading every `max_age_ms`. Of several
        estimates between two readings only the newest is yielded.
        """
        period_ns = round(max_age_ms * 1e6)
        sweep_ns = time.monotonic_ns() + period_ns
        while True:
            try:
                reading = self.wait(max(0.0, (sweep_ns - time.monotonic_ns()) / 1e9), max_age_ms)
            except BusClosed:
                return
            now_ns = time.monotonic_ns()
            if reading is not None and reading.estimate is not None:
                self._slots[reading.vehicle].t_reported_ns = now_ns
                yield reading
            if now_ns >= sweep_ns:
                sweep_ns = now_ns + period_ns // _SWEEPS
                for vehicle in self.vehicles:
                    slot = self._slots[vehicle]
                    late = self.latest(vehicle, max_age_ms)
                    if now_ns - slot.t_reported_ns >= period_ns and not late.on_time:
                        slot.t_reported_ns = now_ns
                        yield late

    def health(self, vehicle: str, node: str) -> Health | None:
        """Returns the last health of a vehicle's node; None if there is none, or it was malformed."""
        with self._changed:
            slot = self._slots.get(vehicle)
            data = slot.healths.get(node) if slot else None
        try:
            return None if data is None else decode(data, Health)
        except WireError:
            return None

    def map(self, vehicle: str, timeout_s: float = REPLY_S) -> MapSnapshot | None:
        """Returns a vehicle's whole map of its newest epoch; None without a reply.

        Raises BusError with the reason if the query is refused or a part is lost.
        """
        parts = whole_reply(self._session, vehicle, "map", timeout_s, {})
        return whole_map(parts) if parts else None

    def trajectory(self, vehicle: str, last_s: float | None = None, timeout_s: float = REPLY_S) -> Trajectory | None:
        """Returns the trajectories of a vehicle and its tracks, of its newest epoch or last `last_s`; else as `map`."""
        parameters = {} if last_s is None else {"last_s": last_s}
        parts = whole_reply(self._session, vehicle, "trajectory", timeout_s, parameters)
        return whole_trajectory(parts) if parts else None

    def configuration(self, vehicle: str, timeout_s: float = REPLY_S) -> dict[str, Any] | None:
        """Returns a vehicle's configuration as plain data, as in summary.json; else as `map`."""
        parts = whole_reply(self._session, vehicle, "configuration", timeout_s, {})
        return parts[0] if parts else None

    def close(self) -> None:
        """Closes the connection; waiting calls raise BusClosed. A second call does nothing."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        close_session(self._session)
