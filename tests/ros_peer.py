"""The other side at a router, by the independent package zenoh-ros2-sdk, and a router as rmw_zenoh's is.

    python -m tests.ros_peer router PORT                       until its input ends
    python -m tests.ros_peer hear PORT DOMAIN TOPIC=TYPE...    a JSON line a message, until then
    python -m tests.ros_peer car PORT DOMAIN URI HZ            a recording round and round; images' times

Each says "ready". The package reads definitions of messages from files, written here from what rosbags knows.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from birdslam.ros.message_types import MessageTypes
from birdslam.ros.parts import BASE, CAMERA, MessageParts
from birdslam.sources.opening import open_recording
from birdslam.trajectory import mount_pose

IMAGE = "/front/image"
CAR_TOPICS = {
    IMAGE: "sensor_msgs/msg/Image",
    "/front/camera_info": "sensor_msgs/msg/CameraInfo",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/wheels": "geometry_msgs/msg/TwistStamped",
    "/fix": "sensor_msgs/msg/NavSatFix",
}
SPEED_MPS = 5.0
# Sender and router wait so long (microseconds) for a link that is busy. By their defaults, 1 ms, they drop an image
# where another process has the core; "reliable" changes nothing of it, since rmw_zenoh blocks for KEEP_ALL alone
_DROP = "transport/link/tx/queue/congestion_control/drop"
PATIENT = {f"{_DROP}/wait_before_drop": 100_000, f"{_DROP}/max_wait_before_drop_fragments": 100_000}
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"  # announces it to ROS sessions


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


def fields_of(message: Any) -> list[str]:
    """The names of a message's fields."""
    return [name for name in message.__dataclass_fields__ if name != "__msgtype__"]


def plain(value: Any) -> Any:
    """A message's fields; of arrays of bytes their number."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in fields_of(value)}
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
                with whole_lines:  # each topic has a thread
                    print(json.dumps(line), flush=True)

            qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if topic == "/tf_static" else None
            subscribers.append(ROS2Subscriber(topic, kind, came, domain_id=domain, router_port=port, qos=qos))
        print("ready", flush=True)
        sys.stdin.read()
        for subscriber in subscribers:
            subscriber.close()


def car(port: int, domain: int, uri: str, rate_hz: float) -> None:
    """Publishes what a car does, until the input ends."""
    from zenoh_ros2_sdk import ROS2Publisher

    recording, make = open_recording(uri), MessageTypes().make
    camera = recording.camera
    parts = MessageParts(make, "car")
    publishers = {
        topic: ROS2Publisher(topic, kind, domain_id=domain, router_port=port) for topic, kind in CAR_TOPICS.items()
    }
    over = threading.Event()

    def end() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=end, daemon=True).start()

    def send(topic: str, **fields: Any) -> None:
        message = make(CAR_TOPICS[topic], **fields)
        publishers[topic].publish(**{name: getattr(message, name) for name in fields_of(message)})

    print("ready", flush=True)
    begin_s = time.monotonic()
    for number, frame in enumerate(chain.from_iterable(recording.frames() for _ in count())):
        if over.wait(max(0.0, begin_s + number / rate_hz - time.monotonic())):
            break
        now_ns = time.time_ns()
        header = parts.header(CAMERA, now_ns)
        if number % 10 == 0:  # the package keeps nothing for those that come late
            send("/tf_static", transforms=[parts.transform(BASE, CAMERA, mount_pose(camera.ground), now_ns)])
            send(
                "/front/camera_info", header=header, width=camera.width_px, height=camera.height_px,
                distortion_model="plumb_bob", d=np.array(camera.distortion or (0.0,) * 5),
                k=camera.K.ravel(), r=np.eye(3).ravel(), p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
            )  # fmt: skip
            send("/fix", header=header, latitude=49.0 + 1e-6 * number, longitude=8.4, altitude=math.nan)
        forward = make("geometry_msgs/msg/Twist", linear=parts.vector(SPEED_MPS, 0.0, 0.0))
        send("/wheels", header=header, twist=forward)
        height_px, width_px, *colours = frame.image.shape
        send(
            IMAGE, header=header, height=height_px, width=width_px, step=frame.image.strides[0],
            encoding="bgr8" if colours else "mono8", data=np.ascontiguousarray(frame.image).ravel(),
        )  # fmt: skip
        print(now_ns, flush=True)


def route(port: int) -> None:
    """A router, until the input ends."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, microseconds in PATIENT.items():
        config.insert_json5(name, str(microseconds))
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    mode, port = sys.argv[1], int(sys.argv[2])
    if mode == "router":
        route(port)
    elif mode == "hear":
        hear(port, int(sys.argv[3]), sys.argv[4:])
    else:
        os.environ.setdefault(OVERRIDE, ";".join(f"{name}={value}" for name, value in PATIENT.items()))
        with definitions(port):
            car(port, int(sys.argv[3]), sys.argv[4], float(sys.argv[5]))
