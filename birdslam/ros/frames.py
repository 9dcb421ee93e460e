"""Static transforms of a bag (/tf_static, REP-105), and the camera's mount over the road by them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.ros.bag import Bag
from birdslam.trajectory import Transform, inverse, mount_pose, split_pose

TF_STATIC = "/tf_static"
# REP-105 and REP-120: the footprint is on the road. Cars without one have base_link there (Autoware, KITTI).
ON_THE_ROAD = ("base_footprint", "base_link")


class StaticFrames:
    """The static transforms between the frames of a bag, or of messages of /tf_static."""

    def __init__(self, bag: Bag) -> None:
        self._add(message.content for message in bag.messages(TF_STATIC))

    @classmethod
    def of(cls, messages: Iterable[Any]) -> StaticFrames:
        """The frames of tf2_msgs/TFMessage."""
        found = cls.__new__(cls)
        found._add(messages)
        return found

    def _add(self, messages: Iterable[Any]) -> None:
        self._from_parent: dict[str, tuple[str, Transform]] = {}
        for message in messages:
            for one in message.transforms:
                child, parent = one.child_frame_id.lstrip("/"), one.header.frame_id.lstrip("/")
                self._from_parent[child] = parent, _matrix(one.transform)

    def find(self, parent: str, child: str) -> Transform | None:
        """`T_parent_child` (4, 4); None if no chain of transforms connects them."""
        to_root = [self._to_root(frame.lstrip("/")) for frame in (parent, child)]
        common = next((frame for frame in to_root[1] if frame in to_root[0]), None)
        if common is None:
            return None
        T_common_parent, T_common_child = (path[common] for path in to_root)
        out: Transform = inverse(T_common_parent) @ T_common_child
        return out

    def _to_root(self, frame: str) -> dict[str, Transform]:
        """Each ancestor of a frame, itself first, with `T_ancestor_frame`."""
        T_ancestor_frame: Floats = np.eye(4)
        out = {frame: T_ancestor_frame}
        while frame in self._from_parent:
            frame, T_parent_child = self._from_parent[frame]
            if frame in out:  # a cycle
                break
            T_ancestor_frame = T_parent_child @ T_ancestor_frame
            out[frame] = T_ancestor_frame
        return out

    def mount(self, camera: str) -> GroundPlane | None:
        """The optical frame `camera` over the road; None if no transform reaches it.

        Raises ValueError for a mount that is implausible for a car's camera.
        """
        found = ((base, self.find(base, camera)) for base in ON_THE_ROAD)
        base, T_base_cam = next(((base, pose) for base, pose in found if pose is not None), ("", None))
        if T_base_cam is None:
            return None
        height_m = float(T_base_cam[2, 3])
        level = T_base_cam @ inverse(mount_pose(GroundPlane(1.0)))  # the rest is yaw, pitch, roll and the position
        _, attitude = split_pose(level)
        pitch_rad, roll_rad = attitude.pitch_rad, attitude.roll_rad
        if not 0.2 < height_m < 5.0 or abs(pitch_rad) > 0.5 or abs(roll_rad) > 0.5:
            raise ValueError(
                f"{TF_STATIC} puts {camera} {height_m:.2f} m over {base}, {np.degrees(pitch_rad):.0f} degrees nose "
                f"down and {np.degrees(roll_rad):.0f} right side down, which is not an optical frame (REP-103) on a car"
            )
        return GroundPlane(height_m, pitch_rad, roll_rad)


def _matrix(transform: Any) -> Transform:
    t, q = transform.translation, transform.rotation
    out = np.eye(4)
    if not np.isfinite([t.x, t.y, t.z, q.x, q.y, q.z, q.w]).all() or not any((q.x, q.y, q.z, q.w)):
        out[:] = np.nan  # not a rotation: `mount` rejects it
        return out
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = t.x, t.y, t.z
    return out
