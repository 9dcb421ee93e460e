"""The nodes of the system and the records that pass between them (docs/planner.md).

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

    `depth`: length of a reader's queue; if full, the oldest message is dropped and counted. `hot`: only the newest
    message matters (depth 1). `urgent`: sent before other topics. `retained`: number of last messages with which the
    producer answers queries of late readers. `pace`: how often it is sent.
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
CAR = Node("car", receives=(), sends=("speed",))  # an external process that publishes the wheel speed, optional
MAP = Node("map", receives=("frame", "estimate"), sends=("map_pose", "health/map"))
# The last two are optional; no node waits for them
PROCESSES = {**NODES, RECORDER.name: RECORDER, MAP.name: MAP}

TOPICS = {
    topic.name: topic
    for topic in (
        # As many as fit into a frame (sources/speed_log.py)
        Topic("speed", SpeedReading, CAR.name, depth=200, pace="at the car's rate, 20 to 100 times a second"),
        Topic("frame", FrameRef, "capture", depth=1, hot=True),
        # A lost one breaks the chain of edges, so a few are queued; a restarted optimizer queries the last ones
        Topic("measurements", Measurements, "perceive", depth=8, retained=96),
        Topic("estimate", Estimate, "optimize", depth=1, hot=True, retained=1),
        Topic("map", MapUpdate, "optimize", depth=256, pace="each frame with new map points"),
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
            "all trajectories of the newest epoch",
            {"last_s": "only the last seconds of source time; default: all"},
        ),
        Query("nearby", Nearby, "every road user by its closest approach at constant velocity", {}),
        Query("configuration", dict, "the configuration of the run, as in summary.json, without passwords", {}),
    )
}


def check_name(what: str, name: str) -> str:
    """Returns `name`. Raises ValueError if it is not valid in keys, socket paths and file names."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{what} {name!r} needs 1 to 32 letters, digits, '_' or '-', and starts with a letter or a digit"
        )
    return name


def key_of(vehicle: str, topic: str) -> str:
    """Returns the key of a topic or a query. Raises ValueError for an invalid vehicle name, KeyError for neither."""
    name = QUERIES[topic].name if topic in QUERIES else TOPICS[topic].name
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/{name}"


def alive_key(vehicle: str, node: str) -> str:
    """Returns the key of a node's liveliness token; `node` = "*": all nodes."""
    name = node if node == "*" else check_name("node", node)
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/alive/{name}"


def every_key(topic: str) -> str:
    """Returns the key expression of a topic, a query or `alive/NODE` of all vehicles; `*`: all nodes."""
    return f"birdslam/*/{VERSION}/{topic}"


def vehicle_and_topic(key: str) -> tuple[str, str] | None:
    """Returns what `key_of` and `alive_key` encoded in a key; None for other keys."""
    match = _KEY.fullmatch(key)
    return (match[1], match[2]) if match else None
