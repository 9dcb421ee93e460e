"""Rigid motions in space, SE(3): rotation matrices, rotation vectors, `Pose`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats


def rotation_exp(w: Floats) -> Floats:
    """(3, 3) rotation matrix of the rotation vector w (3,) in radians (Rodrigues)."""
    x, y, z = w.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    # I + a S + b S^2 with S = skew(w), S^2 = w w^T - angle^2 I
    a, b = (1.0, 0.5) if angle < 1e-8 else (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2)
    c = 1.0 - b * angle * angle
    return np.array(
        [
            [c + b * x * x, b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, c + b * y * y, b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, c + b * z * z],
        ]
    )


def rotation_log(R: Floats) -> Floats:
    """(3,) rotation vector in radians of a rotation by less than pi."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt(axis @ axis))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))
    return axis if sine < 1e-9 else axis * (angle / sine)


def orthonormal(R: Floats) -> Floats:
    """Projects nearly orthonormal matrices (..., 3, 3) to the nearest rotations.

    One Newton step for the polar factor; convergence is quadratic.
    """
    out: Floats = 1.5 * R - 0.5 * R @ np.swapaxes(R, -1, -2) @ R
    return out


@dataclass(frozen=True)
class Pose:
    """T_w_c: transforms camera points to the window frame, p_w = R p_c + p."""

    R: Floats  # (3, 3)
    p: Floats  # (3,)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R @ other.R, self.R @ other.p + self.p)

    def inverse(self) -> Pose:
        return Pose(self.R.T, -(self.R.T @ self.p))

    def between(self, other: Pose) -> Pose:
        """T_self_other."""
        return Pose(self.R.T @ other.R, self.R.T @ (other.p - self.p))

    def moved(self, step: Floats) -> Pose:
        """The pose after a step (6,) = (translation, rotation vector) in the camera's axes."""
        return Pose(self.R @ rotation_exp(step[3:]), self.p + self.R @ step[:3])
