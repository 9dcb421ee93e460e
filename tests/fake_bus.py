"""A bus without processes: what a node receives is filled in by the test."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import msgspec

from birdslam.runtime.transport.bus import Message
from birdslam.runtime.wire import Trace


class Inbox:
    """A subscriber that a test fills; one with a depth drops the oldest messages."""

    malformed = 0

    def __init__(self, records: Iterable[msgspec.Struct] = (), depth: int | None = None) -> None:
        self.dropped = 0
        self._depth = depth
        self._messages: deque[Message] = deque()
        for record in records:
            self.come(record)

    def __len__(self) -> int:
        return len(self._messages)

    def come(self, record: msgspec.Struct, t_received_ns: int = 0) -> None:
        if len(self._messages) == self._depth:
            self._messages.popleft()
            self.dropped += 1
        self._messages.append(Message(record, Trace(), t_received_ns))

    def recv(self, timeout_s: float | None = None) -> Message | None:
        return self._messages.popleft() if self._messages else None


class FakeBus:
    """Has an inbox for each topic that a node subscribes to, and drops what is sent."""

    def __init__(self, **inboxes: Inbox) -> None:
        self.inboxes = inboxes

    def subscriber(self, topic: str, depth: int | None = None, may_drop: bool = False) -> Inbox:
        return self.inboxes.setdefault(topic, Inbox(depth=depth))

    def publisher(self, topic: str) -> FakeBus:
        return self

    def put(self, record: msgspec.Struct) -> None: ...

    def on_alive(self, callback: object) -> None: ...
