"""SE(2) on arrays: many poses at once, as (N, 3) of (x_m, y_m, yaw_rad), or as complex numbers. See se2.SE2.

As complex numbers a pose is its position x + iy and its heading e^(i yaw), and composing is multiplying.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_TAU = 2.0 * np.pi
_SMALL_RAD = 0.05  # below it the series are exact to the last digit


def compose(a: Floats, b: Floats) -> Floats:
    """(..., 3) poses: T_a_b of each row of `a`, applied to the poses of `b`; yaw is not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    bx, by = b[..., 0], b[..., 1]
    out = a + b
    out[..., 0] = a[..., 0] + c * bx - s * by
    out[..., 1] = a[..., 1] + s * bx + c * by
    return out


def between(a: Floats, b: Floats) -> Floats:
    """(..., 3): the inverse of `a` composed with `b`; yaw in [-pi, pi)."""
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


def advance(
    heading: Complexes, velocity: Complexes, turn_radps: Floats, dt_s: Floats
) -> tuple[Complexes, Complexes, Complexes]:
    """Poses with `heading` (N,) drive for `dt_s` (N,) with constant twists (N,): how far, with which heading then.

    Beside it (N, 6) how errors of (x_m, y_m, yaw_rad) of the pose and (x_mps, y_mps, yaw_radps) of the twist, all but
    the twist's velocity in the axes in which the heading is told, move the place behind: the partial derivatives of
    its x + iy. Those of its yaw are 1 of the yaw and `dt_s` of the twist's.
    """
    w = turn_radps * dt_s
    half = np.exp(0.5j * w)
    chord = _chord(w, half)
    towards = heading * dt_s
    g = towards * chord
    way = g * velocity
    partial = np.empty((len(w), 6), dtype=np.complex128)
    partial[:, 0] = 1.0
    partial[:, 1] = 1j
    partial[:, 2] = 1j * way
    partial[:, 3] = g
    np.multiply(g, 1j, out=partial[:, 4])
    partial[:, 5] = towards * half * velocity * dt_s * (0.5j - w / 12.0)
    return way, heading * half * half, partial


def rates(poses: Floats, dt_s: Floats) -> tuple[Complexes, Floats]:
    """The twists (N,) that take `dt_s` (N,) to come to the poses (N, 3): velocity and yaw rate."""
    w = poses[:, 2]
    return (poses[:, 0] + 1j * poses[:, 1]) / (_chord(w, np.exp(0.5j * w)) * dt_s), w / dt_s


def _chord(w: Floats, half: Complexes) -> Complexes:
    """(e^iw - 1) / iw, given `half` = e^(iw / 2)."""
    w2 = w * w
    if w2.max(initial=0.0) < _SMALL_RAD**2:
        return half * (1.0 - w2 * (1.0 / 24.0 - w2 / 1920.0))
    out: Complexes = half * np.sinc(w / _TAU)
    return out


def pairs(partial: Complexes) -> Floats:
    """(N, 2, k) view of complex (N, k): the real parts above the imaginary ones."""
    return partial.view(np.float64).reshape(*partial.shape, 2).transpose(0, 2, 1)


def turned(covs: Floats, heading: Complexes) -> Floats:
    """(N, 3, 3) covariances (N, 3, 3) of (x_m, y_m, yaw_rad) in axes that point to `heading` (N,), told outside."""
    R = np.zeros((len(heading), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = heading.real
    R[:, 1, 0] = heading.imag
    R[:, 0, 1] = -heading.imag
    R[:, 2, 2] = 1.0
    return R @ covs @ R.transpose(0, 2, 1)


def unit(yaw_rad: Floats) -> Complexes:
    """e^(i yaw), elementwise."""
    out: Complexes = np.exp(1j * yaw_rad)
    return out
