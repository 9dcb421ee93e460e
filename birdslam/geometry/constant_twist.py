"""Motion with a constant twist on the road plane, one body at a time.

A pose is its position x + iy and its heading e^(i yaw) as Python complex numbers, so that composing is multiplying. For
a handful of bodies this is faster than numpy.
"""

from __future__ import annotations

import cmath
import math

_SMALL_RAD = 0.05  # below it the series is exact to the last digit


def advance(
    heading: complex, velocity: complex, turn_radps: float, dt_s: float
) -> tuple[complex, complex, complex, complex]:
    """A pose with `heading` drives for `dt_s` with a constant twist: how far (m), and with which heading then.

    `velocity` (m/s) is in the body's own axes, the way in those in which the heading is given. Beside it how errors of
    the velocity and of the turn move the end of the way: its partial derivatives by the complex velocity and by
    `turn_radps`.
    """
    w = turn_radps * dt_s
    half = cmath.rect(1.0, 0.5 * w)
    towards = heading * dt_s
    by_velocity = towards * chord(w, half)
    by_turn = towards * half * velocity * dt_s * complex(-w / 12.0, 0.5)
    return by_velocity * velocity, heading * half * half, by_velocity, by_turn


def rate(way: complex, yaw_rad: float, dt_s: float) -> tuple[complex, float]:
    """The twist that takes `dt_s` to come to the pose (`way`, `yaw_rad`): velocity (m/s) and yaw rate."""
    return way / (chord(yaw_rad, cmath.rect(1.0, 0.5 * yaw_rad)) * dt_s), yaw_rad / dt_s


def chord(w: float, half: complex) -> complex:
    """(e^iw - 1) / iw, given `half` = e^(iw / 2)."""
    w2 = w * w
    if w2 < _SMALL_RAD * _SMALL_RAD:
        return half * (1.0 - w2 * (1.0 / 24.0 - w2 / 1920.0))
    return half * (math.sin(0.5 * w) / (0.5 * w))
