"""A car of ROS 2 for tests, by the independent package zenoh-ros2-sdk: images, camera, transforms, speed, fixes.

    python -m tests.ros_peer PORT DOMAIN URI HZ FRAMES

Says "ready" before the first image and "over" after the last one, and ends with its input.
"""

from __future__ import annotations

import sys
import time
from itertools import islice
from typing import Any

from birdslam.perf.latency.ros_peer import definitions


def drive(port: int, domain: int, uri: str, rate_hz: float, frames: int) -> None:
    from scipy.spatial.transform import Rotation
    from zenoh_ros2_sdk import ROS2Publisher

    from birdslam.sources.opening import open_recording
    from birdslam.trajectory import mount_pose
    from tests.ros_bags import camera_info, fix, image, tf, transform, twist

    recording = open_recording(uri)
    camera = recording.camera
    mount = mount_pose(camera.ground)
    rides = transform("base_link", "camera_optical", tuple(mount[:3, 3]), Rotation.from_matrix(mount[:3, :3]))
    topics = {
        "/front/image": "sensor_msgs/msg/Image",
        "/front/camera_info": "sensor_msgs/msg/CameraInfo",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/wheels": "geometry_msgs/msg/TwistStamped",
        "/fix": "sensor_msgs/msg/NavSatFix",
    }
    publishers = {
        topic: ROS2Publisher(topic, kind, domain_id=domain, router_port=port) for topic, kind in topics.items()
    }

    def send(topic: str, message: Any) -> None:
        fields = (name for name in message.__dataclass_fields__ if name != "__msgtype__")
        publishers[topic].publish(**{name: getattr(message, name) for name in fields})

    print("ready", flush=True)
    begin_s = time.monotonic()
    for number, frame in enumerate(islice(recording.frames(), frames)):
        time.sleep(max(0.0, begin_s + number / rate_hz - time.monotonic()))
        assert frame.image is not None
        now_ns = time.time_ns()
        if number % 10 == 0:  # the package keeps nothing for those that come late
            send("/tf_static", tf(rides))
            size = camera.width_px, camera.height_px
            send("/front/camera_info", camera_info(*size, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))
            send("/fix", fix(now_ns, 49.0 + 1e-6 * number, 8.4))
        send("/wheels", twist(now_ns, 5.0))
        send("/front/image", image(frame.image, now_ns, "mono8" if frame.image.ndim == 2 else "bgr8"))
    print("over", flush=True)


if __name__ == "__main__":
    port, domain, uri, rate_hz, frames = sys.argv[1:]
    with definitions(int(port)):
        drive(int(port), int(domain), uri, float(rate_hz), int(frames))
        sys.stdin.read()
