"""The group SE(2): rigid motions of the road plane.

`T_a_b` takes points of frame b to frame a, so `T_a_c = T_a_b @ T_b_c` and `p_a = T_a_b @ p_b`.
Axes follow REP-103: x forward, y left, yaw counter-clockwise.
"""

from __future__ import annotations

import math
from typing import overload

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats

_SMALL_ANGLE_RAD = 1e-9  # below this the first order is exact in double precision


def wrap(angle_rad: float) -> float:
    """Wraps an angle to [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


class SE2(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A pose or motion on the road plane; serialized as `[x_m, y_m, yaw_rad]`.

    Raises ValueError (on decoding: msgspec.ValidationError) for a number that is not finite.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.x_m + self.y_m + self.yaw_rad):
            raise ValueError(f"SE2 needs finite numbers, got {self.x_m}, {self.y_m}, {self.yaw_rad}")

    @overload
    def __matmul__(self, other: SE2) -> SE2: ...
    @overload
    def __matmul__(self, other: Floats) -> Floats: ...
    def __matmul__(self, other: SE2 | Floats) -> SE2 | Floats:
        """`T_a_b @ T_b_c -> T_a_c`; `T_a_b @ p_b -> p_a` for points (..., 2) in metres."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        if isinstance(other, SE2):
            return SE2(
                self.x_m + c * other.x_m - s * other.y_m,
                self.y_m + s * other.x_m + c * other.y_m,
                wrap(self.yaw_rad + other.yaw_rad),
            )
        points = np.asarray(other, dtype=np.float64)
        x, y = points[..., 0], points[..., 1]
        out = np.empty(points.shape)
        out[..., 0] = self.x_m + c * x - s * y
        out[..., 1] = self.y_m + s * x + c * y
        return out

    def inverse(self) -> SE2:
        """`T_b_a` of this `T_a_b`."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return SE2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap(-self.yaw_rad))

    def scaled(self, factor: float) -> SE2:
        """The pose with its translation multiplied by `factor`."""
        return SE2(factor * self.x_m, factor * self.y_m, self.yaw_rad)

    def between(self, other: SE2) -> SE2:
        """`T_a_b` of `self = T_w_a` and `other = T_w_b`."""
        return self.inverse() @ other

    @staticmethod
    def exp(xi: Floats) -> SE2:
        """The motion by the constant twist `xi` = (x_m, y_m, yaw_rad) over unit time."""
        vx, vy, w = (float(v) for v in xi)
        if abs(w) < _SMALL_ANGLE_RAD:
            a, b = 1.0, w / 2.0
        else:
            a, b = math.sin(w) / w, 2.0 * math.sin(w / 2.0) ** 2 / w  # 1 - cos w would lose digits
        return SE2(a * vx - b * vy, b * vx + a * vy, wrap(w))

    def log(self) -> Floats:
        """The twist (3,) in (m, m, rad) whose `exp` is this motion; yaw in [-pi, pi)."""
        w = wrap(self.yaw_rad)
        half = w / 2.0
        a = 1.0 if abs(w) < _SMALL_ANGLE_RAD else half / math.tan(half)
        return np.array([a * self.x_m + half * self.y_m, -half * self.x_m + a * self.y_m, w])

    def adjoint(self) -> Floats:
        """(3, 3) adjoint: transforms a twist of frame b to frame a, `T @ exp(xi) == exp(Ad xi) @ T`."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, -s, self.y_m], [s, c, -self.x_m], [0.0, 0.0, 1.0]])

    def rotation(self) -> Floats:
        """(2, 2) rotation part of `T_a_b`, from b to a."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, -s], [s, c]])

    def matrix(self) -> Floats:
        """(3, 3) homogeneous matrix."""
        out = np.eye(3)
        out[:2, :2] = self.rotation()
        out[:2, 2] = self.x_m, self.y_m
        return out
