"""Motion with a constant twist on the road plane.

A pose is its position x + iy and its heading e^(i yaw), so that composing is multiplying: complex numbers, or arrays of
them for many bodies at once.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats

_MIN_RAD = 1e-20  # in the place of no turn, for which sin w / w is 1


def advance(
    heading: Complexes, velocity: Complexes, turn_radps: Floats, dt_s: Floats
) -> tuple[Complexes, Complexes, Complexes, Complexes]:
    """Poses with `heading` (N,) drive for `dt_s` (N,) with constant twists: how far (m), and with which heading then.

    `velocity` (m/s) is in the bodies' own axes, the ways in those in which the headings are given. Beside them how
    errors of the velocity and of the turn move the end of the way: its partial derivatives by the complex velocity and
    by `turn_radps`.
    """
    w = turn_radps * dt_s
    half = np.exp(0.5j * w)
    towards = heading * dt_s * half
    by_velocity = towards * _chord(w)
    by_turn = towards * velocity * dt_s * (0.5j - w / 12.0)
    return by_velocity * velocity, heading * half * half, by_velocity, by_turn


def rate(way: Complexes, yaw_rad: Floats, dt_s: Floats) -> tuple[Complexes, Floats]:
    """The twists that take `dt_s` to come to the poses (`way`, `yaw_rad`): velocities (m/s) and yaw rates."""
    return way / (np.exp(0.5j * yaw_rad) * _chord(yaw_rad) * dt_s), yaw_rad / dt_s


def _chord(w: Floats) -> Floats:
    """|e^iw - 1| / w: how much shorter the way is than along its arc."""
    half = np.abs(0.5 * w) + _MIN_RAD
    out: Floats = np.sin(half) / half
    return out
