"""Measurement model of the box of a person at depth X, and its noise.

    bearing = Y / X,   bottom = (H + b) / (X - reach) - rise - tilt + foot h / X (Eq. 1),
    log of the height = log(h) - log(X) + log(1 + reach (H + b) / ((X - reach) h)) + foot - head,
    log of the width = log(w) - log(X).

H is the camera height; the road rises by `rise` (`bev.rise`) and lies b lower under the feet (ground offset); the
nearest foot is at X - reach; a hidden foot raises the bottom of the box by `foot` of h / X.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.people.people_boxes import HIDDEN_CUT_PROBABILITY, PersonBox
from birdslam.road_users.people.people_config import (
    HIDDEN_SHARE,
    OUTLINE_MEMORY_S,
    SIGMA_HIDDEN_SHARE,
    SIGMA_KERB_M,
    SIGMA_OUTLINE_REL,
    SIGMA_TILT_RAD,
    PeopleConfig,
)
from birdslam.road_users.people.people_state import FOOT, HEAD, HEIGHT, OFFSET, STATES, TILT
from birdslam.road_users.state.ground_measurements import RoadTilts

BEARING, BOTTOM, TALL, WIDTH = range(4)
UNUSED_SIGMA = 1e3  # 1-sigma of an unused measurement
MIN_DISTANCE_M = 0.7
MIN_SLOPE = 1e-3
MIN_DT_S = 1e-3


def measured_boxes(boxes: Sequence[PersonBox]) -> tuple[Floats, Floats]:
    """(M, 4) bearing, bottom, log height and log width, and covariances (M, 4, 4), without that of the width."""
    tall = np.array([max(b.tan_height, MIN_SLOPE) for b in boxes])
    z = np.array([[b.bearing, b.slope_bottom, 0.0, b.log_width] for b in boxes])
    z[:, TALL] = np.log(tall)
    bottom, top = np.array([[b.sigma_bottom, b.sigma_top] for b in boxes]).T
    R = np.zeros((len(boxes), 4, 4))
    R[:, BEARING, BEARING] = np.square([b.sigma_bearing for b in boxes])
    R[:, BOTTOM, BOTTOM] = bottom**2
    R[:, BOTTOM, TALL] = R[:, TALL, BOTTOM] = bottom**2 / tall
    R[:, TALL, TALL] = (bottom**2 + top**2) / tall**2
    R[:, WIDTH, WIDTH] = UNUSED_SIGMA**2
    return z, R


def expected_boxes(
    x: Floats, T_world_ego: SE2, road: RoadProfile, reach_m: Floats, log_width: Floats
) -> tuple[Floats, Floats]:
    """Expected measurements (M, K, 2, 4) of states (M, K, 2, S), with visible and hidden feet, and Jacobians.

    `reach_m` and `log_width` (M,) are those of each person.
    """
    R = T_world_ego.rotation()
    in_ego = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R
    depth, y = np.maximum(in_ego[..., 0], MIN_DISTANCE_M), in_ego[..., 1]
    foot = np.maximum(depth - reach_m[:, None, None], 0.5 * MIN_DISTANCE_M)
    height, below = np.exp(x[..., HEIGHT]), road.height_m + x[..., OFFSET]
    expected, J = np.empty((*x.shape[:3], 4)), np.zeros((*x.shape[:3], 4, len(STATES)))
    expected[..., BEARING] = y / depth
    tall = height / depth
    expected[..., BOTTOM] = road.slope(foot, x[..., OFFSET]) - x[..., TILT] + x[..., FOOT] * tall  # Eq. 1
    nearer = (depth - foot) * below / (foot * height)  # increase of the height by a nearer foot
    expected[..., TALL] = x[..., HEIGHT] - np.log(depth) + np.log1p(nearer) + x[..., FOOT] - x[..., HEAD]
    expected[..., WIDTH] = log_width[:, None, None] - np.log(depth)
    falls = -below / foot**2 - 0.5 * road.vertical_per_m
    by_depth = np.stack([-y / depth**2, falls, -(1.0 + nearer) / depth, -1.0 / depth], axis=-1)
    J[..., :2] = by_depth[..., None] * R[:, 0]
    J[..., BEARING, :2] += R[:, 1] / depth[..., None]
    J[..., BOTTOM, TILT], J[..., BOTTOM, OFFSET], J[..., BOTTOM, FOOT] = -1.0, 1.0 / foot, tall
    J[..., TALL, HEIGHT], J[..., TALL, FOOT], J[..., TALL, HEAD] = 1.0, 1.0, -1.0
    expected[:, :, 1, BOTTOM] -= HIDDEN_SHARE * tall[:, :, 1]
    expected[:, :, 1, TALL] += math.log(1.0 - HIDDEN_SHARE)
    return expected, J


def road_tilts(
    boxes: Sequence[PersonBox], unseen_s: Sequence[float], road: RoadProfile, config: PeopleConfig
) -> RoadTilts:
    """Tilts of the road beyond `road` at which complete boxes have the mean height of their class.

    `unseen_s` is the time since the last box of the same person. Most of the variance is that of the outline, which
    lasts for OUTLINE_MEMORY_S.
    """
    rows = []
    for box, since_s in zip(boxes, unseen_s, strict=True):
        if not box.is_complete or box.hidden >= HIDDEN_CUT_PROBABILITY or box.tan_height <= MIN_SLOPE:
            continue
        sizes = config.sizes(box.label)
        tall = box.tan_height / (1.0 + sizes.foot_rel + sizes.head_rel)
        depth = sizes.height_m / tall
        bottom = box.slope_bottom - sizes.foot_rel * tall
        tilt = road.slope(max(depth - sizes.reach_m, MIN_DISTANCE_M)) - bottom
        slope = road.height_m / depth
        of_size = sizes.sigma_height_rel**2 + (2.0 * SIGMA_OUTLINE_REL) ** 2
        variance = slope**2 * of_size + (SIGMA_KERB_M / depth) ** 2 + SIGMA_TILT_RAD**2
        rows.append((tilt, box.bearing, slope, variance, max(1.0, OUTLINE_MEMORY_S / max(since_s, MIN_DT_S))))
    return RoadTilts(*np.array(rows).reshape(-1, 5).T)


def hide_feet(noise: Floats, tall: Floats) -> None:
    """Adds the noise of hidden feet to covariances (..., 4, 4) in place; `tall` (...) is the height at a depth of 1."""
    of_bottom, of_height = SIGMA_HIDDEN_SHARE * tall, SIGMA_HIDDEN_SHARE / (1.0 - HIDDEN_SHARE)
    noise[..., BOTTOM, BOTTOM] += of_bottom**2
    noise[..., BOTTOM, TALL] += of_bottom * of_height
    noise[..., TALL, BOTTOM] += of_bottom * of_height
    noise[..., TALL, TALL] += of_height**2
