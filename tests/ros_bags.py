"""ROS bags for tests, written by `rosbags`: images, cameras, transforms and speeds as a car's computer records them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from birdslam.types import NS_PER_S

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
STORE1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
T = STORE.types
CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "bgra8": 4, "yuv422": 2, "yuyv": 2}

Written = tuple[str, int, Any]  # topic, time in ns, message


def write_bag(path: Path, messages: Iterable[Written], storage: str = "sqlite3") -> Path:
    """A bag in `path`: storage sqlite3 or mcap (a directory of ROS 2), or ros1 (a file)."""
    ros1 = storage == "ros1"
    writer: Any = Writer1(path) if ros1 else Writer2(path, version=8, storage_plugin=StoragePlugin[storage.upper()])
    connections: dict[str, Any] = {}
    store = STORE1 if ros1 else STORE
    with writer:
        for topic, t_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            if ros1:
                data = store.serialize_ros1(as_ros1(message), kind)
            else:
                data = store.serialize_cdr(message, kind)
            writer.write(connections[topic], t_ns, data)
    return path


def as_ros1(message: Any) -> Any:
    """The same in the types of ROS 1: headers count, and CameraInfo's matrices are in capitals."""
    if not hasattr(message, "__msgtype__"):
        return [as_ros1(one) for one in message] if isinstance(message, list) else message
    kind = STORE1.types[message.__msgtype__]
    values = {}
    for name in kind.__dataclass_fields__:
        if name in ("seq", "__msgtype__"):
            continue
        values[name] = as_ros1(getattr(message, name if hasattr(message, name) else name.lower()))
    return kind(**values, **({"seq": 0} if "seq" in kind.__dataclass_fields__ else {}))


def header(t_ns: int, frame: str = "camera_optical") -> Any:
    stamp = T["builtin_interfaces/msg/Time"](sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def image(
    pixels: np.ndarray, t_ns: int, encoding: str = "mono8", padding: int = 0, frame: str = "camera_optical"
) -> Any:
    """sensor_msgs/Image of an array (H, W[, C]) in its encoding, each row with some bytes of padding."""
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    return T["sensor_msgs/msg/Image"](
        header=header(t_ns, frame), height=height, width=width, encoding=encoding, is_bigendian=0,
        step=rows.shape[1], data=np.ascontiguousarray(rows).ravel(),
    )  # fmt: skip


def compressed(data: bytes, t_ns: int, kind: str = "jpeg") -> Any:
    return T["sensor_msgs/msg/CompressedImage"](
        header=header(t_ns), format=f"bgr8; {kind} compressed bgr8", data=np.frombuffer(data, np.uint8)
    )


def camera_info(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, model: str = "plumb_bob",
    distortion: tuple[float, ...] = (0.0,) * 5, rectified: tuple[float, float, float, float] | None = None,
    binning: int = 0, roi: tuple[int, int, int, int] = (0, 0, 0, 0), t_ns: int = 0,
) -> Any:  # fmt: skip
    """sensor_msgs/CameraInfo; `rectified` is fx, fy, cx, cy of P, where it is another camera than K."""
    rfx, rfy, rcx, rcy = rectified or (fx, fy, cx, cy)
    x0, y0, w, h = roi
    region = T["sensor_msgs/msg/RegionOfInterest"](x_offset=x0, y_offset=y0, width=w, height=h, do_rectify=False)
    return T["sensor_msgs/msg/CameraInfo"](
        header=header(t_ns), height=height, width=width, distortion_model=model, d=np.array(distortion),
        k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), r=np.eye(3).ravel(),
        p=np.array([rfx, 0, rcx, 0, 0, rfy, rcy, 0, 0, 0, 1.0, 0]), binning_x=binning, binning_y=binning, roi=region,
    )  # fmt: skip


def transform(parent: str, child: str, xyz: tuple[float, float, float], rotation: Rotation, t_ns: int = 0) -> Any:
    x, y, z, w = rotation.as_quat()
    return T["geometry_msgs/msg/TransformStamped"](
        header=header(t_ns, parent),
        child_frame_id=child,
        transform=T["geometry_msgs/msg/Transform"](
            translation=T["geometry_msgs/msg/Vector3"](*xyz),
            rotation=T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        ),
    )


def tf(*transforms: Any) -> Any:
    return T["tf2_msgs/msg/TFMessage"](transforms=list(transforms))


def twist(t_ns: int, speed_mps: float, yaw_rate_radps: float = 0.0) -> Any:
    return T["geometry_msgs/msg/TwistStamped"](
        header=header(t_ns, "base_link"), twist=_twist(speed_mps, yaw_rate_radps)
    )


def _twist(speed_mps: float, yaw_rate_radps: float) -> Any:
    vector = T["geometry_msgs/msg/Vector3"]
    return T["geometry_msgs/msg/Twist"](linear=vector(speed_mps, 0.0, 0.0), angular=vector(0.0, 0.0, yaw_rate_radps))


def odometry(
    t_ns: int, T_world_body: np.ndarray, child: str = "base_link", speed_mps: float = 0.0, variance: float = 0.0
) -> Any:
    """nav_msgs/Odometry of a pose (4, 4); `variance` of its twist's first and last axis, 0: not known."""
    x, y, z, w = Rotation.from_matrix(T_world_body[:3, :3]).as_quat()
    pose = T["geometry_msgs/msg/Pose"](
        position=T["geometry_msgs/msg/Point"](*T_world_body[:3, 3].tolist()),
        orientation=T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )
    cov = np.zeros(36)
    cov[[0, 35]] = variance
    return T["nav_msgs/msg/Odometry"](
        header=header(t_ns, "odom"), child_frame_id=child,
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=_twist(speed_mps, 0.0), covariance=cov),
    )  # fmt: skip


def fix(t_ns: int, latitude: float, longitude: float, altitude: float = float("nan"), status: int = 0) -> Any:
    return T["sensor_msgs/msg/NavSatFix"](
        header=header(t_ns, "gnss"), status=T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=latitude, longitude=longitude, altitude=altitude,
        position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip
