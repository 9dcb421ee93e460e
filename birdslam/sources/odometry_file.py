"""Another odometry's trajectory of a recording, as a text file: TUM lines with times, or KITTI rows, one a frame.

TUM lines are `t[s] x y z qx qy qz qw` by the recording's clock, what ORB-SLAM and evo write; KITTI rows are (3, 4)
row-major. Both are metric: a monocular SLAM's has to be scaled before.
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
    """The trajectory of a file; which of the two it is, its first line says.

    Raises DatasetError for a file that can't be read or is torn, and for times that do not grow.
    """
    try:
        rows = _width(path) == _KITTI_NUMBERS
        if rows:
            trajectory = TimedPoses(as_poses(read_kitti(path)), None)
        else:
            t_s, poses = read_tum(path)
            if len(t_s) and not np.abs(t_s).max() < 9e9:  # a time in ns has 63 bits
                raise ValueError(f"{path}: its times are none in seconds: {t_s[np.abs(t_s).argmax()]:g}")
            trajectory = TimedPoses(poses, np.round(t_s * NS_PER_S).astype(np.int64))
    except ValueError as error:
        raise DatasetError(str(error)) from None
    if len(trajectory.poses) < MIN_POSES:
        raise DatasetError(f"{path}: holds {len(trajectory.poses)} poses, {MIN_POSES} are needed")
    if trajectory.t_ns is not None:
        back = np.flatnonzero(np.diff(trajectory.t_ns) <= 0)
        if back.size:
            raise DatasetError(f"{path}: pose {back[0] + 1} is not later than the one before it")
    return trajectory


def check_odometry(recording: Recording, path: Path, stride: int = 1) -> None:
    """Raises DatasetError where the file can't be of this recording: too short, or its times are of another clock."""
    trajectory = read_odometry(path)
    if trajectory.t_ns is None:
        if stride != 1:
            raise DatasetError(f"{path}: has a row for each frame, and every {stride}th is driven: give TUM lines")
        if len(trajectory.poses) != len(recording):
            raise DatasetError(f"{path}: {len(trajectory.poses)} poses for {len(recording)} frames of {recording.name}")
        return
    check_times(recording, path, int(trajectory.t_ns[0]), int(trajectory.t_ns[-1]))


def _width(path: Path) -> int:
    """Numbers in the first line that holds any; 0: none does, or it can't be read (which the readers report)."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return 0
    return next((len(line.split()) for line in lines if line.strip() and not line.lstrip().startswith("#")), 0)
