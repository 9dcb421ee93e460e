"""Measurement model of a box in `parallax.Parallax`.

z is the depth of the nearest face, r the distance on to the roof's far edge, y/x the bearing of the centre, H the
camera height, d the offset of the ground below the ego plane, tilt its slope relative to it:

    log(bottom - top - (H - h) r / (z (z + r))) = log h - log z        y / x
    log(left - right) = log w + log(class's outline) - log z           log(bottom) = log((H + d) / z - tilt)    (Eq. 1)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.camera import PLANE_AT_M
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import MIN_DISTANCE_M, Observation

Floats = NDArray[np.float64]

STATES = X, Y, VX, VY, HEIGHT, WIDTH, TILT, OFFSET = range(8)  # see parallax.py
CUES = BY_HEIGHT, BY_WIDTH, BEARING, GROUND = range(4)  # measurements per box, in this order
MIN_SLOPE = 0.01  # minimum of a box's bottom


@dataclass(frozen=True)
class ParallaxMeasurements:
    """One frame's boxes (N,), see the module; `reach_m` is the distance from the nearest face to the centre."""

    log_height: Floats
    log_width: Floats  # minus the log of the class's outline
    bearing: Floats  # of the centre
    sigma: Floats  # (N, 3)
    depth_m: Floats  # approximate
    bottom: Floats  # slope
    sigma_bottom: Floats
    reach_m: Floats
    turned_rad: Floats  # rotation of the line of sight since the last observation
    yaw_rad: Floats  # estimated yaw in ego
    tan_width: Floats  # at a depth of 1


def measure_boxes(
    seen: Sequence[Observation],
    centres_m: Floats,
    extents_m: Floats,
    turned_rad: Floats,
    yaw_rad: Floats,
    roof_m2: Floats,
    vertical_per_m: float = 0.0,
) -> ParallaxMeasurements:
    """Measurements of observations (N,), with approximate centres (N, 2) in ego and extents (N, 2) of `extent_m`.

    `roof_m2` (N,) is the height of the camera above the roof times the reach of the roof along the line of sight.
    `vertical_per_m` is the road's vertical curvature; bottoms are relative to the plane's horizon.
    """
    depth = np.maximum(centres_m[:, 0] - extents_m[:, 0] / 2.0, MIN_DISTANCE_M)
    over_roof = roof_m2 / (depth * (depth + extents_m[:, 0]))
    sigma = [
        (
            math.hypot(o.sigma_top, o.sigma_bottom) / max(o.tan_height, 1e-3),
            math.hypot(o.sigma_left, o.sigma_right) / o.tan_width,
            math.hypot(o.sigma_left, o.sigma_right) / 2.0,
        )
        for o in seen
    ]
    return ParallaxMeasurements(
        log_height=np.log(np.maximum(np.array([o.tan_height for o in seen]) - over_roof, 1e-3)),
        log_width=np.log([o.tan_width for o in seen]) - np.log(extents_m[:, 1]),
        bearing=centres_m[:, 1] / centres_m[:, 0],
        sigma=np.array(sigma).reshape(-1, 3),
        depth_m=depth,
        bottom=np.array([o.slope_bottom for o in seen]) + 0.5 * vertical_per_m * (depth - PLANE_AT_M),
        sigma_bottom=np.array([o.sigma_bottom for o in seen]),
        reach_m=extents_m[:, 0] / 2.0,
        turned_rad=turned_rad,
        yaw_rad=yaw_rad,
        tan_width=np.array([o.tan_width for o in seen]),
    )


def linearised(x: Floats, boxes: ParallaxMeasurements, T_world_ego: SE2, height_m: float) -> tuple[Floats, Floats]:
    """Innovations (N, K, 4) and Jacobians (N, K, 4, 8) at the states x (N, K, 8); `height_m` is the camera height."""
    R_ego_world = T_world_ego.rotation().T
    at = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R_ego_world.T
    depth = np.maximum(at[..., 0] - boxes.reach_m[:, None], MIN_DISTANCE_M)
    ahead = np.maximum(at[..., 0], MIN_DISTANCE_M)
    level = bev.road_slope(depth, height_m + x[..., OFFSET])  # Eq. 1
    slope = np.maximum(level - x[..., TILT], MIN_SLOPE)
    J = np.zeros((*x.shape[:2], len(CUES), len(STATES)))
    J[..., BY_HEIGHT, HEIGHT] = J[..., BY_WIDTH, WIDTH] = 1.0
    by_place = -R_ego_world[0] / depth[..., None]
    J[..., BY_HEIGHT, :2] = J[..., BY_WIDTH, :2] = by_place
    J[..., BEARING, :2] = (R_ego_world[1] - (at[..., 1] / ahead)[..., None] * R_ego_world[0]) / ahead[..., None]
    J[..., GROUND, :2] = by_place * (level / slope)[..., None]
    J[..., GROUND, TILT] = -1.0 / slope
    J[..., GROUND, OFFSET] = 1.0 / (depth * slope)
    log_bottom = np.log(np.maximum(boxes.bottom, MIN_SLOPE))
    seen = np.stack([boxes.log_height, boxes.log_width, boxes.bearing, log_bottom], axis=-1)[:, None]
    log_z = np.log(depth)
    expected = np.stack([x[..., HEIGHT] - log_z, x[..., WIDTH] - log_z, at[..., 1] / ahead, np.log(slope)], axis=-1)
    return seen - expected, J


def side_outlier_shift(boxes: ParallaxMeasurements, innovation: Floats, sigma_rel: Floats) -> Floats:
    """(2, N, K, 4) 1-sigma effect of an outlier of the left, the right side on the measurements.

    `innovation` (N, K, 4) is that of the boxes, `sigma_rel` (N,) the outlier's, of the width. A box that lost the
    fraction h of its width w changes by log(1 - h), and its centre by h w / 2: half of that times the geometric mean of
    measured and expected width, up to h^3 / 24.
    """
    shift = np.zeros((2, *innovation.shape))
    shift[..., BY_WIDTH] = sigma_rel[:, None]
    width = boxes.tan_width[:, None] * np.exp(-innovation[..., BY_WIDTH] / 2.0)
    shift[..., BEARING] = shift[..., BY_WIDTH] * width / 2.0 * np.array([1.0, -1.0])[:, None, None]
    return shift
