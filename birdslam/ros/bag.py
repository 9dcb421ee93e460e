"""Reads ROS bags of any storage: ROS 2 (a directory, .mcap, .db3) and ROS 1 (.bag)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import msgspec

from birdslam.types import NS_PER_S

NEEDS_EXTRA = "ROS bags need the library rosbags: pip install 'birdslam[ros]'"

_NAMED = re.compile(r"'(\w+/msg/\w+)'")  # types of fields in rosbags' definitions


class BagError(ValueError):
    """A bag that can't be used; the message names it and the reason."""


class BagTopics(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Names of the topics read from a ROS bag."""

    image: str = ""  # sensor_msgs/Image or CompressedImage; "": the only one that is there
    camera_info: str = ""  # sensor_msgs/CameraInfo; "": the one beside the image's topic, or the only one
    speed: str = ""  # the car's own speed: TwistStamped, TwistWithCovarianceStamped or Odometry; "": none
    truth: str = ""  # for `evaluate odometry`: nav_msgs/Odometry or sensor_msgs/NavSatFix; "": none


class BagMessage(NamedTuple):
    """One message; `t_ns` is its receive time."""

    topic: str
    t_ns: int
    content: Any  # its fields, as rosbags names them


class Bag:
    """An open bag, a context manager. Raises BagError if it can't be opened or read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            from rosbags.highlevel import AnyReader
        except ImportError:
            raise BagError(f"{path}: {NEEDS_EXTRA}") from None
        if not path.exists():
            raise BagError(f"{path}: no such file or directory")
        self._stack = ExitStack()
        self.types: dict[str, str] = {}  # topic -> message type, as in "sensor_msgs/Image"
        self.counts: dict[str, int] = {}  # topic -> messages
        try:
            reader = AnyReader([path], default_typestore=_types(is_ros2=True))
            self._reader = self._stack.enter_context(reader)
            for connection in sorted(self._reader.connections, key=lambda one: one.topic):
                kind = connection.msgtype.replace("/msg/", "/")
                usual = _types(self._reader.is2).fielddefs
                is_usual = _has_usual_fields(connection.msgtype, self._reader.typestore.fielddefs, usual)
                self.types[connection.topic] = kind if is_usual else f"{kind} with other fields"
                self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
        except Exception as error:  # storages, YAML and compression raise many types for a damaged file
            self._stack.close()
            raise BagError(f"{path}: is not a readable ROS bag: {_reason(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self._stack.close()

    def of_type(self, *types: str) -> list[str]:
        """Topics with messages of one of these types, by name."""
        return [topic for topic, kind in self.types.items() if kind in types and self.counts[topic]]

    def find(self, topic: str, *types: str) -> str:
        """Returns the topic if it has one of these types. Raises BagError, which lists the topics."""
        if self.types.get(topic) in types and self.counts[topic]:
            return topic
        kind = self.types.get(topic)
        reason = "is not in it" if kind is None else f"is {kind}" if kind not in types else "has no messages"
        raise BagError(f"{self.path}: {topic} {reason}; expected {' or '.join(types)}. {self.listing(*types)}")

    def listing(self, *types: str) -> str:
        """Lists the topics of these types, else all, for a message."""
        fitting = self.of_type(*types)
        names = ", ".join(f"{topic} ({self.types[topic]})" for topic in fitting or self.types)
        return f"{'Such topics' if fitting else 'Its topics'}: {names or 'none'}"

    def messages(self, *topics: str) -> Iterator[BagMessage]:
        """Messages of some topics in receive order."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        if not connections:
            return
        messages = self._reader.messages(connections=connections)
        while True:
            try:
                connection, t_ns, data = next(messages)
                content = self._reader.deserialize(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:  # as in __init__
                raise BagError(f"{self.path}: can't be read further: {_reason(error)}") from None
            yield BagMessage(connection.topic, t_ns, content)


def stamp_ns(content: Any) -> int:
    """The time in a message's header in ns."""
    stamp = content.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


@cache
def _types(is_ros2: bool) -> Any:
    """The usual types, equal in all releases for those read here. Bags of ROS 2 before Iron do not carry theirs."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE if is_ros2 else Stores.ROS1_NOETIC)


def _has_usual_fields(kind: str, found: Any, usual: Any) -> bool:
    """Whether a bag defines a type and those of its fields as `usual`; true for types that are not in it."""
    if kind not in usual:
        return True
    fields = usual[kind][1]
    return (
        kind in found
        and found[kind][1] == fields
        and all(_has_usual_fields(name, found, usual) for name in set(_NAMED.findall(repr(fields))))
    )


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
