"""The uplink of a vehicle to the router of its fleet: `birdslam uplink CONFIG.toml`, with the table [fleet].

A separate process and a planner of its vehicle's bus, so that it slows nothing down. It forwards estimates (at most
`fleet.estimates_hz`), healths and liveliness, and answers queries. Images and measurements stay in the vehicle. A slow
network drops messages, which the listener counts.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from birdslam.runtime.configuration import Configuration, ConfigurationError, FleetConfig
from birdslam.runtime.fleet.link import check, open_link
from birdslam.runtime.process import signals
from birdslam.runtime.process.notify import STATUS_S
from birdslam.runtime.process.sender import RateLimit, send
from birdslam.runtime.topology import PROCESSES, QUERIES, TOPICS, alive_key, key_of
from birdslam.runtime.transport.bus import Bus, BusClosed, BusError, Publisher, Subscriber
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.transport.queries import QueryRefused, QueryResponder, positive
from birdslam.runtime.transport.session import close_session
from birdslam.runtime.wire import Stage, Trace, WireError

FORWARDED = ("estimate", *(f"health/{node}" for node in PROCESSES))
_NODE = "uplink"
_MAX_STAGES = 7  # of a received trace, so that one more fits
_TRY_S = 2.0  # timeout of one attempt to connect


class Uplink(Closing):
    """Forwards messages from a vehicle's bus to the router until it is closed; closes the session too.

    A context manager. Raises as Bus does.
    """

    pause_s = STATUS_S

    def __init__(
        self, vehicle: str, config: FleetConfig, session: zenoh.Session, runtime_dir: Path | None = None
    ) -> None:
        self._session, self._vehicle = session, vehicle
        self._estimates_hz = config.estimates_hz
        self._bus = Bus(vehicle, f"{_NODE}-{threading.get_native_id()}", runtime_dir=runtime_dir)
        self._subscribers = {topic: self._bus.subscriber(topic) for topic in FORWARDED}
        self._publishers = {
            topic: Publisher(session, key_of(vehicle, topic), TOPICS[topic], _NODE, lossless=False, express=False)
            for topic in FORWARDED
        }
        handlers = {key_of(vehicle, name): self._handler(name) for name in QUERIES}
        self._responder = QueryResponder(session, handlers)
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._changes: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._forward, args=(topic,), name=topic, daemon=True) for topic in FORWARDED
        ]
        self._threads.append(threading.Thread(target=self._forward_liveliness, name="alive", daemon=True))
        for thread in self._threads:
            thread.start()
        self._bus.on_alive(self._alive_changed)

    @property
    def connected(self) -> bool:
        """Whether the router is connected."""
        return bool(self._session.info.routers_zid())

    @property
    def alive(self) -> frozenset[str]:
        """The vehicle's nodes that are alive."""
        return self._bus.alive & set(PROCESSES)

    def _alive_changed(self, node: str, alive: bool) -> None:
        if node not in PROCESSES:  # only the vehicle's nodes
            return
        self._changes.put((node, alive))
        if alive:
            for topic in (f"health/{node}", *(["estimate"] if node == "optimize" else [])):
                if self._subscribers[topic].newest is None:
                    self._bus.catch_up(topic, self._subscribers[topic])

    def _forward_liveliness(self) -> None:
        """Runs on a thread, so that zenoh's thread does not wait for the network."""
        while (change := self._changes.get()) is not None:
            node, alive = change
            if alive and node not in self._tokens:
                self._tokens[node] = self._session.liveliness().declare_token(alive_key(self._vehicle, node))
            elif not alive and node in self._tokens:
                self._tokens.pop(node).undeclare()

    def _forward(self, topic: str) -> None:
        subscriber: Subscriber = self._subscribers[topic]
        publisher = self._publishers[topic]
        due = RateLimit(self._estimates_hz if topic == "estimate" else None)
        while True:
            try:
                message = subscriber.recv()
                if message is None:
                    continue
                now_ns = time.monotonic_ns()
                if not due.passes(now_ns):
                    continue
                publisher.put(message.record, _with_uplink(message.trace, message.t_received_ns, now_ns))
            except BusClosed:
                return
            except (BusError, WireError) as error:  # only this message is lost
                print(f"birdslam: uplink: {topic}: {error}", file=sys.stderr, flush=True)

    def _handler(self, name: str) -> Any:
        def forward(parameters: Mapping[str, str]) -> Sequence[msgspec.Struct]:
            given = {key: value for key in QUERIES[name].parameters if (value := positive(parameters, key)) is not None}
            try:
                return self._bus.query(name, **given)
            except BusError as error:
                raise QueryRefused(str(error)) from error

        return forward

    def step(self) -> None:
        """Does nothing: threads send."""

    def close(self) -> None:
        """Stops forwarding; the fleet then sees the vehicle's nodes as not alive."""
        self._bus.close()  # wakes the forwarding threads
        self._changes.put(None)
        for thread in self._threads:
            thread.join()
        self._responder.close()
        close_session(self._session)


def _with_uplink(trace: Trace, received_ns: int, done_ns: int) -> Trace:
    """Adds the uplink's stage to the trace."""
    stages = (*trace.stages[:_MAX_STAGES], Stage(_NODE, received_ns, done_ns))
    return msgspec.structs.replace(trace, stages=stages)


def run(configuration: Configuration) -> None:
    """Runs until SIGTERM or SIGINT; waits for the router without limit. Raises ConfigurationError, and as Bus does."""
    vehicle, config = configuration.vehicle, configuration.fleet
    if not config.router:
        raise ConfigurationError("fleet.router: is empty; name the router to publish to")
    check("fleet", config, "router")
    signals.block()
    zenoh.init_log_from_env_or("error")
    send(
        *(_NODE, f"the uplink of vehicle {vehicle!r}", config.router, lambda: open_link(config, _TRY_S), BusError),
        lambda session: Uplink(vehicle, config, session, configuration.runtime_dir),
    )
