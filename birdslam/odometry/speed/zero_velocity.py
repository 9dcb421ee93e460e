"""Zero-velocity detection: the car stands where the corners, and those on the near road with them, have not moved.

Reflections on the windscreen, dirt and the far background do not move while the car drives either; the near road does.
So it decides where it is seen; where it is not, a speed from which brakes could not have stopped the car rules a stop
out. The update itself holds the pose (`Odometry`).
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

_NEAR_M = 20.0  # road nearer than this moves in the image with the car
# Of its corners: the number needed, and the share that a stationary car keeps. By judgement; no data chose them
_MIN_NEAR, _MIN_NEAR_SHARE = 8, 0.4
_NO_IDS: Ints = np.zeros(0, np.int64)


class ZeroVelocityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the car counts as stationary."""

    still_px: Positive = 0.35  # median displacement since the image that the car stopped in
    near_px: Positive = 1.5  # flow of the near road, above which the car moves
    braking_mps2: Positive = 12.0  # tyres on dry asphalt give 10
    speed_mps: Positive = 1.0  # a measured speed from which a car may have stopped by the next image
    length_m: Positive = 0.012  # a motion that is shorter is none
    turn_rad: Positive = 0.002  # a turn that is smaller is none


def near_road_flow_px(
    camera: Camera, ground: GroundPlane, reference: Tracks, tracks: Tracks, boxes_px: Floats, fixed_ids: Ints = _NO_IDS
) -> float | None:
    """Optical flow of the reference image's corners on the near road, third quartile; None where there are too few.

    `boxes_px` (N, 4) are vehicles, `fixed_ids` (M,) the ids of fixed corners, which do not count. Infinite where most
    corners were lost: a stationary car would have kept them.
    """
    rays = rays_cam(camera, reference.px)
    near = (rays @ ground.normal_cam < -camera.height_m / _NEAR_M) & outside(reference.px, boxes_px)
    near &= ~np.isin(reference.ids, fixed_ids)
    if near.sum() < _MIN_NEAR:
        return None
    a, b = match_ids(reference.ids[near], tracks.ids)
    if len(a) < _MIN_NEAR_SHARE * near.sum():
        return math.inf
    return quantile(np.sqrt(((tracks.px[b] - reference.px[near][a]) ** 2).sum(axis=1)), 0.75)


def is_stationary(
    config: ZeroVelocityConfig,
    step: Pose,
    displacement_px: Floats,
    flow_px: float | None,
    speed_mps: float,
    dt_s: float,
) -> bool:
    """Whether the car has stood since the reference image, `dt_s` ago, when it had `speed_mps`.

    `step` is its motion by the corners (m), `displacement_px` (N,) that of each corner, N >= 1; `flow_px` is
    `near_road_flow_px`.
    """
    if quantile(displacement_px, 0.5) > config.still_px:
        return False
    if flow_px is None and speed_mps > config.braking_mps2 * dt_s + config.speed_mps:
        return (
            False  # no car brakes so hard, and no near road shows a stop: these corners are on the glass, or far away
        )
    if flow_px is not None and flow_px > config.near_px:
        return False
    if quantile(displacement_px, 0.8) < config.still_px:
        return True  # four of five corners have not moved: the pose by the others does not count
    turn_rad = float(np.linalg.norm(rotation_log(step.R)))
    return float(np.linalg.norm(step.p)) < config.length_m and turn_rad < config.turn_rad
