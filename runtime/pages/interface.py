"""The interface page (docs/interface.md), made from the topology and the records: `birdslam interface` prints it."""

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
from birdslam.sources.speed_log import KEPT_READINGS
from birdslam.types import INVALIDATING, Estimate, SpeedReading, Status

_VEHICLE = "VEHICLE"
_TRANSFORM = re.compile(r"T_([a-z]+)_([a-z]+)")
_PAGE = """\
# What a vehicle says, and how to listen

Made by `birdslam interface > docs/interface.md` from the records and the topology; a test holds it to them.
[examples/planner.py](examples/planner.py) listens with BirdSLAM's own client, [examples/plain.py](examples/plain.py)
with nothing but zenoh and MessagePack.

Every message is one MessagePack map (or, where a record says so, an array) of at most {bytes:,} B under a zenoh key
`birdslam/{vehicle}/{version}/...`. A number is always finite, but in {reading}. Fields may be appended: ignore what you
do not know. A changed meaning is another version in the key.

On the vehicle's computer, as its own user: connect to `unixsock-stream/DIR/{vehicle}/hub.sock` with multicast
scouting off, where DIR is `runtime.runtime_dir` (of the service: `/run/birdslam`). From elsewhere, or as another
user: through the gate, by mutual TLS ([deploy/README.md](../deploy/README.md)). Planners may read `estimate`, `map`,
`map_pose`, `health/*` and `alive/*`, and send every query; `frame` and `measurements` are for the nodes alone. `speed`
is the one topic that comes from outside: the car's own computer sends it, and nobody else may ([The car's own
speed](#the-cars-own-speed)). At the router of a fleet ([fleet.md](fleet.md)) `estimate`, `health/*` and `alive/*` of
many vehicles stand under the same keys; their traces end with the stage `uplink`.

## Keys

{keys}

All are sent with congestion control DROP, express; *urgent* ones with priority REAL_TIME, others with DATA_LOW. A
*hot* topic's older messages are worth nothing once there is a newer one: read it with a queue of one
(`RingChannel(1)`). Of the others a few may wait: the length of our own readers' queues stands in brackets. Who reads
too slowly loses messages; nobody slows the vehicle down.

## Queries

{queries}

Ask for the exact key (`{example}`): wildcards get no reply. Query with consolidation NONE: a long reply comes in
several messages of the same record, whose lists belong together, each with a {part} attached. The payload of an error
is its reason as text. A reader of `estimate` or `health/*` that comes late asks that same key for the last message.

## The car's own speed

A car that knows the speed of its wheels may send `speed`, each {reading} as a plain MessagePack map, 20 to 100 times a
second; [examples/car_speed.py](examples/car_speed.py) does, with nothing but zenoh and MessagePack. `t_ns` is when the
speed held, by CLOCK_MONOTONIC of the vehicle's computer, as `t_capture_ns`; a live camera's `t_source_ns` is of that
clock too, and beside a paced recording capture puts readings into the recording's. A car whose computer does not share
it sends `t_ns` 0, and the reading bears the time when it came. Each frame bears
the readings of the second before it, {kept} at the most and then the newest; what is lost beyond is counted in the
health of capture (`speeds_dropped`), as are messages that are no readings (`malformed`). Numbers that no car has, NaN
among them, are no malformed message: the estimate's status reports them. `Estimate.speed_sources` says what the metres
rest on. [speed.md](speed.md) has files, recordings and the rest.

## What may be driven by

Three answers are separate. **Alive**: the liveliness token `alive/optimize` is there. **On time**: `t_capture_ns` is
young enough on this computer's CLOCK_MONOTONIC (elsewhere `t_utc_ns`, with synchronised clocks); estimates come
within {budget_ms:g} ms at the {percentile:g}th percentile unless the configuration's `budgets` say otherwise.
**Valid**: the field `valid`. An estimate that is all three may be driven by. No message never means that all is well:
past its limit a reader itself reports that its estimate is stale, as `Planner.estimates` does.

`map_pose` is of another frame and another trust: the pose of `world` (REP-105's odom) in a map of places (REP-105's
map), said some time later and at low priority, with its own state and covariance. The ego in the map is
`T_map_odom @ T_world_ego` of any estimate of the same `epoch`; it jumps where `map_epoch` rises, estimates never do.
Nobody waits for the map process, and without one nothing is said ([maps.md](maps.md)).

`epoch` names the world frame. Where it rises, poses, map and trajectory began anew and must not be compared with
older ones. `frame_id` never falls within a run. Frames that perceive does not answer in time are published as
`coasting` with a growing covariance, then as invalid; the last of them is published again, corrected, once its
measurements are there.

## Statuses

{statuses}

## Attachments

Every message of a topic carries a {trace}: what each node did with the frame, and with an estimate also what was left
of the budget end to end when it was done. A stage's `done_ns - received_ns` is that node's step; from its `sent_ns`
to the next stage's `arrived_ns` is the hop between them, and from there to its `received_ns` the record waits in the
node's queue. Of a coasted frame perceive's stage is missing.

## Records

{conventions}

On the wire a pose `T_a_b`, that of b in a, is `[x_m, y_m, yaw_rad]`.

{records}
"""


def page() -> str:
    """The whole page, in Markdown."""
    budgets = BudgetsConfig()
    return _PAGE.format(
        bytes=MAX_MESSAGE_BYTES,
        reading=_link(SpeedReading),
        kept=KEPT_READINGS,
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
    """Each record once, followed by those that its fields hold."""
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
        said = own.get(field.name) or (everywhere[field.name] if kinds.get(field.name) == field.type else "")
        meaning = f"{pose}: {said}" if pose and said else pose or said
        default = "" if field.required else f"`{_plain(field)}`"
        yield f"`{field.name}`", _type(field.type), unit(field.name), default, meaning


def _plain(field: Any) -> str:
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    return msgspec.json.encode(value).decode()


def _type(kind: Any) -> str:
    """For a reader in any language."""
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
