"""Zero-velocity detection from the displacement of the corners.

Reflections and dirt on the windscreen and the far background do not move while the car moves; the near road does. So
its flow decides if it is visible; otherwise, a standstill is ruled out at speeds from which the brakes cannot stop.
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
from birdslam.odometry.corners.sliding_window import match_ids
from birdslam.odometry.median import quantile
from birdslam.odometry.road.points import outside

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_NEAR_M = 20.0  # maximum distance of the near road
# Corners on the near road: minimum number, and minimum fraction that a stationary car keeps tracking
_MIN_NEAR, _MIN_NEAR_SHARE = 8, 0.4
_NO_IDS: Ints = np.zeros(0, np.int64)


class ZeroVelocityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of a stationary car."""

    still_px: Positive = 0.35  # maximum median displacement since the reference image
    near_px: Positive = 1.5  # maximum flow of the near road
    braking_mps2: Positive = 12.0  # tyres on dry asphalt give 10
    speed_mps: Positive = 1.0  # from which a car may stop by the next image
    length_m: Positive = 0.012  # maximum length of a motion
    turn_rad: Positive = 0.002  # maximum angle of a turn


def near_road_flow_px(
    camera: Camera, ground: GroundPlane, reference: Tracks, tracks: Tracks, boxes_px: Floats, fixed_ids: Ints = _NO_IDS
) -> float | None:
    """Third quartile of the optical flow of the reference image's corners on the near road; None if there are too few.

    `boxes_px` (N, 4) are vehicles; the corners `fixed_ids` (M,) are excluded. Infinite if most corners were lost, which
    a stationary car would keep.
    """
    rays = rays_cam(camera, reference.px)
    near = (rays @ ground.normal_cam < -camera.height_m / _NEAR_M) & outside(reference.px, boxes_px)
    near &= ~np.isin(reference.ids, fixed_ids)
    if near.sum() < _MIN_NEAR:
        return None
    _, tracked = match_ids(reference.ids[near], tracks.ids)
    if len(tracked) < _MIN_NEAR_SHARE * near.sum():
        return math.inf
    return quantile(np.linalg.norm(tracks.flow_px[tracked], axis=1), 0.75)


def is_stationary(
    config: ZeroVelocityConfig,
    step: Pose,
    displacement_px: Floats,
    flow_px: float | None,
    speed_mps: float,
    dt_s: float,
) -> bool:
    """Whether the car is stationary since the reference image, `dt_s` ago, when it had `speed_mps`.

    `step` is its motion by the corners (m), `displacement_px` (N,) that of each corner, N >= 1; `flow_px` is from
    `near_road_flow_px`.
    """
    if quantile(displacement_px, 0.5) > config.still_px:
        return False
    if flow_px is None and speed_mps > config.braking_mps2 * dt_s + config.speed_mps:
        return False  # brakes cannot stop the car: the corners are on the windscreen or far away
    if flow_px is not None and flow_px > config.near_px:
        return False
    if quantile(displacement_px, 0.8) < config.still_px:
        return True  # most corners are unmoved: ignore the pose by the others
    turn_rad = float(np.linalg.norm(rotation_log(step.R)))
    return float(np.linalg.norm(step.p)) < config.length_m and turn_rad < config.turn_rad
