"""Rigid motions in space, as the image odometry needs them: rotations as matrices and as vectors, and `Pose`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def skew(v: Floats) -> Floats:
    """(..., 3, 3) with skew(v) @ x = v x x, of (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: Floats, b: Floats) -> Floats:
    """(..., 3) a x b, without the overhead of numpy.cross."""
    a, b = np.broadcast_arrays(a, b)
    out = np.empty(a.shape)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def rotation_exp(w: Floats) -> Floats:
    """(3, 3) rotation by the vector w (3,) in radians (Rodrigues)."""
    angle = float(np.sqrt(w @ w))
    S = skew(w)
    if angle < 1e-8:
        return np.eye(3) + S + 0.5 * S @ S
    out: Floats = np.eye(3) + np.sin(angle) / angle * S + (1.0 - np.cos(angle)) / angle**2 * (S @ S)
    return out


def rotation_log(R: Floats) -> Floats:
    """(3,) rotation vector in radians of a rotation of less than half a turn."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.sqrt(axis @ axis))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(R) - 1.0)))
    return axis if sine < 1e-9 else axis * (angle / sine)


def orthonormal(R: Floats) -> Floats:
    """The nearest rotation: products of many rotations stay rotations."""
    U, _, Vt = np.linalg.svd(R)
    out: Floats = U @ Vt
    return out


@dataclass(frozen=True)
class Pose:
    """T_w_c: takes camera points to the window's frame, p_w = R p_c + p."""

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
        """By a step (6,) = (translation, rotation vector) in the camera's own axes."""
        return Pose(self.R @ rotation_exp(step[3:]), self.p + self.R @ step[:3])
