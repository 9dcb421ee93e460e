"""Motion model of people: standing, along the road, or in any direction.

Interacting multiple model (Blom and Bar-Shalom 1988) for two heights each, adult and child.
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.road_users.people.people_config import (
    CROSSING_RATIO,
    MOVES_FOR_S,
    STANDING_RATIO,
    STANDS_FOR_S,
    STOP_MPS,
    TURNS_AFTER_S,
    Sizes,
)
from birdslam.road_users.people.people_state import (
    FILTERS,
    MOTIONS,
    STATES,
    STATIONARY,
    STATIONARY_FILTERS,
    VELOCITY,
    VX,
    VY,
    X,
    Y,
    merge_mixture,
)


def motion_priors() -> Floats:
    """(4,) probabilities of the motions at the first observation."""
    along = (1.0 - STANDING_RATIO) * (1.0 - CROSSING_RATIO) / 2.0
    return np.array([STANDING_RATIO, along, along, (1.0 - STANDING_RATIO) * CROSSING_RATIO])


def motion_parameters(sizes: Sizes) -> Floats:
    """(4, 3) of each motion: speed along the road (m/s), its 1-sigma, and 1-sigma across the road."""
    return np.array(
        [
            (0.0, STOP_MPS, STOP_MPS),
            (-sizes.along_mps, sizes.sigma_along_mps, sizes.sigma_beside_mps),
            (sizes.along_mps, sizes.sigma_along_mps, sizes.sigma_beside_mps),
            (0.0, sizes.crossing_mps, sizes.crossing_mps),
        ]
    )


def initial_velocities(motions: Floats, road_rad: float) -> tuple[Floats, Floats]:
    """Means (N, 4, 2) and covariances (N, 4, 2, 2) of the initial velocities of `motions` (N, 4, 3), in world."""
    c, s = math.cos(road_rad), math.sin(road_rad)
    R = np.array([[c, -s], [s, c]])
    speed, along, beside = np.moveaxis(motions, -1, 0)
    D = np.zeros((*speed.shape, 2, 2))
    D[..., 0, 0], D[..., 1, 1] = along**2, beside**2
    return speed[..., None] * R[:, 0], R @ D @ R.T


def mix_motions(
    x: Floats, P: Floats, weight: Floats, motions: Floats, dt_s: float, road_rad: float
) -> tuple[Floats, Floats, Floats]:
    """States (N, 8, S), covariances and weights after changes of motion (mixing step of an IMM).

    A starting or stopping person gets the initial velocity of the new motion.
    """
    n, m = len(x), len(MOTIONS)
    start, stop, turn = (-math.expm1(-dt_s / s) for s in (STANDS_FOR_S, MOVES_FOR_S, TURNS_AFTER_S))
    share = motion_priors()[1:] / (1.0 - STANDING_RATIO)
    change = np.zeros((m, m))  # from, to
    change[STATIONARY, 1:] = start * share
    change[1:, STATIONARY] = stop
    change[1:, 1:] = (1.0 - stop) * turn * share
    change[np.diag_indices(m)] += 1.0 - change.sum(axis=1)
    sources = np.repeat(x.reshape(n, 2, 1, m, -1), m, axis=2)  # height, to, from
    spreads = np.repeat(P.reshape(n, 2, 1, m, len(STATES), -1), m, axis=2)
    mean, cov = initial_velocities(motions, road_rad)
    began = np.zeros((m, m), dtype=np.bool_)  # to, from
    began[1:, STATIONARY] = began[STATIONARY, 1:] = True
    spreads[:, :, began, VELOCITY] = 0.0
    spreads[:, :, began, :, VELOCITY] = 0.0
    for to in MOTIONS:
        sources[:, :, to, began[to], VELOCITY] = mean[:, None, to, None]
        spreads[:, :, to, began[to], VELOCITY, VELOCITY] = cov[:, None, to, None]
    by_source = weight.reshape(n, 2, 1, m) * change.T
    total = np.maximum(by_source.sum(axis=-1), 1e-300)
    mixed_x, mixed_P = merge_mixture(sources, spreads, by_source / total[..., None])
    total = total.reshape(n, FILTERS)
    return mixed_x.reshape(x.shape), mixed_P.reshape(P.shape), total / total.sum(axis=1, keepdims=True)


def predict_motion(x: Floats, P: Floats, change_mps: Floats, dt_s: float) -> tuple[Floats, Floats]:
    """States (N, 8, S), covariances after `dt_s` of constant velocity, with noise `change_mps` (N,) in 1 s."""
    F = np.eye(len(STATES))
    F[X, VX] = F[Y, VY] = dt_s
    x, P = x @ F.T, F @ P @ F.T
    q = np.square(change_mps)[:, None]
    moving = np.ones(FILTERS, dtype=np.bool_)
    moving[STATIONARY_FILTERS] = False
    for at, by in ((X, VX), (Y, VY)):
        P[:, moving, at, at] += q * dt_s**3 / 3.0
        P[:, moving, at, by] += q * dt_s**2 / 2.0
        P[:, moving, by, at] += q * dt_s**2 / 2.0
        P[:, moving, by, by] += q * dt_s
    return x, P
