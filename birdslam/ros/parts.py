"""Parts of ROS messages: headers, poses, covariances, transforms and diagnostics.

Axes follow REP-103. Covariances of records are in the body's axes; ROS expresses those of a pose in the parent frame,
those of a twist in the child frame. Quantities that are not estimated have UNKNOWN_VARIANCE.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import Transform
from birdslam.types import NS_PER_S

Sent = tuple[str, Any]  # topic, message

MAP, ODOM, BASE, CAMERA = "map", "odom", "base_link", "camera_optical_frame"  # REP-105
UNKNOWN_VARIANCE = 1e6  # of quantities that are not estimated
PLANE = (0, 1, 5)  # x, y and yaw in ROS' order: x, y, z, about x, about y, about z


class Level(enum.IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Make(Protocol):
    """Creates a message by its full name, such as "nav_msgs/msg/Odometry"; missing fields are zero."""

    def __call__(self, name: str, /, **fields: Any) -> Any: ...


class MessageParts:
    """Creates parts with `make`. `name` is the vehicle's, `frames` the prefix of all frame names ("red/")."""

    def __init__(self, make: Make, name: str, frames: str = "") -> None:
        self.make, self._name, self.frames = make, name, frames

    def diagnostic(self, what: str, level: Level, text: str, values: Mapping[str, object], t_ns: int) -> Sent:
        """The state of a part of the system."""
        status = self.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            name=f"birdslam: {what}",
            message=text,
            hardware_id=self._name,
            level=int(level),
            values=[self.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(v)) for key, v in values.items()],
        )
        header = self.header("", t_ns)
        return "/diagnostics", self.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def colour(self, red: float, green: float, blue: float, alpha: float) -> Any:
        """A colour of red, green, blue and alpha, each 0 to 1."""
        return self.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha)

    def at(self, point: Any) -> Any:
        """A pose at a point, without rotation."""
        turn = self.make("geometry_msgs/msg/Quaternion", w=1.0)
        return self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)

    def transform(self, parent: str, child: str, T_parent_child: Transform, t_ns: int) -> Any:
        """A transform `T_parent_child` (4, 4); frame names are without prefix."""
        pose = self.pose(T_parent_child)
        at = pose.position
        moved = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(at.x, at.y, at.z), rotation=pose.orientation
        )
        header = self.header(parent, t_ns)
        return self.make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=self.frames + child, transform=moved
        )

    def header(self, frame: str, t_ns: int) -> Any:
        """A header for `frame`, a name without prefix; "": no frame."""
        sec, nanosec = divmod(max(t_ns, 0), NS_PER_S)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame and self.frames + frame)

    def pose(self, T: Transform) -> Any:
        """A pose in space from (4, 4)."""
        from scipy.spatial.transform import Rotation  # imported late: few processes need it

        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
        at_x, at_y, at_z = T[:3, 3].tolist()
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=at_x, y=at_y, z=at_z),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def level(self, T: SE2, z_m: float) -> Any:
        """A pose of a body on the road, without pitch and roll."""
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=T.x_m, y=T.y_m, z=z_m),
            orientation=self.make(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(T.yaw_rad / 2.0), w=math.cos(T.yaw_rad / 2.0)
            ),
        )

    def vector(self, x: float, y: float, z: float) -> Any:
        """A vector."""
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def rotated(cov: Floats, yaw_rad: float) -> Floats:
    """Rotates a covariance (3, 3) from a body's axes to those of the frame in which it has this yaw."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    out: Floats = R @ cov @ R.T
    return out


def six(cov: Floats) -> Floats:
    """ROS' covariance (36,) of x, y, z and the rotations about them, with UNKNOWN_VARIANCE off the road plane."""
    out = UNKNOWN_VARIANCE * np.eye(6)
    out[np.ix_(PLANE, PLANE)] = cov
    return out.ravel()
