"""Motion of road users: stationary, along a direction of travel, or in any direction.

Interacting multiple model (Blom and Bar-Shalom 1988): before each prediction the filters of one size are mixed by the
transition probabilities of the motions.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.road_users.models.user_state import (
    KINEMATIC,
    MOTIONS,
    STATES,
    STATIONARY,
    VELOCITY,
    VX,
    VY,
    X,
    Y,
    merge_mixture,
)

_RESTARTS = np.zeros((len(MOTIONS), len(MOTIONS)), dtype=np.bool_)  # to, from: the velocity is that of a new motion
_RESTARTS[STATIONARY, STATIONARY + 1 :] = _RESTARTS[STATIONARY + 1 :, STATIONARY] = True


def initial_velocities(motions: Floats, direction_rad: Floats) -> tuple[Floats, Floats]:
    """Means (N, 4, 2) and covariances (N, 4, 2, 2), in world, of the initial velocities of `motions` (N, 4, 5)."""
    speed, along, across = np.moveaxis(motions[..., :3], -1, 0)
    heading = np.stack([np.cos(direction_rad), np.sin(direction_rad)], axis=-1)
    return speed[..., None] * heading[:, None], rotate(along, across, direction_rad)


def rotate(along: Floats, across: Floats, direction_rad: Floats) -> Floats:
    """(N, 4, 2, 2) covariances in world from 1-sigmas (N, 4) along and across directions (N,)."""
    c, s = np.cos(direction_rad)[:, None], np.sin(direction_rad)[:, None]
    a, b = np.square(along), np.square(across)
    xy = c * s * (a - b)
    return np.stack([np.stack([c * c * a + s * s * b, xy], -1), np.stack([xy, s * s * a + c * c * b], -1)], -2)


def transitions(per_s: Floats, dt_s: float) -> Floats:
    """(N, 4, 4) probabilities from and to, within `dt_s`, of rates `per_s` (N, 4, 4)."""
    out_of = per_s.sum(axis=2)
    leaves = -np.expm1(-out_of * dt_s)
    out: Floats = per_s * (leaves / np.maximum(out_of, 1e-12))[..., None]
    return out + (1.0 - leaves)[..., None] * np.eye(len(MOTIONS))


def mix_motions(
    x: Floats, P: Floats, weight: Floats, change: Floats, motions: Floats, direction_rad: Floats
) -> tuple[Floats, Floats, Floats]:
    """States (N, K, S), covariances and weights after changes of motion by probabilities `change` (N, 4, 4).

    A starting or stopping road user gets the initial velocity of the new motion. Sizes do not mix.
    """
    n, m = len(x), len(MOTIONS)
    sources = np.repeat(x.reshape(n, -1, 1, m, len(STATES)), m, axis=2)  # size, to, from
    spreads = np.repeat(P.reshape(n, -1, 1, m, len(STATES), len(STATES)), m, axis=2)
    mean, cov = initial_velocities(motions, direction_rad)
    spreads[:, :, _RESTARTS, VELOCITY] = 0.0
    spreads[:, :, _RESTARTS, :, VELOCITY] = 0.0
    for to in MOTIONS:
        sources[:, :, to, _RESTARTS[to], VELOCITY] = mean[:, None, to, None]
        spreads[:, :, to, _RESTARTS[to], VELOCITY, VELOCITY] = cov[:, None, to, None]
    by_source = weight.reshape(n, -1, 1, m) * change.swapaxes(1, 2)[:, None]
    total = np.maximum(by_source.sum(axis=-1), 1e-300)
    mixed_x, mixed_P = merge_mixture(sources, spreads, by_source / total[..., None])
    total = total.reshape(weight.shape)
    return mixed_x.reshape(x.shape), mixed_P.reshape(P.shape), total / total.sum(axis=1, keepdims=True)


def predict_motion(x: Floats, P: Floats, motions: Floats, direction_rad: Floats, dt_s: float) -> tuple[Floats, Floats]:
    """States (N, K, S), covariances after `dt_s` of constant velocity, with the noise of the motions (N, 4, 5)."""
    F = np.eye(len(STATES))
    F[X, VX] = F[Y, VY] = dt_s
    x, P = x @ F.T, F @ P @ F.T
    of_velocity = rotate(motions[..., 3], motions[..., 4], direction_rad)
    in_time = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    noise = (in_time[:, None, :, None] * of_velocity[:, :, None, :, None, :]).reshape(*of_velocity.shape[:2], 4, 4)
    P[..., KINEMATIC, KINEMATIC] += np.tile(noise, (1, x.shape[1] // len(MOTIONS), 1, 1))
    return x, P
