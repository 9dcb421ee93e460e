"""What may be asked of the bus: zenoh queries, each answered with records of one type.

A publisher of a topic that keeps its last messages (`Topic.kept`) answers with them, from the bytes that it sent. What
costs more to answer (`Desk`) is made in a thread of its own, behind a short queue: who asks too much is not answered,
and nothing else notices.
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

Answer = Callable[[Mapping[str, str]], Sequence[msgspec.Struct]]

WAITING_QUESTIONS = 16
_REFUSAL_CHARACTERS = 300

log = logging.getLogger(__name__)


class Refusal(ValueError):
    """A question that can't be answered: the reason goes to whoever asked it."""


class KeptMessages:
    """The last messages of one publisher, for those that come late. Answers on zenoh's own thread: nothing is made."""

    def __init__(self, session: zenoh.Session, key: str, count: int) -> None:
        self._key = key
        self._messages: deque[tuple[bytes, bytes]] = deque(maxlen=count)
        self._queryable = session.declare_queryable(key, zenoh.handlers.Callback(self._answer, indirect=False))

    def add(self, data: bytes, attachment: bytes) -> None:
        """One more; the oldest goes."""
        self._messages.append((data, attachment))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if str(query.key_expr) != self._key:  # a wildcard: who asks for everything gets nothing
                return
            for data, attachment in tuple(self._messages):
                query.reply(self._key, data, attachment=attachment)


class Desk:
    """Answers questions of several keys, one after the other; `close` it before its session.

    `answers`: key -> what makes the answer's parts from the question's parameters; it may raise Refusal.
    """

    def __init__(self, session: zenoh.Session, answers: Mapping[str, Answer]) -> None:
        self._answers = answers
        self._waiting: deque[zenoh.Query] = deque(maxlen=WAITING_QUESTIONS)
        self._arrived = threading.Condition()
        self._closed = False
        callback = zenoh.handlers.Callback(self._ask, indirect=False)
        self._queryables = [session.declare_queryable(key, callback) for key in answers]
        self._thread = threading.Thread(target=self._run, name="desk", daemon=True)
        self._thread.start()

    def _ask(self, query: zenoh.Query) -> None:
        with self._arrived:
            if not self._closed:
                self._waiting.append(query)  # the oldest gives way: whoever asked it may ask again
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
        answer = self._answers.get(key)
        if answer is None:  # a wildcard
            return
        try:
            parts = answer(_parameters(query))
            for number, part in enumerate(parts):
                query.reply(key, encode(part), attachment=encode(Part(number, len(parts))))
        except (Refusal, WireError) as error:
            query.reply_err(str(error)[:_REFUSAL_CHARACTERS])
        except zenoh.ZError as error:  # whoever asked is gone
            log.info("%s: no answer: %s", key, error)

    def close(self) -> None:
        """Answers nothing more; a second call does nothing."""
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
    """One parameter of a question as a number; None where it was left out. Raises Refusal, which names it."""
    text = parameters.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise Refusal(f"{name}={text[:40]}: needs a positive number")
    return value
