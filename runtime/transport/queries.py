"""Queries of the bus over zenoh, each answered with records of one type.

A publisher of a topic with retained messages (`Topic.retained`) replies with the bytes that it sent. `QueryResponder`
answers other queries in a thread with a short queue, so that a flood of queries delays nothing else.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

import msgspec
import zenoh

from birdslam.runtime.wire import Part, WireError, encode

QueryHandler = Callable[[Mapping[str, str]], Sequence[msgspec.Struct]]

WAITING_QUERIES = 16
_REASON_CHARACTERS = 300

log = logging.getLogger(__name__)


class QueryRefused(ValueError):
    """A query that can't be answered; its sender receives the reason."""


class RetainedMessages:
    """The last messages of one publisher, for late subscribers. Replies on zenoh's thread."""

    def __init__(self, session: zenoh.Session, key: str, count: int) -> None:
        self._key = key
        self._messages: deque[tuple[bytes, bytes]] = deque(maxlen=count)
        self._queryable = session.declare_queryable(key, zenoh.handlers.Callback(self._answer, indirect=False))

    def add(self, data: bytes, attachment: bytes) -> None:
        """Adds a message; removes the oldest if full."""
        self._messages.append((data, attachment))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if str(query.key_expr) != self._key:  # wildcards get no reply
                return
            for data, attachment in tuple(self._messages):
                query.reply(self._key, data, attachment=attachment)


class QueryResponder:
    """Answers queries of several keys in sequence; close it before its session.

    `handlers`: key -> function from the query's parameters to the parts of the reply; may raise QueryRefused.
    """

    def __init__(self, session: zenoh.Session, handlers: Mapping[str, QueryHandler]) -> None:
        self._handlers = handlers
        self._waiting: deque[zenoh.Query] = deque(maxlen=WAITING_QUERIES)
        self._arrived = threading.Condition()
        self._closed = False
        callback = zenoh.handlers.Callback(self._enqueue, indirect=False)
        self._queryables = [session.declare_queryable(key, callback) for key in handlers]
        self._thread = threading.Thread(target=self._run, name="queries", daemon=True)
        self._thread.start()

    def _enqueue(self, query: zenoh.Query) -> None:
        with self._arrived:
            if not self._closed:
                self._waiting.append(query)  # drops the oldest query if full
                self._arrived.notify()

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                query = self._waiting.popleft()
            with query:
                self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        handler = self._handlers.get(key)
        if handler is None:  # a wildcard
            return
        try:
            parts = handler(_parameters(query))
            for number, part in enumerate(parts):
                query.reply(key, encode(part), attachment=encode(Part(number, len(parts))))
        except (QueryRefused, WireError) as error:
            query.reply_err(str(error)[:_REASON_CHARACTERS])
        except zenoh.ZError as error:  # its sender has disconnected
            log.info("%s: no reply: %s", key, error)

    def close(self) -> None:
        """Stops answering; a second call does nothing."""
        with self._arrived:
            if self._closed:
                return
            self._closed = True
            self._waiting.clear()
            self._arrived.notify_all()
        for queryable in self._queryables:
            queryable.undeclare()
        self._thread.join()


def _parameters(query: zenoh.Query) -> dict[str, str]:
    names: Iterable[tuple[str, str]] = query.parameters  # type: ignore[assignment]
    return dict(names)


def positive(parameters: Mapping[str, str], name: str) -> float | None:
    """Returns a query parameter as a positive number; None if absent. Raises QueryRefused with its name."""
    text = parameters.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise QueryRefused(f"{name}={text[:40]}: needs a positive number")
    return value
