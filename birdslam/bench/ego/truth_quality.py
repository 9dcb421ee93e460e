"""The quality of a recording's true poses, frame by frame, judged by the poses alone.

KITTI's poses have four weaknesses that an odometry's error must not be taken for: over the first images of a sequence
they are interpolated (a constant twist: no road lets a camera turn so evenly), GPS/IMU samples lie up to 10 ms beside
the images (every third step of tracking 0005 is a tenth too long), poses by LiDAR scatter by centimetres, and their
axes are turned against the way for a whole drive: a camera that is fixed to a car can't be.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import Transform, inverse, mount_pose, split_pose

# Changes of a step's rotation below it, so many in a row, are no car's: KITTI 00 and 06 have 0.000005 rad over their
# first 13 and 11 images and 0.0001 to 0.005 after them, as all other sequences and the built-in world do throughout
_EVEN_RAD, _EVEN_STEPS = 3e-5, 4
_DRIVES_M = 0.05  # in one step: a standing camera turns evenly as well
ACCELERATION_MPS2 = 15.0  # no car changes its speed faster
# 1-sigma of the angle from the axes of GPS/IMU poses to the direction of travel, which differs between drives
AXES_SIGMA_RAD = 0.006


def steps(poses: Transform, mount: GroundPlane) -> list[SE2]:
    """The N - 1 motions of the ego on the road between poses (N, 4, 4) of a camera at `mount`."""
    T = mount_pose(mount)
    return [split_pose(T @ step @ inverse(T))[0] for step in inverse(poses[:-1]) @ poses[1:]]


def interpolated(poses: Transform) -> Bools:
    """(N,) the frames whose step from the one before is no measurement, but one twist that goes on."""
    out = np.zeros(len(poses), bool)
    if len(poses) < _EVEN_STEPS + 1:
        return out
    step = inverse(poses[:-1]) @ poses[1:]
    turned = Rotation.from_matrix(step[:, :3, :3]).as_rotvec()
    drives = np.linalg.norm(step[:, :3, 3], axis=1) > _DRIVES_M
    even = (np.linalg.norm(np.diff(turned, axis=0), axis=1) < _EVEN_RAD) & drives[1:] & drives[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], even, [False]])))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        if end - first >= _EVEN_STEPS:
            out[first + 1 : end + 2] = True
    return out


def step_noise(poses: Transform, mount: GroundPlane) -> Floats:
    """(3,) 1-sigma of the truth of one step, as the tangent (x_m, y_m, yaw_rad): from second differences of the steps.

    White noise makes sqrt(6) of itself of them, a car's own jerk a millimetre at 10 Hz. Zeros where there are too few.
    Interpolated frames are left out, and of the root mean square and the median's estimate the smaller one counts, so
    that outliers don't speak for the rest.
    """
    twists = np.array([step.log() for step in steps(poses, mount)]).reshape(-1, 3)
    measured = ~interpolated(poses)[1:]
    whole = measured[:-2] & measured[1:-1] & measured[2:]
    jerks = np.diff(twists, 2, axis=0)[whole]
    if len(jerks) < 8:
        return np.zeros(3)
    out: Floats = np.minimum(np.sqrt(np.mean(jerks**2, axis=0)), 1.4826 * np.median(np.abs(jerks), axis=0))
    return out / np.sqrt(6.0)


def implausible(poses: Transform, t_ns: Ints) -> Bools:
    """(N,) the frames whose step, against the one before or after, is an acceleration that no car has."""
    out = np.zeros(len(poses), bool)
    if len(poses) < 3:
        return out
    dt_s = np.maximum(np.diff(t_ns) * 1e-9, 1e-3)
    speed_mps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / dt_s
    jumps = np.abs(np.diff(speed_mps)) > ACCELERATION_MPS2 * 0.5 * (dt_s[1:] + dt_s[:-1])
    out[1:-1] |= jumps
    out[2:] |= jumps
    return out


def doubtful(poses: Transform, t_ns: Ints) -> Bools:
    """(N,) the frames whose step is interpolated or implausible."""
    return interpolated(poses) | implausible(poses, t_ns)
