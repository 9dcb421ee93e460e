"""Records to bytes and back: plain MessagePack, so that a planner in any language can read it.

What comes in is never trusted: sizes are limited before anything is built, then types, ranges and finite numbers are
checked. Whatever is wrong with the bytes, the only exception is WireError. Of a SpeedReading alone numbers may be other
than finite: a failing sensor sends such numbers, and the reader answers with a status.
Versions: fields that a newer sender appended are ignored; a changed meaning is a new version in the topic's key.
"""

from __future__ import annotations

import math
import threading
from typing import Annotated, Any, TypeVar

import msgpack
import msgspec
import numpy as np

from birdslam.types import FrameRef, SpeedReading, Status

# A message is a few kB. With its attachment it must pass zenoh's filter (bus.py, 65,000 B), which drops silently.
MAX_MESSAGE_BYTES = 64_000
MAX_TRACE_BYTES = 900
_MAX_TEXT_BYTES = 1_000
_MAX_ITEMS = 10_000

_MAY_BE_NAN: dict[type, frozenset[str]] = {  # record -> its fields of any numbers
    SpeedReading: frozenset(SpeedReading.__struct_fields__),
    FrameRef: frozenset({"speeds"}),
}

_Record = TypeVar("_Record", bound=msgspec.Struct)
_Count = Annotated[int, msgspec.Meta(ge=0)]
_NodeName = Annotated[str, msgspec.Meta(max_length=32)]


class WireError(ValueError):
    """Bytes that are no valid record, or a record that can't become a message; says why."""


class Stage(msgspec.Struct, frozen=True, array_like=True):
    """What one node did with a message, on CLOCK_MONOTONIC: received it, finished its step, sent the result."""

    node: _NodeName
    received_ns: int  # taken up
    done_ns: int
    sent_ns: int = 0  # stamped by Publisher.put
    arrived_ns: int = 0  # in the node's process: until it was taken up it waited in the queue; 0: nobody said


class Trace(msgspec.Struct, frozen=True):
    """Where a message's time went; travels as the attachment, so that the payload's bytes stay deterministic."""

    stages: Annotated[tuple[Stage, ...], msgspec.Meta(max_length=8)] = ()  # in the order of the way
    left_ns: int | None = None  # of the budget end to end when an estimate was done; negative: it is late
    number: _Count = 0  # of this message among its publisher's, from 1 on: a gap means that some were lost

    def after(self, node: str, received_ns: int, done_ns: int, arrived_ns: int = 0) -> Trace:
        """The trace of what `node` made of this message: one stage more."""
        return Trace((*self.stages, Stage(node, received_ns, done_ns, arrived_ns=arrived_ns)))

    def sent(self, sent_ns: int, number: int) -> Trace:
        """The trace with the sending of its last stage stamped, as its publisher's message of this number."""
        *earlier, last = self.stages
        return Trace((*earlier, msgspec.structs.replace(last, sent_ns=sent_ns)), self.left_ns, number)


class Part(msgspec.Struct, frozen=True, array_like=True):
    """Which of the answer's messages this is: one is too small for a long drive. Travels as their attachment."""

    number: Annotated[int, msgspec.Meta(ge=0)] = 0  # from 0 on
    of: Annotated[int, msgspec.Meta(ge=1, le=256)] = 1  # so many in all


class Spread(msgspec.Struct, frozen=True, array_like=True):
    """Of durations in the last seconds, in ms; all zero where there were none."""

    p50_ms: float = 0.0
    p95_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


class Health(msgspec.Struct, frozen=True, kw_only=True):
    """A node -> supervisor and planners, about once a second: what it has done since it started."""

    node: _NodeName
    t_ns: int  # CLOCK_MONOTONIC
    frames: _Count = 0  # records finished
    dropped: _Count = 0  # records that were replaced or dropped before this node took them up
    malformed: _Count = 0  # messages that were no records
    torn: _Count = 0  # frames whose pixels were overwritten before they were read
    rate_hz: float = 0.0  # of `frames`, since the last Health
    wait: Spread = Spread()  # from sent to taken up; capture: from its due time
    step: Spread = Spread()  # from taken up to done
    age: Spread = Spread()  # from the frame's capture to done
    overruns: _Count = 0  # steps over this node's budget, with the record's wait in the queue
    late: _Count = 0  # records that took longer than the budget of their hop to arrive here
    rss_bytes: _Count = 0
    cpu_percent: float = 0.0  # of one core, since the last Health
    mode: str = "full"  # of perceive: full, rate, boxes, odometry or coasting
    restarts: _Count = 0  # of this node in this run
    cause: Annotated[str, msgspec.Meta(max_length=200)] = ""  # of the last restart
    status: tuple[Status, ...] = ()  # INPUT_STALE: this node has received nothing for too long
    coasted: _Count = 0  # of optimize: frames that it had to estimate without measurements
    outrun: _Count = 0  # of optimize: measurements that came when a newer frame had been coasted over
    looks: _Count = 0  # of perceive: frames on which a network was begun
    speeds: _Count = 0  # of capture: readings of the car's own speed that have come on the bus
    speeds_dropped: _Count = 0  # of capture: of them, those beyond what a frame bears, and those lost on their way


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no place in a message")


def _may_hold_others(data: bytes) -> bool:
    """Whether MessagePack may hold a number that is not finite: where none of its bytes look like one, none does.

    Quicker than to walk all numbers by a factor of ten or more, and nearly always enough.
    """
    byte = np.frombuffer(data, np.uint8)
    exponent = np.flatnonzero((byte[1:-1] & 0x7F) == 0x7F)  # all its bits are set, whatever the sign
    head, third = byte[exponent], byte[exponent + 2]
    found = ((head == 0xCB) & (third >= 0xF0)) | ((head == 0xCA) & (third >= 0x80))  # of 64 and of 32 bits
    return bool(found.any())


def _check_finite(plain: Any, record: type) -> None:
    """Whatever a record itself checks, no NaN and no infinity passes the wire, in either direction."""
    waiting = [plain]
    if record in _MAY_BE_NAN and isinstance(plain, dict):
        waiting = [value for field, value in plain.items() if field not in _MAY_BE_NAN[record]]
    while waiting:
        item = waiting.pop()
        if isinstance(item, float):
            if not math.isfinite(item):
                raise ValueError(f"numbers must be finite, got {item}")
        elif isinstance(item, (list, tuple)):
            waiting.extend(item)
        elif isinstance(item, dict):
            waiting.extend(item.values())


def encode(record: msgspec.Struct) -> bytes:
    """The record as one MessagePack map; the same record gives the same bytes. Raises WireError where it can't."""
    try:
        data = msgspec.msgpack.encode(record, enc_hook=_plain)
        if _may_hold_others(data):
            _check_finite(msgspec.to_builtins(record, enc_hook=_plain), type(record))
    except (ValueError, TypeError, OverflowError) as error:
        raise WireError(f"{type(record).__name__} can't be encoded: {error}") from error
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"{type(record).__name__} of {len(data)} B is over the {MAX_MESSAGE_BYTES} B of a message")
    return data


_LEARNED: set[type[msgspec.Struct]] = set()  # by msgspec, which looks at a type's fields when it is first asked for it
_LEARNING = threading.Lock()


def _converted(plain: Any, record: type[_Record]) -> _Record:
    """`plain` as a record. msgspec crashes where two threads ask it for the same new type at once."""
    if record in _LEARNED:
        return msgspec.convert(plain, record)
    with _LEARNING:
        try:
            return msgspec.convert(plain, record)
        finally:
            _LEARNED.add(record)


def decode(data: bytes, record: type[_Record], max_bytes: int = MAX_MESSAGE_BYTES) -> _Record:
    """The record in `data`. Raises WireError, and nothing else, where `data` is not exactly one valid `record`."""
    if len(data) > max_bytes:
        raise WireError(f"{record.__name__}: {len(data)} B are over the limit of {max_bytes} B")
    try:
        plain = msgpack.unpackb(
            data,
            max_str_len=_MAX_TEXT_BYTES,
            max_bin_len=0,
            max_ext_len=0,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
        )
        if _may_hold_others(data):
            _check_finite(plain, record)
        return _converted(plain, record)
    except (ValueError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"{record.__name__}: {str(error) or type(error).__name__}") from error
