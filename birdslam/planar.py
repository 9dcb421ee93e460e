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
    half = w / 2.0
    a = np.cos(half) / np.sinc(half / np.pi)
    return np.stack([a * x + half * y, a * y - half * x, w], axis=1)


def advance(velocity: Complexes, turn_radps: Floats, dt_s: Floats) -> tuple[Complexes, Complexes, Floats, Floats]:
    """The motion of constant twists (N,) over `dt_s` (N,), position and heading, and how errors come through it.

    An error e of the pose before and d of the twist are `turn` e + `push` d, (N, 3, 3) each, of the pose behind:
    `turn` is the adjoint of the motion's inverse, `push` dt times the right Jacobian 1 - ad / 2 + ad^2 / 6.
    """
    w, step = turn_radps * dt_s, velocity * dt_s
    iw = 1j * w
    heading = np.exp(iw)
    if np.abs(w).max(initial=0.0) < _SMALL_RAD:
        at = step * (1.0 + iw * (1.0 / 2.0 + iw * (1.0 / 6.0 + iw * (1.0 / 24.0 + iw / 120.0))))
    else:  # (e^iw - 1) / iw
        at = step * np.exp(0.5 * iw) * np.sinc(w / (2.0 * np.pi))
    push = np.zeros((len(w), 3, 3))
    push[:, 0, 0] = push[:, 1, 1] = dt_s - dt_s * w * w / 6.0
    half = 0.5 * dt_s * w
    push[:, 0, 1] = half
    push[:, 1, 0] = -half
    bend = step * dt_s * (w / 6.0 + 0.5j)
    push[:, 0, 2] = bend.real
    push[:, 1, 2] = bend.imag
    push[:, 2, 2] = dt_s
    return at, heading, inverse_adjoint(at, heading), push


def inverse_adjoint(at: Complexes, heading: Complexes) -> Floats:
    """(N, 3, 3): Ad of the inverses of the poses; moves a tangent over the pose to its far side."""
    out = np.zeros((len(at), 3, 3))
    back = heading.conj()
    lever = at * back
    out[:, 0, 0] = out[:, 1, 1] = back.real
    out[:, 0, 1] = heading.imag
    out[:, 1, 0] = back.imag
    out[:, 0, 2] = -lever.imag
    out[:, 1, 2] = lever.real
    out[:, 2, 2] = 1.0
    return out


def gaps(out: Floats, measured: Floats, at: Complexes, heading: Complexes, turned: Complexes) -> None:
    """To `out` (3N,): poses `measured` (N, 3) seen from the poses `at`, `heading`, which they are `turned` against."""
    gap = (measured[:, 0] + 1j * measured[:, 1] - at) * heading.conj()
    out[0::3] = gap.real
    out[1::3] = gap.imag
    np.arctan2(turned.imag, turned.real, out=out[2::3])
