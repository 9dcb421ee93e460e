"""Trajectory of an external odometry as a text file: TUM lines with times, or KITTI rows, one per frame.

TUM lines are `t[s] x y z qx qy qz qw` in the recording's clock (ORB-SLAM, evo); KITTI rows are (3, 4) row-major. Both
are metric: scale a monocular trajectory first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from birdslam.geometry.timed_poses import TimedPoses
from birdslam.sources.recording import DatasetError, Recording, check_times
from birdslam.trajectory import as_poses, read_kitti, read_tum
from birdslam.types import NS_PER_S

MIN_POSES = 2
_KITTI_NUMBERS = 12


def read_odometry(path: Path) -> TimedPoses:
    """Reads a trajectory; its first line selects the format.

    Raises DatasetError for an unreadable or truncated file and for times that do not increase.
    """
    try:
        rows = _count_columns(path) == _KITTI_NUMBERS
        if rows:
            trajectory = TimedPoses(as_poses(read_kitti(path)), None)
        else:
            t_s, poses = read_tum(path)
            if len(t_s) and not np.abs(t_s).max() < 9e9:  # ns since 1970 exceed int64 above this
                raise ValueError(f"{path}: its times are not in seconds: {t_s[np.abs(t_s).argmax()]:g}")
            trajectory = TimedPoses(poses, np.round(t_s * NS_PER_S).astype(np.int64))
    except ValueError as error:
        raise DatasetError(str(error)) from None
    if len(trajectory.poses) < MIN_POSES:
        raise DatasetError(f"{path}: has {len(trajectory.poses)} poses, needs {MIN_POSES}")
    if trajectory.t_ns is not None:
        back = np.flatnonzero(np.diff(trajectory.t_ns) <= 0)
        if back.size:
            raise DatasetError(f"{path}: pose {back[0] + 1} is not later than the previous one")
    return trajectory


def check_odometry(recording: Recording, path: Path, stride: int = 1) -> None:
    """Raises DatasetError if the file is not of this recording: too short, or times of another clock."""
    trajectory = read_odometry(path)
    if trajectory.t_ns is None:
        if stride != 1:
            raise DatasetError(f"{path}: has one row per frame, but the stride is {stride}; use TUM lines")
        if len(trajectory.poses) != len(recording):
            raise DatasetError(f"{path}: {len(trajectory.poses)} poses for {len(recording)} frames of {recording.name}")
        return
    check_times(recording, path, int(trajectory.t_ns[0]), int(trajectory.t_ns[-1]))


def _count_columns(path: Path) -> int:
    """Count of numbers in the first line that has any; 0: none, or unreadable (the readers report it)."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return 0
    return next((len(line.split()) for line in lines if line.strip() and not line.lstrip().startswith("#")), 0)
