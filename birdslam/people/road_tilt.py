"""The road's tilt at each person, as the boxes of everybody else have it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats
from birdslam.people.box_model import MIN_SLOPE, NEAREST_M, UNUSED
from birdslam.people.people_boxes import PersonBox
from birdslam.people.people_config import PeopleConfig


def tilts_of(boxes: Sequence[PersonBox], sigma_pitch_rad: float, height_m: float, config: PeopleConfig) -> Floats:
    """(N, 2): mean and variance of the road's tilt against the front end's ground, as everybody else's box has it.

    A box alone tells it by the height of its kind; its own must not be counted twice. Of several the mean is
    known no better than the mean of heights is.
    """
    n = len(boxes)
    if not n:
        return np.zeros((0, 2))
    tilt, variance, slope = np.zeros(n), np.full(n, UNUSED), np.zeros(n)
    for k, box in enumerate(boxes):
        if box.whole and box.hidden <= config.sure_feet and box.tan_height > MIN_SLOPE:
            sizes = config.sizes(box.label)
            depth = sizes.height_m / box.tan_height
            tilt[k] = bev.road_slope(max(depth - sizes.reach_m, NEAREST_M), height_m + config.kerb_m)
            tilt[k] -= box.slope_bottom
            rel = math.hypot(sizes.sigma_height_rel, 2.0 * config.sigma_outline_rel)
            slope[k] = height_m / depth
            variance[k] = (slope[k] * rel) ** 2 + (config.sigma_kerb_m / depth) ** 2
    weight = information = 1.0 / variance
    for _ in range(2):  # a child, or feet that something hides, tells another tilt (Cauchy)
        mean = float((weight * tilt).sum()) / (float(weight.sum()) + sigma_pitch_rad**-2)
        weight = information / (1.0 + information * np.square(tilt - mean) / 4.0)
    others = np.maximum(weight.sum() - weight, UNUSED**-2)
    by_boxes = ((weight * tilt).sum() - weight * tilt) / others
    by_heights = config.sigma_common_rel * ((weight * slope).sum() - weight * slope) / others
    spread = 1.0 / others + np.square(by_heights)  # all are tall together: many know no better than that
    share = sigma_pitch_rad**2 / (sigma_pitch_rad**2 + spread)  # against the front end's
    return np.stack([share * by_boxes, share * spread], axis=1)
