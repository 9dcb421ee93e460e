"""Conversion between the camera's foot on the road, the origin of `ego`, and the tilted axes of the car.

Odometry projects the camera's motion on the road (`odometry.motion.planar`): the foot stays under the camera while the
car pitches, but the origin of the car's axes does not.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.trajectory import Transform, ego_pose, split_pose
from birdslam.types import Attitude


def body_pose(T_a_foot: SE2, attitude: Attitude, camera_height_m: float) -> Transform:
    """Returns `T_a_body` (4, 4): the car's axes, tilted about the camera."""
    out = ego_pose(T_a_foot, attitude)
    out[:3, 3] += camera_height_m * (np.array([0.0, 0.0, 1.0]) - out[:3, 2])
    return out


def foot(T_a_body: Transform, camera_height_m: float) -> tuple[SE2, Attitude]:
    """Inverts `body_pose`."""
    level = T_a_body.copy()
    level[:3, 3] += camera_height_m * (T_a_body[:3, 2] - np.array([0.0, 0.0, 1.0]))
    return split_pose(level)
