"""State of a road user, x = [x, y, vx, vy, log h, log w, tilt, offset, foot, head], and moments of mixtures of filters.

Position (m) and velocity (m/s) of the centre are in the odometry world, `h` is the height (m), `w` the width of the
outline (vehicles: relative to the class). `tilt` (rad) and `offset` (m, downwards) are of the ground relative to the
front end's, `foot` and `head` lasting errors of the edges of the box, relative to its height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2

STATES = X, Y, VX, VY, HEIGHT, WIDTH, TILT, OFFSET, FOOT, HEAD = range(10)
PLACE, VELOCITY, KINEMATIC = slice(X, VX), slice(VX, HEIGHT), slice(X, HEIGHT)
# The two along the direction of travel are TOWARDS and AWAY from the ego for people, slow and fast for vehicles
MOTIONS = STATIONARY, FIRST_ALONG, SECOND_ALONG, CROSSING = range(4)


@dataclass(frozen=True)
class Moments:
    """Means (N, 10) and covariances (N, 10, 10) of the mixtures; probabilities (N,) of standing and of an odd size."""

    mean: Floats
    cov: Floats
    standing: Floats
    odd_size: Floats


def merge_mixture(x: Floats, P: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean (..., S), covariance (..., S, S) of Gaussian mixtures (..., C, S), (..., C, S, S), weights (..., C)."""
    of_each = weight[..., None, :]
    mean: Floats = of_each @ x
    gap = x - mean
    cov = (of_each @ P.reshape(*P.shape[:-2], -1)).reshape(*x.shape[:-2], *P.shape[-2:])
    return mean[..., 0, :], cov + (gap * weight[..., None]).swapaxes(-1, -2) @ gap


def ego_step_cov(at_m: Floats, T_world_ego: SE2, cov: Floats) -> Floats:
    """(..., 2, 2) covariance in world of points `at_m` (..., 2) that an error of the ego's step moves.

    `cov` (3, 3) is that of the step in its tangent space.
    """
    from_ego = at_m - [T_world_ego.x_m, T_world_ego.y_m]
    J = np.zeros((*at_m.shape[:-1], 2, 3))
    J[..., :2] = T_world_ego.rotation()
    J[..., 0, 2], J[..., 1, 2] = -from_ego[..., 1], from_ego[..., 0]
    out: Floats = J @ cov @ J.swapaxes(-1, -2)
    return out
