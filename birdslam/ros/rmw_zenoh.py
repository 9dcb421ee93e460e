"""The wire format of rmw_zenoh_cpp: keys of topics, tokens of nodes, attachments of messages.

Source: docs/design.md of rmw_zenoh and its releases since Jazzy. Topics are keys; liveliness tokens, in which `%`
replaces `/`, announce endpoints; a message is CDR with an attachment of sequence number, time and publisher.
"""

from __future__ import annotations

import hashlib
import re
import struct
from typing import NamedTuple

NO_HASH = "TypeHashNotSupported"  # Humble's placeholder for a type hash
GID_BYTES = 16
MAX_DOMAIN = 232  # of ROS 2
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)::msg::dds_::([A-Za-z0-9]+)_")
_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
_PUBLISHER_PARTS = 13  # of the token of a publisher


class Qos(NamedTuple):
    """QoS of a publisher or a subscription; deadlines, lifespans and leases are ROS' defaults."""

    reliable: bool = True
    transient_local: bool = False  # late subscribers get the last messages
    depth: int = 10

    def token(self) -> str:
        """The QoS part of a token, without values at rmw's defaults."""
        return f"{'' if self.reliable else 2}:{1 if self.transient_local else ''}:,{self.depth}:,:,:,,"


LATCHED_QOS = Qos(transient_local=True, depth=1)
SENSOR_QOS = Qos(reliable=False, depth=5)  # compatible with reliable and best-effort publishers


class Node(NamedTuple):
    """A node of ROS in its zenoh session. `namespace` is "/" or "/red"; `session` is zenoh's id of the session."""

    domain: int
    session: str
    namespace: str
    name: str

    def token(self) -> str:
        """The token by which `ros2 node list` finds the node."""
        return f"{self._of(0, 'NN')}"

    def publisher_token(self, number: int, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        """The token of a publisher, for `ros2 topic list`; `number` identifies the publisher in this session."""
        return self._endpoint(number, "MP", topic, type_name, type_hash, qos)

    def subscription_token(self, number: int, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        """The token by which publishers discover a subscription."""
        return self._endpoint(number, "MS", topic, type_name, type_hash, qos)

    def _endpoint(self, number: int, kind: str, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        return f"{self._of(number, kind)}/{_mangled(topic)}/{dds_type(type_name)}/{type_hash}/{qos.token()}"

    def _of(self, number: int, kind: str) -> str:
        namespace = "%" if self.namespace == "/" else _mangled(self.namespace)
        return f"@ros2_lv/{self.domain}/{self.session}/0/{number}/{kind}/%/{namespace}/{self.name}"


class Publication(NamedTuple):
    """The content of a publisher's token."""

    topic: str
    type_name: str  # sensor_msgs/msg/Image
    type_hash: str


def topic_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """The key of a topic's messages."""
    return f"{domain}/{check_topic(topic).lstrip('/')}/{dds_type(type_name)}/{type_hash}"


def any_type_key(domain: int, topic: str) -> str:
    """The key expression of a topic with any type."""
    return f"{domain}/{check_topic(topic).lstrip('/')}/*/*"


def publishers_key(domain: int, topic: str) -> str:
    """The key expression of the tokens of all publishers of a topic."""
    return f"@ros2_lv/{domain}/*/*/*/MP/*/*/*/{_mangled(check_topic(topic))}/*/*/*"


def publication_of(token: str) -> Publication | None:
    """Parses a publisher's token; None if it is not one."""
    parts = token.split("/")
    if len(parts) != _PUBLISHER_PARTS or parts[5] != "MP":
        return None
    type_name = ros_type(parts[10])
    return None if type_name is None else Publication(parts[9].replace("%", "/"), type_name, parts[11])


def type_of_key(key: str) -> str | None:
    """The message type in a key; None if it is not a topic's key."""
    parts = key.split("/")
    return ros_type(parts[-2]) if len(parts) > 3 else None


def dds_type(type_name: str) -> str:
    """`sensor_msgs::msg::dds_::Image_` of `sensor_msgs/msg/Image`."""
    package, _, name = type_name.split("/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """The inverse of `dds_type`; None if `name` is not a DDS type."""
    match = _TYPE.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else None


def gid(token: str) -> bytes:
    """A publisher's unique id, derived from its token."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(sequence: int, t_ns: int, gid: bytes) -> bytes:
    """The attachment of a message: its sequence number from 1, the time sent (UTC), and the publisher."""
    return _ATTACHMENT.pack(sequence, t_ns, GID_BYTES, gid)


def sequence_of(attached: bytes) -> int | None:
    """The sequence number in an attachment; None if there is none."""
    return int(_ATTACHMENT.unpack(attached)[0]) if len(attached) == _ATTACHMENT.size else None


def check_topic(topic: str) -> str:
    """Returns `topic`. Raises ValueError if it is not a full ROS name, since it becomes part of a key."""
    if not _NAME.fullmatch(topic):
        raise ValueError(f"{topic!r} is not a ROS topic; write /NAME/NAME with letters, digits and '_'")
    return topic


def check_namespace(namespace: str) -> str:
    """The normalized namespace, "/" or "/NAME/NAME"; "" and "red" become "/" and "/red". Raises ValueError."""
    stripped = namespace.strip("/")
    return check_topic(f"/{stripped}") if stripped else "/"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
