"""Trajectory files (KITTI rows, TUM lines), and conversion between ego and camera poses.

KITTI rows are `T_first_i` (3, 4) row-major in the axes of the first camera, TUM lines `t[s] x y z qx qy qz qw` in the
world of `types.py`. The camera is mounted on the ego at a constant `mount` (calibrated height, pitch and roll):

    T_world_cam = T(x, y, z; Rz(yaw) Ry(pitch) Rx(roll)) @ T_ego_cam(mount)

The attitude includes the car's pitching. A wrong mount tilts the world but does not change the camera's trajectory.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.types import NS_PER_S, Attitude

Transform = Floats  # (..., 4, 4) homogeneous, metres; one or many


def ego_pose(T_world_ego: SE2, attitude: Attitude) -> Transform:
    """`T_world_ego` (4, 4) of a planar pose and its attitude."""
    from scipy.spatial.transform import Rotation  # imported late: few processes need it

    out = np.eye(4)
    angles = [T_world_ego.yaw_rad, attitude.pitch_rad, attitude.roll_rad]
    out[:3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    out[:3, 3] = T_world_ego.x_m, T_world_ego.y_m, attitude.z_m
    return out


def split_pose(T_world_ego: Transform) -> tuple[SE2, Attitude]:
    """The inverse of `ego_pose`, for a pitch below a quarter turn."""
    R, (x_m, y_m, z_m) = T_world_ego[:3, :3], T_world_ego[:3, 3]
    yaw_rad = math.atan2(R[1, 0], R[0, 0])
    pitch_rad = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    roll_rad = math.atan2(R[2, 1], R[2, 2])
    return SE2(float(x_m), float(y_m), yaw_rad), Attitude(z_m=float(z_m), pitch_rad=pitch_rad, roll_rad=roll_rad)


def mount_pose(mount: GroundPlane) -> Transform:
    """`T_ego_cam` (4, 4) of a camera over the road."""
    out = np.eye(4)
    out[:3, :3] = mount.R_ego_cam
    out[2, 3] = mount.height_m
    return out


def inverse(T_a_b: Transform) -> Transform:
    """`T_b_a` of poses (..., 4, 4)."""
    out = np.zeros_like(T_a_b)
    Rt = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", Rt, T_a_b[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def as_poses(rows: Floats) -> Transform:
    """Converts KITTI rows (N, 3, 4) to (N, 4, 4)."""
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3] = rows
    return out


def kitti_row(T_first_i: Transform) -> str:
    """One line of a KITTI pose file, without the newline."""
    return " ".join(f"{number:.9e}" for number in (T_first_i[:3] + 0.0).ravel())  # + 0.0 removes negative zeros


def tum_row(t_ns: int, T_world_i: Transform) -> str:
    """One line of a TUM trajectory, without the newline; the time is exact to the nanosecond, qw >= 0."""
    from scipy.spatial.transform import Rotation  # imported late: few processes need it

    qx, qy, qz, qw = Rotation.from_matrix(T_world_i[:3, :3]).as_quat(canonical=True)
    numbers = " ".join(f"{number + 0.0:.9f}" for number in (*T_world_i[:3, 3], qx, qy, qz, qw))
    sign, t_ns = ("-", -t_ns) if t_ns < 0 else ("", t_ns)
    return f"{sign}{t_ns // NS_PER_S}.{t_ns % NS_PER_S:09d} {numbers}"


def _read_numbers(path: Path, width: int, what: str) -> Floats:
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not a text file of {what}") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != width or not all(map(math.isfinite, row)):
            raise ValueError(f"{path}: line {number} is not a {what} ({width} finite numbers): {line[:60]!r}")
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(len(rows), width)


def read_kitti(path: Path) -> Floats:
    """Rows (N, 3, 4) of a KITTI pose file. Raises ValueError naming path and line."""
    rows = _read_numbers(path, 12, "KITTI pose").reshape(-1, 3, 4)
    R = rows[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers make nan
        error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
        wrong = np.flatnonzero(~((error <= 1e-3) & (np.linalg.det(R) > 0.0)))
    if wrong.size:
        raise ValueError(f"{path}: pose {wrong[0]} has no valid rotation matrix")
    return rows


def read_tum(path: Path) -> tuple[Floats, Transform]:
    """Times (N,) in seconds and poses (N, 4, 4) of a TUM file, comments skipped. Raises ValueError naming the line."""
    from scipy.spatial.transform import Rotation  # imported late: few processes need it

    rows = _read_numbers(path, 8, "TUM pose")
    with np.errstate(over="ignore"):
        wrong = np.flatnonzero(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0) > 1e-3)
    if wrong.size:
        raise ValueError(f"{path}: pose {wrong[0]} has no unit quaternion")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
        poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


class JoinedTrajectory:
    """Joins the poses of all epochs in the axes of the first: a new epoch continues at the last pose.

    Each epoch has its own world; the motion between two epochs is unknown.
    """

    def __init__(self, start: Transform | None = None) -> None:
        """`start`: the first pose; None: the first pose of the first epoch."""
        self._start = start
        self._epoch: int | None = None
        self.T_first_world: Transform = np.eye(4)  # of the present epoch

    @property
    def last(self) -> Transform:
        """The newest pose (4, 4)."""
        return np.eye(4) if self._start is None else self._start

    def add(self, epoch: int, T_world_i: Transform) -> Transform:
        """Returns the next pose (4, 4) in the axes of the first epoch."""
        if epoch == self._epoch:
            self._start = self.T_first_world @ T_world_i
        elif self._start is None:
            self._start = T_world_i
        else:
            self.T_first_world = self._start @ inverse(T_world_i)
        self._epoch = epoch
        return self._start


class CameraTrajectory:
    """Converts ego poses, frame by frame, to camera poses in the axes of the first camera (KITTI)."""

    def __init__(self, mount: GroundPlane) -> None:
        self._T_ego_cam = mount_pose(mount)
        self._joined = JoinedTrajectory(start=np.eye(4))

    @property
    def last(self) -> Transform:
        """The newest camera pose (4, 4)."""
        return self._joined.last

    def add(self, epoch: int, T_world_ego: Transform) -> Transform:
        """Returns `T_first_i` (4, 4) of the next frame's `ego_pose`."""
        return self._joined.add(epoch, T_world_ego @ self._T_ego_cam)
