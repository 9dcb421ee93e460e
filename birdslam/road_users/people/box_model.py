"""Measurements of the boxes of people for `models.user_filter`, and the tilt of the road under them.

A hidden foot raises the bottom of the box by a part of the height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_boxes import (
    BOTTOM,
    MIN_DISTANCE_M,
    TALL,
    UNUSED_SIGMA,
    Boxes,
    Cases,
    edge_covariance,
)
from birdslam.road_users.people.people_boxes import HIDDEN_CUT_PROBABILITY, PersonBox
from birdslam.road_users.people.people_config import HIDDEN_SHARE, SIGMA_HIDDEN_SHARE, PeopleConfig
from birdslam.road_users.state.ground_measurements import RoadTilts

MIN_SLOPE = 1e-3
MIN_DT_S = 1e-3


def measured_boxes(boxes: Sequence[PersonBox], T_world_ego: SE2, config: PeopleConfig) -> Boxes:
    """The boxes of people (M,), with visible or hidden feet; the width is not used."""
    tall = np.array([max(b.tan_height, MIN_SLOPE) for b in boxes])
    z = np.array([[b.bearing, b.slope_bottom, math.log(max(b.tan_height, MIN_SLOPE)), 0.0] for b in boxes]).reshape(
        -1, 4
    )
    sigmas = np.array([[b.sigma_bearing, b.sigma_bottom, b.sigma_top, UNUSED_SIGMA] for b in boxes]).reshape(-1, 4)
    reach_m = np.array([config.priors(b.label).reach_m for b in boxes])
    hidden = np.array([b.hidden for b in boxes])
    (shift, sigma), whole = np.zeros((2, len(boxes), 2, 4)), tall / (1.0 - HIDDEN_SHARE)
    shift[:, 1, BOTTOM], shift[:, 1, TALL] = -HIDDEN_SHARE * whole, math.log(1.0 - HIDDEN_SHARE)
    sigma[:, 1, BOTTOM], sigma[:, 1, TALL] = SIGMA_HIDDEN_SHARE * whole, SIGMA_HIDDEN_SHARE / (1.0 - HIDDEN_SHARE)
    return Boxes(
        z=z,
        R=edge_covariance(tall, sigmas),
        reach_m=reach_m,
        top_m=reach_m,
        cases=Cases(np.stack([1.0 - hidden, hidden], axis=1), shift, sigma, np.zeros((2, 1))),
        direction_rad=np.full(len(boxes), T_world_ego.yaw_rad),
        outline_var=np.zeros(len(boxes)),
        face_var=np.zeros(len(boxes)),
    )


def road_tilts(
    boxes: Sequence[PersonBox], unseen_s: Sequence[float], road: RoadProfile, config: PeopleConfig
) -> RoadTilts:
    """Tilts of the road beyond `road` at which complete boxes have the mean height of their class.

    `unseen_s` is the time since the last box of the same person. Most of the variance is that of the outline, which
    lasts for `outline_memory_s`.
    """
    rows = []
    for box, since_s in zip(boxes, unseen_s, strict=True):
        if not box.is_complete or box.hidden >= HIDDEN_CUT_PROBABILITY or box.tan_height <= MIN_SLOPE:
            continue
        sizes = config.priors(box.label)
        tall = box.tan_height / (1.0 + sizes.foot_rel + sizes.head_rel)
        depth = sizes.height_m / tall
        bottom = box.slope_bottom - sizes.foot_rel * tall
        tilt = road.slope(max(depth - sizes.reach_m, MIN_DISTANCE_M)) - bottom
        slope = road.height_m / depth
        of_size = sizes.sigma_height_rel**2 + (2.0 * sizes.sigma_outline_rel) ** 2
        variance = slope**2 * of_size + (sizes.sigma_offset_m / depth) ** 2 + sizes.sigma_tilt_rad**2
        rows.append((tilt, box.bearing, slope, variance, max(1.0, sizes.outline_memory_s / max(since_s, MIN_DT_S))))
    return RoadTilts(*np.array(rows).reshape(-1, 5).T)
