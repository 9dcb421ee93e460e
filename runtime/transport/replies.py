"""The client side of queries: collects replies, complete or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import zenoh

from birdslam.runtime.topology import QUERIES, key_of
from birdslam.runtime.transport.endpoints import BusError, attached
from birdslam.runtime.wire import Part, WireError, decode

REPLY_S, _MAX_REPLIES = 2.0, 256  # timeout of a query, and messages of its reply


def replies(session: zenoh.Session, selector: str | zenoh.Selector, timeout_s: float) -> Iterator[zenoh.Sample]:
    """Yields the messages of a reply as they arrive. Raises BusError with the reason if the query is refused."""
    found = session.get(
        selector,
        zenoh.handlers.FifoChannel(_MAX_REPLIES),
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,  # all of them, not the last one alone
    )
    for reply in found:
        if reply.ok is not None:
            yield reply.ok
        elif reply.err is not None:
            raise BusError(f"{selector}: {bytes(reply.err.payload).decode(errors='replace')}")


def query_in_background(session: zenoh.Session, key: str, callback: Callable[[zenoh.Reply], None]) -> None:
    """Sends a query and passes its replies to `callback` on zenoh's thread, without waiting.

    Does nothing if the session is being closed.
    """
    try:
        session.get(key, zenoh.handlers.Callback(callback, indirect=False), timeout=REPLY_S)
    except zenoh.ZError:
        if not session.is_closed():
            raise


def whole_reply(
    session: zenoh.Session, vehicle: str, name: str, timeout_s: float, parameters: Mapping[str, float]
) -> list[Any]:
    """Returns the parts of a vehicle's reply to one of topology.QUERIES, in order; empty without a reply in time.

    Raises BusError with the reason if the query is refused, or the reply is incomplete or malformed.
    """
    spec, key = QUERIES[name], key_of(vehicle, name)
    given = {parameter: f"{value:g}" for parameter, value in parameters.items()}
    parts: dict[int, Any] = {}
    of = 0
    try:
        for sample in replies(session, zenoh.Selector(key, given), timeout_s):
            part = attached(sample, Part) or Part()
            parts[part.number], of = decode(bytes(sample.payload), spec.record), part.of
    except WireError as error:
        raise BusError(f"{name}: the reply is malformed: {error}") from error
    if sorted(parts) != list(range(of)):
        raise BusError(f"{name}: received {len(parts)} of the reply's {of} parts")
    return [parts[number] for number in range(of)]
