"""Publisher and subscriber of one topic: typed, with a bounded queue of messages; made by bus.Bus."""

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

UNPACKED = 16  # messages that wait as records; an estimate is 29 kB of memory so, and 2 to 12 as bytes

log = logging.getLogger(__name__)

_Attached = TypeVar("_Attached", bound=msgspec.Struct)


class BusError(RuntimeError):
    """The bus can't do what was asked; says why."""


class BusClosed(BusError):
    """The bus, or this publisher or subscriber, was closed."""


class MessagesLost(BusError):
    """A queue of a lossless bus was full: the run is no longer what it promised to be."""


@dataclass(frozen=True)
class Message:
    """A record of the topic's type, where its time went, and when it came in (CLOCK_MONOTONIC)."""

    record: Any
    trace: Trace
    t_received_ns: int


@dataclass(frozen=True)
class _Packed:
    """A message that waits behind many others: valid, and as it was sent."""

    payload: bytes
    trace: Trace
    t_received_ns: int


def message_of(sample: zenoh.Sample, key: str, record: type[msgspec.Struct]) -> Message:
    """What came in now, decoded. Raises WireError where it is no such record, or was sent to more keys than this."""
    t_received_ns = time.monotonic_ns()
    if str(sample.key_expr) != key or sample.kind != zenoh.SampleKind.PUT:
        raise WireError(f"sent as {sample.kind} to {sample.key_expr}")
    trace = attached(sample, Trace)
    return Message(decode(bytes(sample.payload), record), trace or Trace(), t_received_ns)


def attached(sample: zenoh.Sample, kind: type[_Attached]) -> _Attached | None:
    attachment = sample.attachment
    return None if attachment is None else decode(bytes(attachment), kind, MAX_TRACE_BYTES)


class Publisher:
    """Sends the records of one topic; made by Bus.publisher.

    `express`: each message at once and by itself; without it zenoh joins those that wait for the link.
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
        self._matched: bool | None = None  # a copy: zenoh is never called while the lock is held
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
            if self._matched is None:  # else a change has come already
                self._matched = at_first.matching

    def _matching_changed(self, status: zenoh.MatchingStatus) -> None:
        with self._changed:
            self._matched = status.matching
            self._changed.notify_all()

    @property
    def matched(self) -> bool:
        """Whether somebody subscribes to this topic now."""
        return bool(self._matched) and not self._closed

    def wait_matched(self, timeout_s: float) -> bool:
        """Waits for a first subscriber; False where none came in time. Raises BusClosed."""
        with self._changed:
            matched = self._changed.wait_for(lambda: self._closed or self.matched, timeout_s)
        if self._closed:
            raise BusClosed(f"{self._topic.name}: the bus is closed")
        return matched

    def put(self, record: msgspec.Struct, trace: Trace | None = None, must_arrive: bool = False) -> None:
        """Sends a record, and stamps its sending into the last stage of `trace` (None: it begins here and now).

        A reader that is too slow costs messages, not time: the lossy bus waits 1 ms at the most for a full link, and
        drops the record. One that `must_arrive` waits until the link has room, or is given up.
        Raises WireError (a record that is too large), BusClosed, and TypeError for a record of another type.
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
            if must_arrive:  # of the same priority: it stays behind the records before it
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
    """A bounded queue of one topic's messages; made by Bus.subscriber.

    `newest` is the last message that came in, whether it was read or not. `dropped` counts the messages that were lost
    on the way here (its sender numbers them) and those that a newer one pushed out of the full queue, `malformed` those
    that were no valid record, or were sent to more keys than this: on the lossy bus they may count as lost too. Behind
    UNPACKED messages others wait as bytes, so that a reader that was held up has not grown by it.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, depth: int, lossless: bool) -> None:
        self._topic, self._key, self._lossless = topic, key, lossless
        self._queue: deque[Message | _Packed] = deque(maxlen=depth)
        self._arrived = threading.Condition()
        self._closed = False
        self.newest: Message | None = None
        self.dropped = 0
        self.malformed = 0
        # Called on zenoh's own thread: one hop fewer, and the messages of a sender keep their order over all topics.
        callback = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.declare_subscriber(key, callback)

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            message = message_of(sample, self._key, self._topic.record)
        except WireError as error:
            self.malformed += 1
            if self.malformed == 1:
                log.warning("%s: a malformed message is ignored, and all that follow: %s", self._key, error)
            return
        with self._arrived:
            if _is_again(self.newest, message):
                return
            self.dropped += _lost_between(self.newest, message)
            self.dropped += len(self._queue) == self._queue.maxlen
            self.newest = message
            if len(self._queue) < UNPACKED:
                self._queue.append(message)
            else:
                self._queue.append(_Packed(bytes(sample.payload), message.trace, message.t_received_ns))
            self._arrived.notify()

    def _receive_retained(self, reply: zenoh.Reply) -> None:
        """A message of before this subscription; it counts only where none came since."""
        if reply.ok is not None and self.newest is None:
            self._receive(reply.ok)

    def recv(self, timeout_s: float | None = None) -> Message | None:
        """The next message, as soon as there is one; None where none came within `timeout_s` (None: no limit).

        Raises BusClosed once closed, from another thread too; on a lossless bus MessagesLost where the queue was full.
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


def _is_again(earlier: Message | None, later: Message) -> bool:
    """Whether it is the same message: asked for as the topic's last one, and sent meanwhile."""
    return earlier is not None and later.trace.number > 0 and later.trace == earlier.trace


def _lost_between(earlier: Message | None, later: Message) -> int:
    """How many of their publisher's messages lie between two; none where it was restarted, or is another one."""
    if earlier is None or not (earlier.trace.stages and later.trace.stages and earlier.trace.number):
        return 0
    if earlier.trace.stages[-1].node != later.trace.stages[-1].node:
        return 0
    return max(0, later.trace.number - earlier.trace.number - 1)
