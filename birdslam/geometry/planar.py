"""SE(2) on arrays: many poses at once, as (N, 3) of (x_m, y_m, yaw_rad). See se2.SE2."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats

_TAU = 2.0 * np.pi
_SMALL_RAD = 0.05  # below this the series are exact in double precision


def compose(a: Floats, b: Floats) -> Floats:
    """(..., 3) T_a_c = T_a_b @ T_b_c, rows `a` = T_a_b and `b` = T_b_c; yaw is not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    bx, by = b[..., 0], b[..., 1]
    out = a + b
    out[..., 0] = a[..., 0] + c * bx - s * by
    out[..., 1] = a[..., 1] + s * bx + c * by
    return out


def between(a: Floats, b: Floats) -> Floats:
    """(..., 3) inverse of `a` composed with `b`; yaw in [-pi, pi)."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out = b - a
    dx, dy = out[..., 0].copy(), out[..., 1].copy()
    out[..., 0] = c * dx + s * dy
    out[..., 1] = c * dy - s * dx
    out[..., 2] = (out[..., 2] + np.pi) % _TAU - np.pi
    return out


def exp(xi: Floats) -> Floats:
    """(N, 3) poses after unit time of the twists `xi` (N, 3)."""
    vx, vy, w = xi.T
    w2 = w * w
    if w2.max(initial=0.0) < _SMALL_RAD**2:
        a, b = 1.0 + w2 * (w2 / 120.0 - 1.0 / 6.0), w * (0.5 + w2 * (w2 / 720.0 - 1.0 / 24.0))
    else:
        a, b = np.sinc(w / np.pi), w / 2.0 * np.square(np.sinc(w / _TAU))
    out = xi.copy()
    out[:, 0] = a * vx - b * vy
    out[:, 1] = b * vx + a * vy
    return out


def log(pose: Floats) -> Floats:
    """(N, 3) twists whose `exp` are the poses (N, 3)."""
    x, y, w = pose.T
    half = 0.5 * w
    h2 = half * half
    if h2.max(initial=0.0) < _SMALL_RAD**2:  # half / tan half
        a = 1.0 - h2 * (1.0 / 3.0 + h2 * (1.0 / 45.0 + h2 * (2.0 / 945.0)))
    else:
        a = np.cos(half) / np.sinc(half / np.pi)
    out = pose.copy()
    out[:, 0] = a * x + half * y
    out[:, 1] = a * y - half * x
    return out
