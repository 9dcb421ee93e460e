"""Which box may be which vehicle: where tracks are expected in the image, and how far off a box may be on the road."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from birdslam import bev
from birdslam.camera import Camera, GroundPlane
from birdslam.localisation import Observation
from birdslam.se2 import SE2

if TYPE_CHECKING:
    from birdslam.tracking import Track

NEAREST_M, FAR_M = 1.0, 1e4  # a nearer box is out of the image; from there one looks at the horizon


def predicted_boxes_px(
    tracks: Sequence[Track], camera: Camera, T_world_ego: SE2, ground: GroundPlane
) -> NDArray[np.float64]:
    """(N, 4): where each track's last box is expected in the current image; NaN behind the camera.

    The box's distance to the horizon and its size go with the inverse of the depth, whatever the ground plane.
    """
    boxes = np.full((len(tracks), 4), np.nan)
    if not tracks:
        return boxes
    centres = np.array([track.state[:2] for track in tracks])
    then = np.array([in_ego(track.T_world_ego, track.state[:2]) for track in tracks])
    now = T_world_ego.inverse() @ centres
    depth = np.array([track.place.depth_m for track in tracks])
    bearing = np.array([track.observation.bearing for track in tracks])
    near = np.column_stack([depth, depth * bearing]) + now - then
    ahead = near[:, 0] >= NEAREST_M
    slopes = np.concatenate([bearing[ahead], near[ahead, 1] / near[ahead, 0]])
    horizon = bev.ego_to_pixel(camera, ground, FAR_M * np.column_stack([np.ones(len(slopes)), slopes]))
    horizon_then, horizon_now = np.split(horizon, 2)
    last = np.array([track.observation.box_px for track in tracks])[ahead]
    scale = depth[ahead] / near[ahead, 0]
    half_px = (last[:, 2] - last[:, 0]) / 2.0 * scale
    rows = horizon_now[:, 1, None] + (last[:, [1, 3]] - horizon_then[:, 1, None]) * scale[:, None]
    boxes[ahead] = np.column_stack([horizon_now[:, 0] - half_px, rows[:, 0], horizon_now[:, 0] + half_px, rows[:, 1]])
    return boxes


def within_gate(
    tracks: Sequence[Track], observations: Sequence[Observation], T_world_ego: SE2, gate_sigma: float
) -> NDArray[np.bool_]:
    """(tracks, observations): within the gate, by the height of the box alone: no road, no learned size."""
    rough = np.array([_rough(observation) for observation in observations])
    x_m, bearing, along, across = rough.T
    R = T_world_ego.rotation()
    centres = T_world_ego @ np.column_stack([x_m, bearing * x_m])
    covs = np.empty((len(rough), 2, 2))
    covs[:, 0, 0] = along
    covs[:, 0, 1] = covs[:, 1, 0] = along * bearing
    covs[:, 1, 1] = along * bearing**2 + across
    S = np.array([track.cov[:2, :2] for track in tracks])[:, None] + (R @ covs @ R.T)[None]
    gap = centres[None] - np.array([track.state[:2] for track in tracks])[:, None]
    out: NDArray[np.bool_] = _squared_mahalanobis(gap, S) <= gate_sigma**2
    return out


def _rough(seen: Observation) -> tuple[float, float, float, float]:
    """Its centre's depth in metres by the height of its class, and bearing; variances along and across, in m^2."""
    depth_m, dimensions = seen.depth_by_height_m, seen.dimensions
    x_m = depth_m + dimensions.length_m / 2.0
    sigma_rel = math.hypot(seen.sigma_top, seen.sigma_bottom) / max(seen.tan_height, 1e-3)
    turned_m = dimensions.length_m / (2.0 if seen.cut_side else 4.0)  # its yaw is not known here
    along = x_m**2 * (sigma_rel**2 + dimensions.sigma_height_rel**2) + turned_m**2
    across = (x_m * max(seen.sigma_left, seen.sigma_right)) ** 2 + (turned_m / 2.0) ** 2
    return x_m, seen.bearing, along, across


def in_ego(T_world_ego: SE2, point: NDArray[np.float64]) -> tuple[float, float]:
    """A point (2,) of the world in ego, without the cost of arrays."""
    c, s = math.cos(T_world_ego.yaw_rad), math.sin(T_world_ego.yaw_rad)
    x, y = float(point[0]) - T_world_ego.x_m, float(point[1]) - T_world_ego.y_m
    return c * x + s * y, c * y - s * x


def _squared_mahalanobis(gap: NDArray[np.float64], S: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...): of gaps (..., 2) with covariances (..., 2, 2)."""
    x, y = gap[..., 0], gap[..., 1]
    xx, xy, yy = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    out: NDArray[np.float64] = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    return out
