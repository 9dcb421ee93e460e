"""The whole system on one screen: which nodes there are, and which records pass between them.

    camera -> [capture] -- frame --> [perceive] -- measurements --> [optimize] -- estimate, map --> planners

A topic's key is `birdslam/<vehicle>/v1/<topic>`, its payload one record as plain MessagePack (runtime/wire.py). Each
node declares the liveliness token `birdslam/<vehicle>/v1/alive/<node>` once it is ready for work.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import msgspec

from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements
from runtime.wire import Health

VERSION = "v1"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")


@dataclass(frozen=True)
class Topic:
    """One kind of message.

    A reader's queue holds `depth` messages: of a `hot` topic only the newest counts (depth 1), of others a few wait.
    When it is full the oldest is dropped, and counted. `urgent` topics are sent before the rest, in the order of puts.
    """

    name: str
    record: type[msgspec.Struct]
    producer: str
    depth: int
    hot: bool = False
    urgent: bool = True


@dataclass(frozen=True)
class Node:
    """One process of the pipeline, and the topics that it receives and sends."""

    name: str
    receives: tuple[str, ...]
    sends: tuple[str, ...]


NODES = {
    node.name: node
    for node in (
        Node("capture", receives=("estimate",), sends=("frame", "health/capture")),  # estimates pace --rate max
        Node("perceive", receives=("frame",), sends=("measurements", "health/perceive")),
        Node("optimize", receives=("measurements",), sends=("estimate", "map", "health/optimize")),
    )
}

TOPICS = {
    topic.name: topic
    for topic in (
        Topic("frame", FrameRef, "capture", depth=1, hot=True),
        Topic("measurements", Measurements, "perceive", depth=8),  # a lost one breaks the chain of edges: queue a few
        Topic("estimate", Estimate, "optimize", depth=1, hot=True),
        Topic("map", MapUpdate, "optimize", depth=256),
        *(Topic(f"health/{name}", Health, name, depth=4, urgent=False) for name in NODES),
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
    """The zenoh key of a topic. Raises ValueError for a bad vehicle name, KeyError for a topic that does not exist."""
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/{TOPICS[topic].name}"


def alive_key(vehicle: str, node: str) -> str:
    """The key of a node's liveliness token; `node` = "*" stands for all of them."""
    name = node if node == "*" else check_name("node", node)
    return f"birdslam/{check_name('vehicle', vehicle)}/{VERSION}/alive/{name}"
