"""The measurements of a box in `parallax.Parallax`, from its slopes, and what a state expects of them.

z is the depth of the nearest face, r on to the roof's far edge, y/x the centre's bearing, H the camera's height, d the
kerb, by which the road at the vehicle lies lower than the ego's plane, and tilt by how much it is tilted against it:

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
from birdslam.vehicles.placement.localisation import MIN_DISTANCE_M, Observation

Floats = NDArray[np.float64]

STATES = X, Y, VX, VY, HEIGHT, WIDTH, TILT, KERB = range(8)  # see parallax.py
CUES = BY_HEIGHT, BY_WIDTH, BEARING, GROUND = range(4)  # measurements of each box, in this order
MIN_SLOPE = 0.01  # of a box's bottom: it is taken to lie no higher


@dataclass(frozen=True)
class ParallaxMeasurements:
    """One frame's boxes (N,): see the module; `reach_m` from the nearest face to the centre."""

    log_height: Floats
    log_width: Floats  # less the class's outline
    bearing: Floats  # of the centre
    sigma: Floats  # (N, 3)
    depth_m: Floats  # about
    bottom: Floats  # slope
    sigma_bottom: Floats
    reach_m: Floats
    turned_rad: Floats  # by how much the line of sight turned since last seen, so that another side is seen
    yaw_rad: Floats  # of the vehicle in ego, as known
    tan_width: Floats  # of the box, at a depth of 1


def measure_boxes(
    seen: Sequence[Observation],
    centres_m: Floats,
    extents_m: Floats,
    turned_rad: Floats,
    yaw_rad: Floats,
    roof_m2: Floats,
    vertical_per_m: float = 0.0,
) -> ParallaxMeasurements:
    """Of observations (N,), with each centre (N, 2) in ego at about its depth, and extents (N, 2) as of `extent_m`.

    `roof_m2` (N,): how far the camera stands above the roof times how far the roof reaches along the line of sight.
    `vertical_per_m`: the road's vertical curvature; bottoms count from the plane's horizon.
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
    """Innovations (N, K, 4) and their derivatives (N, K, 4, 8) by the states x (N, K, 8); `height_m`: the camera's."""
    R_ego_world = T_world_ego.rotation().T
    at = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R_ego_world.T
    depth = np.maximum(at[..., 0] - boxes.reach_m[:, None], MIN_DISTANCE_M)
    ahead = np.maximum(at[..., 0], MIN_DISTANCE_M)
    level = bev.road_slope(depth, height_m + x[..., KERB])  # Eq. 1
    slope = np.maximum(level - x[..., TILT], MIN_SLOPE)
    J = np.zeros((*x.shape[:2], len(CUES), len(STATES)))
    J[..., BY_HEIGHT, HEIGHT] = J[..., BY_WIDTH, WIDTH] = 1.0
    by_place = -R_ego_world[0] / depth[..., None]
    J[..., BY_HEIGHT, :2] = J[..., BY_WIDTH, :2] = by_place
    J[..., BEARING, :2] = (R_ego_world[1] - (at[..., 1] / ahead)[..., None] * R_ego_world[0]) / ahead[..., None]
    J[..., GROUND, :2] = by_place * (level / slope)[..., None]
    J[..., GROUND, TILT] = -1.0 / slope
    J[..., GROUND, KERB] = 1.0 / (depth * slope)
    log_bottom = np.log(np.maximum(boxes.bottom, MIN_SLOPE))
    seen = np.stack([boxes.log_height, boxes.log_width, boxes.bearing, log_bottom], axis=-1)[:, None]
    log_z = np.log(depth)
    expected = np.stack([x[..., HEIGHT] - log_z, x[..., WIDTH] - log_z, at[..., 1] / ahead, np.log(slope)], axis=-1)
    return seen - expected, J


def side_outlier_shift(boxes: ParallaxMeasurements, innovation: Floats, sigma_rel: Floats) -> Floats:
    """(2, N, K, 4): by how much an outlier of the left, the right side moves the measurements, 1-sigma.

    `innovation` (N, K, 4) is that of the boxes, `sigma_rel` (N,) the outlier's as a share of the width. A box that lost
    the share h of its width w has it in log less by -log(1 - h), and its centre moved by h w / 2: half of that times
    the geometric mean of both widths, seen and expected, which is right to h^3 / 24.
    """
    shift = np.zeros((2, *innovation.shape))
    shift[..., BY_WIDTH] = sigma_rel[:, None]
    width = boxes.tan_width[:, None] * np.exp(-innovation[..., BY_WIDTH] / 2.0)
    shift[..., BEARING] = shift[..., BY_WIDTH] * width / 2.0 * np.array([1.0, -1.0])[:, None, None]
    return shift
