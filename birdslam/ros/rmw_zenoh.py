"""How rmw_zenoh_cpp names topics and nodes on zenoh, and what it attaches to a message.

After its design (docs/design.md there) and what its releases since Jazzy send: topics are keys, presence is shown by
liveliness tokens, in which `%` stands for `/`; a message is CDR, with its number, time and publisher attached.
"""

from __future__ import annotations

import hashlib
import re
import struct
from typing import NamedTuple

NO_HASH = "TypeHashNotSupported"  # what Humble has in place of a type's hash
GID_BYTES = 16
MAX_DOMAIN = 232  # of ROS 2
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)::msg::dds_::([A-Za-z0-9]+)_")
_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
_PUBLISHER_PARTS = 13  # of the token of a publisher


class Qos(NamedTuple):
    """Of a publisher or a subscription; deadlines, lifespans and leases stay at ROS' defaults."""

    reliable: bool = True
    transient_local: bool = False  # who comes late gets the last ones
    depth: int = 10

    def token(self) -> str:
        """As a token has it; what is rmw's default is left out."""
        return f"{'' if self.reliable else 2}:{1 if self.transient_local else ''}:,{self.depth}:,:,:,,"


LATCHED_QOS = Qos(transient_local=True, depth=1)
SENSOR_QOS = Qos(reliable=False, depth=5)  # fits publishers of either kind


class Node(NamedTuple):
    """A node of ROS in its zenoh session. `namespace` is "/" or "/red"; `session` is zenoh's id of the session."""

    domain: int
    session: str
    namespace: str
    name: str

    def token(self) -> str:
        """By which `ros2 node list` finds it."""
        return f"{self._of(0, 'NN')}"

    def publisher_token(self, number: int, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        """By which `ros2 topic list` finds what it publishes; `number` is the publisher's own in this session."""
        return self._endpoint(number, "MP", topic, type_name, type_hash, qos)

    def subscription_token(self, number: int, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        """By which publishers learn that somebody listens."""
        return self._endpoint(number, "MS", topic, type_name, type_hash, qos)

    def _endpoint(self, number: int, kind: str, topic: str, type_name: str, type_hash: str, qos: Qos) -> str:
        return f"{self._of(number, kind)}/{_mangled(topic)}/{dds_type(type_name)}/{type_hash}/{qos.token()}"

    def _of(self, number: int, kind: str) -> str:
        namespace = "%" if self.namespace == "/" else _mangled(self.namespace)
        return f"@ros2_lv/{self.domain}/{self.session}/0/{number}/{kind}/%/{namespace}/{self.name}"


class Publication(NamedTuple):
    """What the token of somebody's publisher says."""

    topic: str
    type_name: str  # sensor_msgs/msg/Image
    type_hash: str


def topic_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """The key that the messages of a topic have."""
    return f"{domain}/{check_topic(topic).lstrip('/')}/{dds_type(type_name)}/{type_hash}"


def any_type_key(domain: int, topic: str) -> str:
    """The key expression of a topic whatever its type."""
    return f"{domain}/{check_topic(topic).lstrip('/')}/*/*"


def publishers_key(domain: int, topic: str) -> str:
    """The key expression of the tokens of all publishers of a topic."""
    return f"@ros2_lv/{domain}/*/*/*/MP/*/*/*/{_mangled(check_topic(topic))}/*/*/*"


def publication_of(token: str) -> Publication | None:
    """Of a publisher's token; None for what is none."""
    parts = token.split("/")
    if len(parts) != _PUBLISHER_PARTS or parts[5] != "MP":
        return None
    type_name = ros_type(parts[10])
    return None if type_name is None else Publication(parts[9].replace("%", "/"), type_name, parts[11])


def type_of_key(key: str) -> str | None:
    """The type of a message by its key; None for a key of no topic."""
    parts = key.split("/")
    return ros_type(parts[-2]) if len(parts) > 3 else None


def dds_type(type_name: str) -> str:
    """`sensor_msgs::msg::dds_::Image_` of `sensor_msgs/msg/Image`."""
    package, _, name = type_name.split("/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """The way back; None for what is none."""
    match = _TYPE.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else None


def gid(token: str) -> bytes:
    """A publisher's own number, of its token: the same each time, and nobody else's."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


def attachment(sequence: int, t_ns: int, gid: bytes) -> bytes:
    """What goes with a message: its number among its publisher's, from 1 on, when it was sent (UTC), and by whom."""
    return _ATTACHMENT.pack(sequence, t_ns, GID_BYTES, gid)


def sequence_of(attached: bytes) -> int | None:
    """A message's number among its publisher's; None where that is not attached."""
    return int(_ATTACHMENT.unpack(attached)[0]) if len(attached) == _ATTACHMENT.size else None


def check_topic(topic: str) -> str:
    """`topic` itself. Raises ValueError where it is no full name of ROS: it is to become part of a key."""
    if not _NAME.fullmatch(topic):
        raise ValueError(f"{topic!r} is no topic of ROS: /NAME/NAME of letters, digits and '_'")
    return topic


def check_namespace(namespace: str) -> str:
    """As ROS writes it: "/" or "/NAME/NAME"; "" and "red" become "/" and "/red". Raises ValueError."""
    stripped = namespace.strip("/")
    return check_topic(f"/{stripped}") if stripped else "/"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
