"""ROS 2 messages with the library rosbags: creation, CDR serialization and type hashes."""

from __future__ import annotations

from typing import Any

import numpy as np

from birdslam.ros.bag import NEEDS_EXTRA, BagError

# vision_msgs 4, since Humble; rosbags has only the packages of ROS itself
VISION_MSGS = {
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
_ENCAPSULATION_BYTES = 4  # CDR header with the byte order


class MessageTypes:
    """The types of ROS 2 Humble; later releases have the same definitions of all messages used here.

    Raises BagError if rosbags is not installed.
    """

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise BagError(NEEDS_EXTRA) from None
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        for name, fields in VISION_MSGS.items():
            self.store.register(get_types_from_msg(fields, f"vision_msgs/msg/{name}"))
        self._zeros: dict[str, tuple[tuple[str, Any], ...]] = {}

    def make(self, name: str, /, **fields: Any) -> Any:
        """Creates a message by its full name, such as "nav_msgs/msg/Odometry"; missing fields are zero."""
        if name not in self._zeros:
            self._zeros[name] = tuple((field, kind) for field, kind in self.store.fielddefs[name][1])
        for field, kind in self._zeros[name]:
            if field not in fields:
                fields[field] = self._zero(kind)
        return self.store.types[name](**fields)

    def _zero(self, kind: Any) -> Any:
        node, value = int(kind[0]), kind[1]
        if node == 1:  # a number, a bool or a string
            return "" if value[0] == "string" else 0
        if node == 2:  # a message
            return self.make(value)
        element, count = value
        if int(element[0]) == 1 and element[1][0] != "string":
            return np.zeros(count, dtype=np.uint8 if element[1][0] in ("byte", "octet") else element[1][0])
        return [self._zero(element) for _ in range(count)]

    def cdr(self, message: Any) -> bytes:
        """Serializes a message."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def read(self, data: bytes, name: str) -> Any:
        """Deserializes a message from an untrusted sender. Raises ValueError if it is not of this type."""
        if len(data) < _ENCAPSULATION_BYTES or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError(f"{len(data)} bytes are not CDR")
        try:
            return self.store.deserialize_cdr(data, name)
        except Exception as error:  # the library raises many types for corrupt bytes
            raise ValueError(f"{len(data)} bytes are not a {name}: {error or type(error).__name__}") from None

    def type_hash(self, name: str) -> str:
        """RIHS01 hash of a type (REP-2011), by which ROS since Iron compares the types of two endpoints."""
        return self.store.hash_rihs01(name)
