"""The whole system on one screen: which nodes there are, and which records pass between them (docs/planner.md).

speed of the car, if it sends one
          v
camera -> [capture] -- frame --> [perceive] -- measurements --> [optimize] -- estimate, map --> planners
                             frame, estimate --> [map] -- map_pose --> planners
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import msgspec

from birdslam.loops.map_pose import MapPose
from birdslam.queries import MapSnapshot, Nearby, Trajectory
from birdslam.runtime.wire import Health
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, SpeedReading

VERSION = "v1"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
_KEY = re.compile(rf"birdslam/({_NAME.pattern})/{VERSION}/([A-Za-z0-9_/-]+)")


@dataclass(frozen=True)
class Topic:
    """One kind of message.

    A reader's queue holds `depth` messages: of a `hot` topic only the newest counts (depth 1), of others a few wait.
    When it is full the oldest is dropped, and counted. `urgent` topics are sent before the rest, in the order of puts.
    The producer answers a query of the topic's own key with its last `retained` messages, for those that come late.
    `pace`: how often there is one.
    """

    name: str
    record: type[msgspec.Struct]
    producer: str
    depth: int
    hot: bool = False
    urgent: bool = True
    retained: int = 0
    pace: str = "each frame"


@dataclass(frozen=True)
class Node:
    """One process of the pipeline or beside it, and the topics that it receives and sends."""

    name: str
    receives: tuple[str, ...]
    sends: tuple[str, ...]


NODES = {
    node.name: node
    for node in (
        Node("capture", receives=("estimate", "speed"), sends=("frame", "health/capture")),  # estimates: --rate max
        Node("perceive", receives=("frame",), sends=("measurements", "health/perceive")),
        Node("optimize", receives=("frame", "measurements"), sends=("estimate", "map", "health/optimize")),
    )
}
RECORDER = Node("record", receives=("frame", "measurements", "estimate", "map", "map_pose"), sends=("health/record",))
CAR = Node("car", receives=(), sends=("speed",))  # no process of ours: what knows the speed of the wheels, if any does
MAP = Node("map", receives=("frame", "estimate"), sends=("map_pose", "health/map"))
# The last two are there only where a drive is recorded, or driven in a map of places; no node waits for them
PROCESSES = {**NODES, RECORDER.name: RECORDER, MAP.name: MAP}

TOPICS = {
    topic.name: topic
    for topic in (
        # As many as a frame bears (sources/speed_log.py): what does not fit in no frame would have had
        Topic("speed", SpeedReading, CAR.name, depth=200, pace="as often as the car says it, 20 to 100 times a second"),
        Topic("frame", FrameRef, "capture", depth=1, hot=True),
        # A lost one breaks the chain of edges: a few are queued, and an optimizer that restarts asks for the last
        Topic("measurements", Measurements, "perceive", depth=8, retained=96),
        Topic("estimate", Estimate, "optimize", depth=1, hot=True, retained=1),
        Topic("map", MapUpdate, "optimize", depth=256, pace="each frame in which the map gained something"),
        Topic(
            "map_pose", MapPose, "map", depth=1, hot=True, urgent=False, retained=1, pace="each frame, some time later"
        ),
        *(
            Topic(f"health/{name}", Health, name, depth=4, urgent=False, retained=1, pace="once a second")
            for name in PROCESSES
        ),
    )
}


@dataclass(frozen=True)
class Query:
    """A query that the supervisor answers; the reply comes in one or more parts (wire.Part).

    `record` is the type of each part; dict: a plain map. `parameters`: name -> meaning.
    """

    name: str
    record: type[Any]
    meaning: str
    parameters: dict[str, str]


QUERIES = {
    query.name: query
    for query in (
        Query("map", MapSnapshot, "the whole map of the newest epoch", {}),
        Query(
            "trajectory",
            Trajectory,
            "where everybody has been, in the newest epoch",
            {"last_s": "only the last so many seconds of the source's time; left out: all"},
        ),
        Query("nearby", Nearby, "every road user by its closest approach, were all to go on as they move now", {}),
        Query("configuration", dict, "the configuration of the run, as in summary.json, without passwords", {}),
    )
}


def check_name(what: str, name: str) -> str:
    """`name` itself. Raises ValueError where it can't be part of a key, a socket's path and a file's name at once."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{what} {name!r} needs 1 to 32 letters, digits, '_' or '-', and starts with a letter or a digit"
        )
    return name


def key_of(vehicle: str, topic: str) -> str:
    """The zenoh key of a topic or a query. Raises ValueError for a bad vehicle name, KeyError for neither."""
    name = QUERIES[topic].name if topic in QUERIES else TOPICS[topic].name
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/{name}"


def alive_key(vehicle: str, node: str) -> str:
    """The key of a node's liveliness token; `node` = "*" stands for all of them."""
    name = node if node == "*" else check_name("node", node)
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/alive/{name}"


def every_key(topic: str) -> str:
    """The key expression of a topic, a query or `alive/NODE` of every vehicle; `*` stands for all nodes."""
    return f"birdslam/*/{VERSION}/{topic}"


def vehicle_and_topic(key: str) -> tuple[str, str] | None:
    """Returns what `key_of` and `alive_key` encoded in a key; None for other keys."""
    match = _KEY.fullmatch(key)
    return (match[1], match[2]) if match else None
