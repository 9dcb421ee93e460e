"""The other side at a router: a listener of the independent package zenoh-ros2-sdk, and a router as rmw_zenoh's is.

    python -m birdslam.perf.latency.ros_peer router PORT                        until its input ends
    python -m birdslam.perf.latency.ros_peer hear PORT DOMAIN TOPIC=TYPE...     a JSON line a message, until then

Each says "ready". The package reads message definitions from files; these are written from what rosbags knows, and it
hashes them itself.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from birdslam.ros.message_types import MessageTypes


def write_definitions(folder: Path) -> None:
    """Every type of ROS 2 as PACKAGE/msg/NAME.msg."""
    store = MessageTypes().store
    for name in store.fielddefs:
        path = folder / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(store.generate_msgdef(name, ros_version=2)[0].split("=" * 20)[0])


@contextmanager
def definitions(port: int) -> Iterator[None]:
    """The package's session at the router, and the definitions that it reads."""
    from zenoh_ros2_sdk.message_registry import get_registry
    from zenoh_ros2_sdk.session import ZenohSession

    with tempfile.TemporaryDirectory() as folder:
        write_definitions(Path(folder))
        get_registry(folder)
        session = ZenohSession.get_instance(router_port=port)
        try:
            yield
        finally:
            session.close()


def plain(value: Any) -> Any:
    """A message's fields; of arrays of bytes their number."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    if hasattr(value, "dtype"):
        return len(value) if value.dtype == "uint8" else [None if math.isnan(x) else x for x in value.tolist()]
    return [plain(one) for one in value] if isinstance(value, list) else value


def hear(port: int, domain: int, topics: list[str]) -> None:
    """Prints what comes, with the time when it came (UTC), until the input ends."""
    from zenoh_ros2_sdk import ROS2Subscriber
    from zenoh_ros2_sdk.qos import QosDurability, QosProfile

    subscribers, whole_lines = [], threading.Lock()
    with definitions(port):
        for text in topics:
            topic, _, kind = text.partition("=")

            def came(message: Any, topic: str = topic) -> None:
                line = {"topic": topic, "came_ns": time.time_ns(), "message": plain(message)}
                with whole_lines:  # each topic has a thread of its own
                    print(json.dumps(line), flush=True)

            qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if topic == "/tf_static" else None
            subscribers.append(ROS2Subscriber(topic, kind, came, domain_id=domain, router_port=port, qos=qos))
        print("ready", flush=True)
        sys.stdin.read()
        for subscriber in subscribers:
            subscriber.close()


def route(port: int) -> None:
    """A router, until the input ends."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    if sys.argv[1] == "router":
        route(int(sys.argv[2]))
    else:
        hear(int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
