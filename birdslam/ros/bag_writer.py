"""A ROS 2 bag that is written: a directory that appears when it is whole."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from birdslam.ros.bag import NEEDS_EXTRA, BagError

Storage = Literal["mcap", "sqlite3"]

# vision_msgs 4, since Humble; rosbags knows the packages of ROS itself alone
VISION_MSGS = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


class BagWriter:
    """Writes messages of ROS 2 Humble to a bag in a directory that must not exist. A context; raises BagError.

    It is written beside it and renamed at the end; where the context ends by an exception nothing is left.
    """

    def __init__(self, directory: Path, storage: Storage = "mcap") -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
        except ImportError:
            raise BagError(f"{directory}: {NEEDS_EXTRA}") from None
        if directory.exists():
            raise BagError(f"{directory}: is there already")
        self.directory = directory
        self._partial = directory.with_name(f".{directory.name}.partial")
        self._store = _types()
        self._connections: dict[str, Any] = {}
        try:
            if self._partial.exists():  # of an export that was killed
                shutil.rmtree(self._partial)
            writer = Writer(self._partial / directory.name, version=8, storage_plugin=StoragePlugin[storage.upper()])
            self._writer = writer.__enter__()
        except OSError as error:
            raise BagError(f"{directory}: can't be written: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.__exit__(kind, error, trace)
            if kind is None:
                (self._partial / self.directory.name).rename(self.directory)
        except OSError as failure:
            raise BagError(f"{self.directory}: can't be written: {failure.strerror}") from None
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    def make(self, name: str, /, **fields: Any) -> Any:
        """A message of its full name; fields that are not given are zero."""
        for field, kind in self._store.fielddefs[name][1]:
            if field not in fields:
                fields[field] = self._zero(kind)
        return self._store.types[name](**fields)

    def _zero(self, kind: Any) -> Any:
        node, value = int(kind[0]), kind[1]
        if node == 1:  # a number, a truth value or a string
            return "" if value[0] == "string" else 0
        if node == 2:  # a message
            return self.make(value)
        element, count = value
        if int(element[0]) == 1 and element[1][0] != "string":
            return np.zeros(count, dtype=np.uint8 if element[1][0] in ("byte", "octet") else element[1][0])
        return [self._zero(element) for _ in range(count)]

    def write(self, topic: str, message: Any, t_ns: int) -> None:
        """A message that the bag received at `t_ns`."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=_qos(topic)
            )
        try:
            self._writer.write(self._connections[topic], max(t_ns, 0), self._store.serialize_cdr(message, kind))
        except OSError as error:
            raise BagError(f"{self.directory}: can't be written: {error.strerror}") from None


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, fields in VISION_MSGS.items():
        store.register(get_types_from_msg(fields, f"vision_msgs/msg/{name}"))
    return store


def _qos(topic: str) -> list[Any]:
    """What comes once must wait for those who come later: transient local; the rest by default."""
    if topic not in ("/tf_static", "/birdslam/path"):
        return []
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    for_ever = QosTime(2147483647, 4294967295)
    return [
        Qos(
            QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, for_ever, for_ever,
            QosLiveliness.AUTOMATIC, for_ever, False,
        )
    ]  # fmt: skip
