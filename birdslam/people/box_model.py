"""What the box of somebody looks like at depth X, and how its numbers err.

    bearing = Y / X,   bottom = (H + b) / (X - reach) - rise - tilt + foot h / X (Eq. 1),
    log of the height = log(h) - log(X) + log(1 + reach (H + b) / ((X - reach) h)) + foot - head,
    log of the width = log(w) - log(X).

H is the camera's height; the road rises by `rise` (`bev.rise`), less b under the feet (kerb); the nearest foot is at
X - reach; a hidden one lets the box end `foot` of h / X higher. In logarithms derivatives stay the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.people.people_boxes import PersonBox
from birdslam.people.people_config import PeopleConfig
from birdslam.people.people_state import FOOT, HEAD, HEIGHT, KERB, STATES, TILT

BEARING, BOTTOM, TALL, WIDTH = range(4)
UNUSED = 1e3  # 1-sigma of what is not measured
MIN_DISTANCE_M = 0.7
MIN_SLOPE = 1e-3


def measured_boxes(boxes: Sequence[PersonBox]) -> tuple[Floats, Floats]:
    """(M, 4) bearing, bottom, log of the height and of the width, and their covariance (M, 4, 4); of width none."""
    tall = np.array([max(b.tan_height, MIN_SLOPE) for b in boxes])
    z = np.array([[b.bearing, b.slope_bottom, 0.0, b.log_width] for b in boxes])
    z[:, TALL] = np.log(tall)
    bottom, top = np.array([[b.sigma_bottom, b.sigma_top] for b in boxes]).T
    R = np.zeros((len(boxes), 4, 4))
    R[:, BEARING, BEARING] = np.square([b.sigma_bearing for b in boxes])
    R[:, BOTTOM, BOTTOM] = bottom**2
    R[:, BOTTOM, TALL] = R[:, TALL, BOTTOM] = bottom**2 / tall
    R[:, TALL, TALL] = (bottom**2 + top**2) / tall**2
    R[:, WIDTH, WIDTH] = UNUSED**2
    return z, R


def expected_boxes(
    x: Floats, T_world_ego: SE2, road: RoadProfile, reach_m: Floats, log_width: Floats, config: PeopleConfig
) -> tuple[Floats, Floats]:
    """Measurements (M, K, 2, 4) expected of states (M, K, 2, S), feet visible and hidden, and their Jacobians.

    `reach_m` and `log_width` (M,) are of each person.
    """
    R = T_world_ego.rotation()
    in_ego = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R
    depth, y = np.maximum(in_ego[..., 0], MIN_DISTANCE_M), in_ego[..., 1]
    foot = np.maximum(depth - reach_m[:, None, None], 0.5 * MIN_DISTANCE_M)
    height, below = np.exp(x[..., HEIGHT]), road.height_m + x[..., KERB]
    expected, J = np.empty((*x.shape[:3], 4)), np.zeros((*x.shape[:3], 4, len(STATES)))
    expected[..., BEARING] = y / depth
    tall = height / depth
    expected[..., BOTTOM] = road.slope(foot, x[..., KERB]) - x[..., TILT] + x[..., FOOT] * tall  # Eq. 1
    nearer = (depth - foot) * below / (foot * height)  # how much taller a nearer foot makes it
    expected[..., TALL] = x[..., HEIGHT] - np.log(depth) + np.log1p(nearer) + x[..., FOOT] - x[..., HEAD]
    expected[..., WIDTH] = log_width[:, None, None] - np.log(depth)
    falls = -below / foot**2 - 0.5 * road.vertical_per_m
    by_depth = np.stack([-y / depth**2, falls, -(1.0 + nearer) / depth, -1.0 / depth], axis=-1)
    J[..., :2] = by_depth[..., None] * R[:, 0]
    J[..., BEARING, :2] += R[:, 1] / depth[..., None]
    J[..., BOTTOM, TILT], J[..., BOTTOM, KERB], J[..., BOTTOM, FOOT] = -1.0, 1.0 / foot, tall
    J[..., TALL, HEIGHT], J[..., TALL, FOOT], J[..., TALL, HEAD] = 1.0, 1.0, -1.0
    expected[:, :, 1, BOTTOM] -= config.hidden_share * tall[:, :, 1]
    expected[:, :, 1, TALL] += math.log(1.0 - config.hidden_share)
    return expected, J


def hide_feet(noise: Floats, tall: Floats, config: PeopleConfig) -> None:
    """What hidden feet add to covariances (..., 4, 4) of boxes of `tall` (...), a height at a depth of 1, in place."""
    of_bottom, of_height = config.sigma_hidden_share * tall, config.sigma_hidden_share / (1.0 - config.hidden_share)
    noise[..., BOTTOM, BOTTOM] += of_bottom**2
    noise[..., BOTTOM, TALL] += of_bottom * of_height
    noise[..., TALL, BOTTOM] += of_bottom * of_height
    noise[..., TALL, TALL] += of_height**2
