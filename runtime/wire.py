"""Encodes and decodes records as MessagePack.

Input is untrusted: sizes are limited before decoding; then types, ranges and finite numbers are checked. The only
exception is WireError. Only a SpeedReading may have non-finite numbers, which a failing sensor sends.
Versions: fields appended by a newer sender are ignored; a changed meaning is a new version in the topic's key.
"""

from __future__ import annotations

import math
import threading
from typing import Annotated, Any, TypeVar

import msgpack
import msgspec
import numpy as np

from birdslam.types import FrameRef, SpeedReading, Status

MAX_MESSAGE_BYTES = 64_000  # with the attachment below zenoh's filter (transport/session.py), which drops silently
MAX_TRACE_BYTES = 900
_MAX_TEXT_BYTES = 1_000
_MAX_ITEMS = 10_000

_MAY_BE_NAN: dict[type, frozenset[str]] = {  # record -> fields that may be non-finite
    SpeedReading: frozenset(SpeedReading.__struct_fields__),
    FrameRef: frozenset({"speeds"}),
}

_Record = TypeVar("_Record", bound=msgspec.Struct)
_Count = Annotated[int, msgspec.Meta(ge=0)]
_NodeName = Annotated[str, msgspec.Meta(max_length=32)]


class WireError(ValueError):
    """The bytes are no valid record, or the record can't be encoded; the message has the reason."""


class Stage(msgspec.Struct, frozen=True, array_like=True):
    """The processing of a message by one node, on CLOCK_MONOTONIC."""

    node: _NodeName
    received_ns: int  # start of the step
    done_ns: int  # end of the step
    sent_ns: int = 0  # stamped by Publisher.put
    arrived_ns: int = 0  # arrival in the node's queue; 0: unknown


class Trace(msgspec.Struct, frozen=True):
    """The stages of a message; sent as the attachment, so that the payload is deterministic."""

    stages: Annotated[tuple[Stage, ...], msgspec.Meta(max_length=8)] = ()  # in order
    left_ns: int | None = None  # rest of the end-to-end budget when the estimate was done; negative: it is late
    number: _Count = 0  # of this message, counted by its publisher from 1; a gap means lost messages

    def after(self, node: str, received_ns: int, done_ns: int, arrived_ns: int = 0) -> Trace:
        """Returns the trace with a stage of `node` added."""
        return Trace((*self.stages, Stage(node, received_ns, done_ns, arrived_ns=arrived_ns)))

    def sent(self, sent_ns: int, number: int) -> Trace:
        """Returns the trace with the time of sending in its last stage, and the message's number."""
        *earlier, last = self.stages
        return Trace((*earlier, msgspec.structs.replace(last, sent_ns=sent_ns)), self.left_ns, number)


class Part(msgspec.Struct, frozen=True, array_like=True):
    """The position of a message in a reply of several messages; sent as the attachment."""

    number: Annotated[int, msgspec.Meta(ge=0)] = 0  # from 0
    of: Annotated[int, msgspec.Meta(ge=1, le=256)] = 1  # total number of messages


class Spread(msgspec.Struct, frozen=True, array_like=True):
    """Percentiles of durations in the last seconds, in ms; zero without data."""

    p50_ms: float = 0.0
    p95_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


class Health(msgspec.Struct, frozen=True, kw_only=True):
    """A node -> supervisor and planners, about once a second: its statistics since its start."""

    node: _NodeName
    t_ns: int  # CLOCK_MONOTONIC
    frames: _Count = 0  # records finished
    dropped: _Count = 0  # records that were replaced or dropped before this node processed them
    malformed: _Count = 0  # invalid messages
    torn: _Count = 0  # frames whose pixels were overwritten before they were read
    rate_hz: float = 0.0  # of `frames`, since the last Health
    wait: Spread = Spread()  # from sending to the start of the step; capture: from its due time
    step: Spread = Spread()  # duration of the step
    age: Spread = Spread()  # from the frame's capture to the end of the step
    overruns: _Count = 0  # steps over this node's budget, including the wait in its queue
    late: _Count = 0  # records that arrived later than the budget of their hop
    rss_bytes: _Count = 0
    cpu_percent: float = 0.0  # of one core, since the last Health
    mode: str = "full"  # of perceive: full, rate, boxes, odometry or coasting
    restarts: _Count = 0  # of this node in this run
    cause: Annotated[str, msgspec.Meta(max_length=200)] = ""  # of the last restart
    status: tuple[Status, ...] = ()  # INPUT_STALE: no input for too long
    coasted: _Count = 0  # of optimize: frames estimated without measurements
    outrun: _Count = 0  # of optimize: measurements that arrived after a newer frame was predicted
    looks: _Count = 0  # of perceive: frames on which a network ran
    speeds: _Count = 0  # of capture: readings of the car's own speed received from the bus
    speeds_dropped: _Count = 0  # of capture: lost readings, in transit or over the limit of a frame


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not allowed in a message")


def _may_have_nonfinite(data: bytes) -> bool:
    """Whether MessagePack may have a non-finite number, by its byte patterns; a fast test before `_check_finite`."""
    byte = np.frombuffer(data, np.uint8)
    exponent = np.flatnonzero((byte[1:-1] & 0x7F) == 0x7F)  # all bits are set
    head, third = byte[exponent], byte[exponent + 2]
    found = ((head == 0xCB) & (third >= 0xF0)) | ((head == 0xCA) & (third >= 0x80))  # of 64 and of 32 bits
    return bool(found.any())


def _check_finite(plain: Any, record: type) -> None:
    """Raises ValueError for a NaN or an infinity outside _MAY_BE_NAN."""
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
    """Encodes the record as one MessagePack map, deterministically. Raises WireError if that fails."""
    try:
        data = msgspec.msgpack.encode(record, enc_hook=_plain)
        if _may_have_nonfinite(data):
            _check_finite(msgspec.to_builtins(record, enc_hook=_plain), type(record))
    except (ValueError, TypeError, OverflowError) as error:
        raise WireError(f"{type(record).__name__} can't be encoded: {error}") from error
    if len(data) > MAX_MESSAGE_BYTES:
        raise WireError(f"{type(record).__name__} of {len(data)} B is over the {MAX_MESSAGE_BYTES} B of a message")
    return data


_converted_types: set[type[msgspec.Struct]] = set()
_first_conversion = threading.Lock()


def _convert(plain: Any, record: type[_Record]) -> _Record:
    """Converts to a record. msgspec crashes if two threads convert to the same new type concurrently."""
    if record in _converted_types:
        return msgspec.convert(plain, record)
    with _first_conversion:
        try:
            return msgspec.convert(plain, record)
        finally:
            _converted_types.add(record)


def decode(data: bytes, record: type[_Record], max_bytes: int = MAX_MESSAGE_BYTES) -> _Record:
    """Decodes a record. Raises WireError, and nothing else, if `data` is not exactly one valid `record`."""
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
        if _may_have_nonfinite(data):
            _check_finite(plain, record)
        return _convert(plain, record)
    except (ValueError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"{record.__name__}: {str(error) or type(error).__name__}") from error
