"""Motion with a constant twist on the road plane.

A pose is a complex position x + iy and a complex heading e^(i yaw), so that composition is multiplication. All
functions take arrays of N bodies.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats

_MIN_RAD = 1e-20  # avoids 0 / 0 at zero turn, where sin w / w is 1


def advance(
    heading: Complexes, velocity: Complexes, turn_radps: Floats, dt_s: Floats
) -> tuple[Complexes, Complexes, Complexes, Complexes]:
    """Integrates constant twists over `dt_s` (N,) from poses with `heading` (N,).

    `velocity` (N,) in m/s is in body axes. Returns the displacement (N,) in m in the axes of the headings, the new
    headings (N,), and the partial derivatives of the displacement by the complex velocity and by `turn_radps`.
    """
    w = turn_radps * dt_s
    half = np.exp(0.5j * w)
    towards = heading * dt_s * half
    by_velocity = towards * _chord(w)
    by_turn = towards * velocity * dt_s * (0.5j - w / 12.0)
    return by_velocity * velocity, heading * half * half, by_velocity, by_turn


def rate(displacement: Complexes, yaw_rad: Floats, dt_s: Floats) -> tuple[Complexes, Floats]:
    """Velocities (m/s, body axes) and yaw rates (rad/s) that reach `displacement` and `yaw_rad` within `dt_s`."""
    return displacement / (np.exp(0.5j * yaw_rad) * _chord(yaw_rad) * dt_s), yaw_rad / dt_s


def _chord(w: Floats) -> Floats:
    """|e^iw - 1| / w: ratio of the chord to the arc."""
    half = np.abs(0.5 * w) + _MIN_RAD
    out: Floats = np.sin(half) / half
    return out
