"""Whether the car stands: corners stay where they were in the image, and those on the near road with them.

Reflections on the windscreen, dirt and the far background stay as well while the car drives. The near road does not, so
it decides where it is seen; where it is not, no car is held to stand that was faster than brakes allow.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose, rotation_log
from birdslam.odometry.corners.feature_tracks import Tracks
from birdslam.odometry.corners.sliding_window import common
from birdslam.odometry.median import quantile
from birdslam.odometry.road.points import outside

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_NEAR_M = 20.0  # road nearer than this moves in the image when the car does
# Of its corners: so few say nothing, and a standing car keeps so many. By judgement; no data chose them
_FEWEST_NEAR, _LEAST_NEAR_SHARE = 8, 0.4


class StandstillConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the pose is held."""

    still_px: Positive = 0.35  # median displacement against the image that the car stopped in
    near_px: Positive = 1.5  # the near road moves more than this when the car does
    braking_mps2: Positive = 12.0  # tyres on dry asphalt give 10
    speed_mps: Positive = 1.0  # a measured speed from which a car may be found to stand the next image
    length_m: Positive = 0.012  # a motion that is shorter is none
    turn_rad: Positive = 0.002  # a turn that is smaller is none


def near_displacement_px(
    camera: Camera, ground: GroundPlane, base: Tracks, tracks: Tracks, boxes_px: Floats
) -> float | None:
    """How far the base image's corners on the near road have moved, the third quartile; None where there are too few.

    `boxes_px` (N, 4) are vehicles. Infinite where most of them were lost: of a car that stands they would have been
    found.
    """
    rays = rays_cam(camera, base.px)
    near = (rays @ ground.normal_cam < -camera.height_m / _NEAR_M) & outside(base.px, boxes_px)
    if near.sum() < _FEWEST_NEAR:
        return None
    a, b = common(base.ids[near], tracks.ids)
    if len(a) < _LEAST_NEAR_SHARE * near.sum():
        return math.inf
    return quantile(np.sqrt(((tracks.px[b] - base.px[near][a]) ** 2).sum(axis=1)), 0.75)


def stands(
    config: StandstillConfig, step: Pose, displacement_px: Floats, near_px: float | None, speed_mps: float, dt_s: float
) -> bool:
    """Whether the car stood since the base image, `dt_s` ago, when it had `speed_mps`.

    `step` is what the corners make of its motion (m), `displacement_px` (N,) how far each has moved, N >= 1, and
    `near_px` is `near_displacement_px`.
    """
    if quantile(displacement_px, 0.5) > config.still_px:
        return False
    if near_px is None and speed_mps > config.braking_mps2 * dt_s + config.speed_mps:
        return False  # no car stops so soon, and no near road says that it did: the glass stands, or the horizon
    if near_px is not None and near_px > config.near_px:
        return False
    if quantile(displacement_px, 0.8) < config.still_px:
        return True  # four corners of five have not moved: what the others make of the pose does not count
    turn_rad = float(np.linalg.norm(rotation_log(step.R)))
    return float(np.linalg.norm(step.p)) < config.length_m and turn_rad < config.turn_rad
