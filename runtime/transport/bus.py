"""The bus: one node's zenoh session, with typed publishers, bounded subscribers and liveliness.

Local only: unix sockets in a directory of the vehicle (0700), no TCP, multicast or zenoh shared memory. The hub (the
supervisor) listens on `hub.sock`, each node on its own socket; they discover each other by gossip through the hub.
Other processes (planners) only connect. Never fork after opening a Bus (spawn instead), and always close it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import zenoh

from birdslam.runtime.slices import own_threads, wake_soon
from birdslam.runtime.topology import PROCESSES, TOPICS, alive_key, check_name, key_of
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.transport.endpoints import (
    BusClosed,
    BusError,
    Message,
    MessagesLost,
    Publisher,
    Subscriber,
    message_of,
)
from birdslam.runtime.transport.presence import runtime_dir_of, socket_path
from birdslam.runtime.transport.queries import QueryHandler, QueryResponder
from birdslam.runtime.transport.replies import REPLY_S, query_in_background, replies, whole_reply
from birdslam.runtime.transport.session import close_session, open_session, session_config
from birdslam.runtime.wire import WireError

LOSSLESS_DEPTH = 4_096

__all__ = ["Bus", "BusClosed", "BusError", "Message", "MessagesLost", "Publisher", "Subscriber"]


class Bus(Closing):
    """One node's session on its vehicle's bus. A context manager; must be closed.

        with Bus("car", "perceive") as bus:
            frames, out = bus.subscriber("frame"), bus.publisher("measurements")
            bus.declare_alive()
            message = frames.recv(timeout_s=0.5)                       # Message | None
            out.put(record, message.trace.after("perceive", message.t_received_ns, done_ns))

    `hub`: listen on the socket that all others connect to. `lossless`: send with back pressure and long queues, for
    runs at rate "max"; then all nodes and readers must be lossless. Raises ValueError for an invalid vehicle or node
    name, BusError if the sockets can't be created.
    """

    def __init__(
        self, vehicle: str, node: str, *, hub: bool = False, runtime_dir: Path | None = None, lossless: bool = False
    ) -> None:
        self.vehicle, self.node, self._lossless = check_name("vehicle", vehicle), check_name("node", node), lossless
        self._publishers: list[Publisher] = []
        self._subscribers: list[Subscriber] = []
        self._responders: list[QueryResponder] = []
        self._alive: set[str] = set()
        self._alive_changed = threading.Condition()
        self._alive_callbacks: list[Callable[[str, bool], None]] = []
        self._token: zenoh.LivelinessToken | None = None
        self._closed = False

        directory = runtime_dir_of(vehicle, runtime_dir)
        hub_socket, own_socket = socket_path(directory, "hub"), socket_path(directory, node)
        listen = [hub_socket] if hub else [own_socket] if node in PROCESSES else []
        before = own_threads()
        try:
            self._session = open_session(session_config(listen, [] if hub else [hub_socket], lossless or bool(listen)))
        except zenoh.ZError as error:
            where = ", ".join(map(str, listen)) or hub_socket
            raise BusError(f"{node} can't join the bus of vehicle {vehicle!r} ({where}): {error}") from error
        if node not in PROCESSES:  # wake planners and other readers without delay
            wake_soon(own_threads() - before)
        callback = zenoh.handlers.Callback(self._liveliness_changed, indirect=False)
        key = alive_key(vehicle, "*")
        self._liveliness = self._session.liveliness().declare_subscriber(key, callback, history=True)

    def publisher(self, topic: str) -> Publisher:
        """Returns a publisher of `topic`. Raises KeyError for an unknown topic."""
        self._check_open()
        key, spec = key_of(self.vehicle, topic), TOPICS[topic]
        self._publishers.append(Publisher(self._session, key, spec, self.node, self._lossless))
        return self._publishers[-1]

    def subscriber(self, topic: str, depth: int | None = None, may_drop: bool = False) -> Subscriber:
        """Returns a subscriber of `topic`; `depth` replaces the topology's. Raises KeyError for an unknown topic.

        With `may_drop` lost messages are counted on a lossless bus too, in place of MessagesLost.
        """
        self._check_open()
        key, spec = key_of(self.vehicle, topic), TOPICS[topic]
        depth = spec.depth if depth is None else depth
        depth = max(depth, LOSSLESS_DEPTH) if self._lossless else depth
        if depth < 1:
            raise ValueError(f"{topic}: a queue needs a depth of at least 1, got {depth}")
        self._subscribers.append(Subscriber(self._session, key, spec, depth, self._lossless and not may_drop))
        return self._subscribers[-1]

    def catch_up(self, topic: str, subscriber: Subscriber) -> None:
        """Queries the topic's last message for a late subscriber, in the background."""
        query_in_background(self._session, key_of(self.vehicle, topic), subscriber._receive_retained)

    def retained(self, topic: str, timeout_s: float = REPLY_S) -> list[Message]:
        """Returns the topic's retained messages (Topic.retained), oldest first; empty without a reply in time.

        Raises BusError for a malformed message.
        """
        key, record = key_of(self.vehicle, topic), TOPICS[topic].record
        try:
            self._check_open()
            return [message_of(sample, key, record) for sample in replies(self._session, key, timeout_s)]
        except WireError as error:
            raise BusError(f"{topic}: a retained message is malformed: {error}") from error

    def query(self, name: str, timeout_s: float = REPLY_S, **parameters: float) -> list[Any]:
        """Returns the parts of the reply to one of topology.QUERIES, in order; empty without a reply in time.

        Raises BusError with the reason if the query is refused, or the reply is incomplete or malformed.
        """
        self._check_open()
        return whole_reply(self._session, self.vehicle, name, timeout_s, parameters)

    def answer_queries(self, handlers: Mapping[str, QueryHandler]) -> None:
        """Answers the queries of these names (topology.QUERIES) until the bus is closed."""
        self._check_open()
        by_key = {key_of(self.vehicle, name): handler for name, handler in handlers.items()}
        self._responders.append(QueryResponder(self._session, by_key))

    def declare_alive(self) -> None:
        """Declares this node alive until it is closed or its process dies."""
        self._check_open()
        if self._token is None:
            self._token = self._session.liveliness().declare_token(alive_key(self.vehicle, self.node))

    @property
    def alive(self) -> frozenset[str]:
        """The nodes that this session sees alive."""
        with self._alive_changed:
            return frozenset(self._alive)

    def wait_alive(self, nodes: Iterable[str], timeout_s: float) -> set[str]:
        """Waits until all of `nodes` are alive at once; returns the missing ones. Raises BusClosed."""
        wanted = set(nodes)
        with self._alive_changed:
            self._alive_changed.wait_for(lambda: self._closed or wanted <= self._alive, timeout_s)
            self._check_open()
            return wanted - self._alive

    def on_alive(self, callback: Callable[[str, bool], None]) -> None:
        """Calls `callback(node, True)` for each alive node, and `callback(node, alive)` at each later change.

        Later calls are on zenoh's thread and must return quickly.
        """
        with self._alive_changed:
            self._alive_callbacks.append(callback)
            known = sorted(self._alive)
        for node in known:
            callback(node, True)

    def _liveliness_changed(self, sample: zenoh.Sample) -> None:
        node, alive = str(sample.key_expr).rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT
        with self._alive_changed:
            (self._alive.add if alive else self._alive.discard)(node)
            self._alive_changed.notify_all()
            callbacks = tuple(self._alive_callbacks)
        for callback in callbacks:
            callback(node, alive)

    def _check_open(self) -> None:
        if self._closed:
            raise BusClosed(f"the bus of vehicle {self.vehicle!r} is closed")

    def close(self) -> None:
        """Closes the session; waiting calls raise BusClosed. A second call does nothing."""
        with self._alive_changed:
            if self._closed:
                return
            self._closed = True
            self._alive_changed.notify_all()
        for publisher in self._publishers:
            publisher._close()
        for subscriber in self._subscribers:
            subscriber.close()
        for responder in self._responders:
            responder.close()
        close_session(self._session)
