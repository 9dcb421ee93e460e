"""Data association: predicted boxes of tracks in the image, and gates of observations on the road."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import MIN_DISTANCE_M, Observation
from birdslam.road_users.track import VehicleTrack

MAX_SQUARED_SIGMAS = 16.3  # squared Mahalanobis distance of bearing, bottom and height: 99.9 % of three
BORDER_PX = 8.0  # distance to the image border within which an edge counts as cut
HORIZON_M = 1e4  # distance of a road point that is imaged at the horizon


def predict_boxes_px(
    tracks: Sequence[VehicleTrack], camera: Camera, T_world_ego: SE2, ground: GroundPlane
) -> NDArray[np.float64]:
    """Predicts the box of each track in the current image, (N, 4); NaN behind the camera or out of view.

    The distance of a box to the horizon and its height scale with the inverse depth. Its outer side belongs to the
    vehicle's near end, its inner side to the far end. An edge at the image border stays there or moves out.
    """
    boxes = np.full((len(tracks), 4), np.nan)
    if not tracks:
        return boxes
    then = np.array([track.place.centre_m for track in tracks])
    step = T_world_ego.inverse() @ np.array([track.predicted_m for track in tracks]) - then
    depth = np.array([track.place.depth_m for track in tracks])
    ahead = depth + step[:, 0] >= MIN_DISTANCE_M
    if not ahead.any():
        return boxes
    step, depth = step[ahead], depth[ahead, None]
    seen = [track for track, is_ahead in zip(tracks, ahead.tolist(), strict=True) if is_ahead]
    sides = np.array([(track.observation.left, track.observation.right) for track in seen])
    inner = np.column_stack([sides[:, 0] < 0.0, sides[:, 1] > 0.0])  # as seen from straight ahead
    reach = depth + np.where(inner, np.array([_depth_span_m(track) for track in seen])[:, None], 0.0)
    sides_now = (reach * sides + step[:, 1:]) / (reach + step[:, :1])
    slopes = np.stack([sides, sides_now]).ravel()
    horizon = bev.ego_to_pixel(camera, ground, HORIZON_M * np.column_stack([np.ones(len(slopes)), slopes]))
    horizon_then, horizon_now = horizon.reshape(2, -1, 2, 2)  # (N, sides, 2)
    last = np.array([track.observation.box_px for track in seen])
    moved = np.empty_like(last)
    moved[:, ::2] = last[:, ::2] + horizon_now[..., 0] - horizon_then[..., 0]
    from_horizon = (last[:, 1::2] - horizon_then[..., 1].mean(axis=1, keepdims=True)) * depth / (depth + step[:, :1])
    moved[:, 1::2] = horizon_now[..., 1].mean(axis=1, keepdims=True) + from_horizon
    boxes[ahead] = _clip_to_image(moved, last, camera)
    return boxes


def _depth_span_m(track: VehicleTrack) -> float:
    """Extent of a vehicle along the line of sight."""
    yaw_rad = track.yaw_rad - track.frame.T_world_ego.yaw_rad
    size = track.observation.dimensions
    return abs(math.cos(yaw_rad)) * size.length_m + abs(math.sin(yaw_rad)) * size.width_m


def _clip_to_image(moved: NDArray[np.float64], last: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Clips boxes (N, 4) to the image; edges of `last` (N, 4) at the border stay there. NaN outside the image."""
    size_px = np.array([camera.width_px, camera.height_px])
    least, most = last[:, :2], last[:, 2:]
    upper = np.where(least < BORDER_PX, np.minimum(moved[:, :2], least), moved[:, :2])
    lower = np.where(most > size_px - BORDER_PX, np.maximum(moved[:, 2:], most), moved[:, 2:])
    upper, lower = np.clip(upper, 0.0, size_px), np.clip(lower, 0.0, size_px)
    boxes = np.hstack([upper, lower])
    boxes[(lower <= upper).any(axis=1)] = np.nan
    return boxes


def assign_track_ids(observations: Sequence[Observation], track_ids: NDArray[np.int64]) -> list[Observation]:
    """The observations with an id of another tracker; `track_ids` has one per box, negative without a track."""
    return [
        msgspec.structs.replace(seen, track_id=int(track_ids[seen.row]))
        for seen in observations
        if track_ids[seen.row] >= 0
    ]


def match_track_ids(tracks: Sequence[VehicleTrack], observations: Sequence[Observation]) -> list[tuple[int, int]]:
    """Pairs (row of a track, its observation) by the ids of another tracker."""
    rows = {track.observation.track_id: row for row, track in enumerate(tracks)}
    return [(rows[seen.track_id], k) for k, seen in enumerate(observations) if seen.track_id in rows]


def in_ego(T_world_ego: SE2, point: NDArray[np.float64]) -> tuple[float, float]:
    """Transforms a point (2,) from world to ego, without arrays for speed."""
    c, s = math.cos(T_world_ego.yaw_rad), math.sin(T_world_ego.yaw_rad)
    x, y = float(point[0]) - T_world_ego.x_m, float(point[1]) - T_world_ego.y_m
    return c * x + s * y, c * y - s * x
