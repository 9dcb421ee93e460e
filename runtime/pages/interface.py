"""The reference of docs/planner.md, from the topology and the records: `birdslam interface` prints it."""

from __future__ import annotations

import inspect
import re
import types
import typing
from collections.abc import Iterable, Iterator
from enum import IntEnum, StrEnum
from typing import Any

import msgspec

import birdslam.types
from birdslam.geometry.se2 import SE2
from birdslam.runtime.configuration import BudgetsConfig
from birdslam.runtime.pages.tables import comments, table, unit
from birdslam.runtime.topology import NODES, QUERIES, TOPICS, VERSION, Topic, alive_key, key_of
from birdslam.runtime.wire import MAX_MESSAGE_BYTES, Part, Trace
from birdslam.sources.speed_log import MAX_READINGS
from birdslam.types import INVALIDATING, Estimate, SpeedReading, Status

_VEHICLE = "VEHICLE"
_TRANSFORM = re.compile(r"T_([a-z]+)_([a-z]+)")
_PAGE = """\
## Messages

Every message is one MessagePack map of at most {bytes:,} B (an array where a record is marked as one), under a zenoh
key `birdslam/{vehicle}/{version}/...`. Numbers are finite, except in {reading}.
Ignore fields that you do not know: fields may be appended, and a changed meaning gets a new version in the key.

## Keys

{keys}

All are sent with congestion control DROP, express; *urgent* keys with priority REAL_TIME, others with DATA_LOW. Read a
*hot* key with a queue of one (`RingChannel(1)`), since only its newest message matters. The number in brackets is the
length of the queue of our own readers. A slow reader loses messages and never delays the vehicle.

## Queries

{queries}

Query the exact key (`{example}`): wildcards get no reply.
Use consolidation NONE: a long reply consists of several messages of the same record, each with a {part} attached;
concatenate their lists. The payload of an error is its reason as text. Querying the key of `estimate` or `health/*`
returns its last message.

## Limits

An estimate arrives within {budget_ms:g} ms of its frame's capture at the {percentile:g}th percentile, unless
`budgets` of the configuration say otherwise. A frame holds the {kept} newest readings of the vehicle speed at most.

## Statuses

{statuses}

## Attachments

Every message of a topic has a {trace} attached, with a stage for each node that handled the frame. `done_ns -
received_ns` is the node's step; from `sent_ns` to the next stage's `arrived_ns` is the hop, and from there to its
`received_ns` the wait in the node's queue. The stage of perceive is missing for a coasted frame.

## Records

{conventions}

On the wire a pose `T_a_b`, that of b in a, is `[x_m, y_m, yaw_rad]`.

{records}
"""


def page() -> str:
    """Returns the generated sections of docs/planner.md in Markdown."""
    budgets = BudgetsConfig()
    return _PAGE.format(
        bytes=MAX_MESSAGE_BYTES,
        reading=_link(SpeedReading),
        kept=MAX_READINGS,
        vehicle=_VEHICLE,
        version=VERSION,
        keys=table(_keys()),
        queries=table(_queries()),
        example=f"{key_of(_VEHICLE, 'trajectory')}?last_s=30",
        part=_link(Part),
        budget_ms=budgets.end_to_end_ms,
        percentile=budgets.percentile,
        statuses=table(_statuses()),
        trace=_link(Trace),
        conventions=inspect.cleandoc(birdslam.types.__doc__ or ""),
        records="\n\n".join(_records()),
    )


def _keys() -> Iterator[tuple[str, ...]]:
    yield "key", "record", "sent by", "when", "kind", "answers a query with"
    for topic in TOPICS.values():
        kept = {0: "", 1: "the last one"}.get(topic.retained, f"the last {topic.retained}")
        kept = "see Queries" if topic.name in QUERIES else kept
        yield f"`{topic.name}`", _link(topic.record), topic.producer, topic.pace, _kind(topic), kept
    for node in NODES:
        alive = alive_key(_VEHICLE, node).partition(f"{VERSION}/")[2]
        yield f"`{alive}`", "liveliness token", node, "while it is ready for work", "", ""


def _kind(topic: Topic) -> str:
    return f"{'hot ' if topic.hot else ''}{'urgent ' if topic.urgent else ''}({topic.depth})"


def _queries() -> Iterator[tuple[str, ...]]:
    yield "query (zenoh get)", "reply", "what", "parameters"
    for query in QUERIES.values():
        record = "a plain map" if query.record is dict else _link(query.record)
        asked = "; ".join(f"`{name}`: {meaning}" for name, meaning in query.parameters.items())
        yield f"`{query.name}`", record, query.meaning, asked


def _statuses() -> Iterator[tuple[str, ...]]:
    meanings = comments(Status)
    yield "status", "meaning", "makes an estimate invalid"
    for status in Status:
        yield f"`{status.value}`", meanings[status.name], "**yes**" if status in INVALIDATING else ""


def _records() -> Iterator[str]:
    asked = [query.record for query in QUERIES.values() if query.record is not dict]
    for record in _with_parts((*(topic.record for topic in TOPICS.values()), *asked, Trace, Part)):
        yield f"### {record.__name__}"
        shape = " An array on the wire, in this order." if record.__struct_config__.array_like else ""
        yield inspect.cleandoc(record.__doc__ or "") + shape
        yield table([("field", "type", "unit", "default", "meaning"), *_fields(record)])


def _with_parts(records: Iterable[type[msgspec.Struct]]) -> list[type[msgspec.Struct]]:
    """Returns each record once, followed by the records of its fields."""
    found: dict[type[msgspec.Struct], None] = {}

    def add(kind: Any) -> None:
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            if kind in found or kind is SE2:
                return
            found[kind] = None
            for field in msgspec.structs.fields(kind):
                add(field.type)
        for inner in typing.get_args(kind):
            add(inner)

    for record in records:
        add(record)
    return list(found)


def _fields(record: type[msgspec.Struct]) -> Iterator[tuple[str, ...]]:
    own, common = comments(record), comments(Estimate)
    everywhere = {f.name: common.get(f.name, "") for f in msgspec.structs.fields(Estimate)}
    kinds = {f.name: f.type for f in msgspec.structs.fields(Estimate)}
    for field in msgspec.structs.fields(record):
        transform = _TRANSFORM.fullmatch(field.name)
        pose = f"the pose of {transform[2]} in {transform[1]}" if transform else ""
        comment = own.get(field.name) or (everywhere[field.name] if kinds.get(field.name) == field.type else "")
        meaning = f"{pose}: {comment}" if pose and comment else pose or comment
        default = "" if field.required else f"`{_plain(field)}`"
        yield f"`{field.name}`", _type(field.type), unit(field.name), default, meaning


def _plain(field: Any) -> str:
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    return msgspec.json.encode(value).decode()


def _type(kind: Any) -> str:
    """Returns the name of a type, independent of the language of the reader."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        limits = next((a for a in inner[1:] if isinstance(a, msgspec.Meta)), msgspec.Meta())
        if limits.min_length is not None and limits.min_length == limits.max_length:
            return f"{limits.min_length} numbers"
        return _type(inner[0])
    if origin in (typing.Union, types.UnionType):
        return f"{_type(next(k for k in inner if k is not type(None)))} or nil"
    if origin is tuple:
        return f"list of {_type(inner[0])}" if inner[-1] is Ellipsis else f"[{', '.join(map(_type, inner))}]"
    if origin is dict:
        return f"map of {_type(inner[0])} to {_type(inner[1])}"
    if kind is SE2:
        return "pose"
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return _link(kind)
    if kind is Status:
        return "[status](#statuses)"
    if isinstance(kind, type) and issubclass(kind, IntEnum):
        return "integer"
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return " or ".join(f"`{item}`" for item in kind)
    return {int: "integer", float: "number", bool: "boolean", str: "text"}[kind]


def _link(record: type) -> str:
    return f"[{record.__name__}](#{record.__name__.lower()})"
