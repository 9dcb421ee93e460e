"""Typed publisher and subscriber of one topic, with a bounded queue; created by bus.Bus."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
import zenoh

from birdslam.runtime.topology import Topic
from birdslam.runtime.transport.queries import RetainedMessages
from birdslam.runtime.wire import MAX_TRACE_BYTES, Stage, Trace, WireError, decode, encode

MAX_UNPACKED = 16  # messages queued as records; as bytes they need less memory

log = logging.getLogger(__name__)

_Attached = TypeVar("_Attached", bound=msgspec.Struct)


class BusError(RuntimeError):
    """A bus operation failed; the message has the reason."""


class BusClosed(BusError):
    """The bus, or this publisher or subscriber, was closed."""


class MessagesLost(BusError):
    """A queue of a lossless bus was full: the run is incomplete."""


@dataclass(frozen=True)
class Message:
    """A record of the topic's type, its trace, and its time of arrival (CLOCK_MONOTONIC)."""

    record: Any
    trace: Trace
    t_received_ns: int


@dataclass(frozen=True)
class _Packed:
    """A valid message deep in the queue, as encoded bytes."""

    payload: bytes
    trace: Trace
    t_received_ns: int


def message_of(sample: zenoh.Sample, key: str, record: type[msgspec.Struct]) -> Message:
    """Decodes a message received now. Raises WireError if it is invalid or was sent to more keys than this."""
    t_received_ns = time.monotonic_ns()
    if str(sample.key_expr) != key or sample.kind != zenoh.SampleKind.PUT:
        raise WireError(f"sent as {sample.kind} to {sample.key_expr}")
    trace = attached(sample, Trace)
    return Message(decode(bytes(sample.payload), record), trace or Trace(), t_received_ns)


def attached(sample: zenoh.Sample, kind: type[_Attached]) -> _Attached | None:
    attachment = sample.attachment
    return None if attachment is None else decode(bytes(attachment), kind, MAX_TRACE_BYTES)


class Publisher:
    """Sends the records of one topic; created by Bus.publisher.

    `express`: send each message at once; without it zenoh batches the messages that wait for the link.
    """

    def __init__(
        self, session: zenoh.Session, key: str, topic: Topic, node: str, lossless: bool, express: bool = True
    ) -> None:
        self._topic, self._node = topic, node
        self._session, self._key, self._express = session, key, express
        self._priority = zenoh.Priority.REAL_TIME if topic.urgent else zenoh.Priority.DATA_LOW
        self._changed = threading.Condition()
        self._closed = False
        self._sent = 0
        self._matched: bool | None = None  # a copy, so that zenoh is not called while the lock is held
        self._publisher = session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
            priority=self._priority,
            express=express,
        )
        self._retained = RetainedMessages(session, key, topic.retained) if topic.retained else None
        callback = zenoh.handlers.Callback(self._matching_changed, indirect=False)
        self._listener = self._publisher.declare_matching_listener(callback)
        at_first: zenoh.MatchingStatus = self._publisher.matching_status  # type: ignore[assignment]
        with self._changed:
            if self._matched is None:  # else the listener was called before
                self._matched = at_first.matching

    def _matching_changed(self, status: zenoh.MatchingStatus) -> None:
        with self._changed:
            self._matched = status.matching
            self._changed.notify_all()

    @property
    def matched(self) -> bool:
        """Whether the topic has a subscriber."""
        return bool(self._matched) and not self._closed

    def wait_matched(self, timeout_s: float) -> bool:
        """Waits for a subscriber; returns False if there is none in time. Raises BusClosed."""
        with self._changed:
            matched = self._changed.wait_for(lambda: self._closed or self.matched, timeout_s)
        if self._closed:
            raise BusClosed(f"{self._topic.name}: the bus is closed")
        return matched

    def put(self, record: msgspec.Struct, trace: Trace | None = None, must_arrive: bool = False) -> None:
        """Sends a record and stamps the time in the last stage of `trace` (None: a new trace).

        The lossy bus waits at most 1 ms for a full link, then drops the record; with `must_arrive` it waits until the
        link has room or is closed.
        Raises WireError for a record that is too large, BusClosed, and TypeError for a record of another type.
        """
        if type(record) is not self._topic.record:
            raise TypeError(f"{self._topic.name} takes {self._topic.record.__name__}, not {type(record).__name__}")
        data = encode(record)
        now_ns = time.monotonic_ns()
        self._sent += 1
        started = trace if trace and trace.stages else Trace((Stage(self._node, now_ns, now_ns),))
        attachment = encode(started.sent(now_ns, self._sent))
        if self._retained is not None:
            self._retained.add(data, attachment)
        try:
            if must_arrive:  # the same priority keeps the order of the records
                self._session.put(
                    self._key,
                    data,
                    attachment=attachment,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    priority=self._priority,
                    express=self._express,
                )
            else:
                self._publisher.put(data, attachment=attachment)
        except zenoh.ZError as error:
            if self._closed:
                raise BusClosed(f"{self._topic.name}: the bus is closed") from error
            raise BusError(f"{self._topic.name}: {error}") from error

    def _close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Subscriber:
    """A bounded queue of one topic's messages; created by Bus.subscriber.

    `newest`: the last received message, read or not. `dropped`: messages lost in transit (by their numbers) and dropped
    from the full queue. `malformed`: invalid messages, which on the lossy bus may count as dropped too. Messages after
    the first MAX_UNPACKED are queued as bytes, to limit memory.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, depth: int, lossless: bool) -> None:
        self._topic, self._key, self._lossless = topic, key, lossless
        self._queue: deque[Message | _Packed] = deque(maxlen=depth)
        self._arrived = threading.Condition()
        self._closed = False
        self.newest: Message | None = None
        self.dropped = 0
        self.malformed = 0
        # Called on zenoh's thread: less latency, and the messages of a sender keep their order over all topics.
        callback = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.declare_subscriber(key, callback)

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            message = message_of(sample, self._key, self._topic.record)
        except WireError as error:
            self.malformed += 1
            if self.malformed == 1:
                log.warning("%s: ignored a malformed message; later ones are only counted: %s", self._key, error)
            return
        with self._arrived:
            if _is_duplicate(self.newest, message):
                return
            self.dropped += _lost_between(self.newest, message)
            self.dropped += len(self._queue) == self._queue.maxlen
            self.newest = message
            if len(self._queue) < MAX_UNPACKED:
                self._queue.append(message)
            else:
                self._queue.append(_Packed(bytes(sample.payload), message.trace, message.t_received_ns))
            self._arrived.notify()

    def _receive_retained(self, reply: zenoh.Reply) -> None:
        """Receives a message from before this subscription, unless a newer one has arrived."""
        if reply.ok is not None and self.newest is None:
            self._receive(reply.ok)

    @property
    def unread(self) -> int:
        """The number of messages in the queue."""
        return len(self._queue)

    def recv(self, timeout_s: float | None = None) -> Message | None:
        """Waits for the next message; returns None if none arrives within `timeout_s` (None: no limit).

        Raises BusClosed after `close`, also from another thread; on a lossless bus MessagesLost if the queue was full.
        """
        with self._arrived:
            self._arrived.wait_for(lambda: self._closed or self._queue, timeout_s)
            if self._closed:
                raise BusClosed(f"{self._topic.name}: the bus is closed")
            if self._lossless and self.dropped:
                name, depth = self._topic.name, self._queue.maxlen
                raise MessagesLost(f"{name}: {self.dropped} messages lost behind {depth} unread ones, or on the way")
            first = self._queue.popleft() if self._queue else None
        if isinstance(first, _Packed):
            return Message(decode(first.payload, self._topic.record), first.trace, first.t_received_ns)
        return first

    def close(self) -> None:
        """Ends the subscription; a waiting recv raises BusClosed. A second call does nothing."""
        with self._arrived:
            if self._closed:
                return
            self._closed = True
            self._arrived.notify_all()
        self._subscriber.undeclare()


def _is_duplicate(earlier: Message | None, later: Message) -> bool:
    """Whether both are the same message: queried as the retained one, and sent meanwhile."""
    return earlier is not None and later.trace.number > 0 and later.trace == earlier.trace


def _lost_between(earlier: Message | None, later: Message) -> int:
    """Returns the number of messages lost between two of one publisher; 0 after its restart."""
    if earlier is None or not (earlier.trace.stages and later.trace.stages and earlier.trace.number):
        return 0
    if earlier.trace.stages[-1].node != later.trace.stages[-1].node:
        return 0
    return max(0, later.trace.number - earlier.trace.number - 1)
