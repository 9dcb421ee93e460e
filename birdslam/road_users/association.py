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

MAX_SIGMA_HEIGHT_REL = 0.2  # of the height of a box that measures the size
MIN_TAN_HEIGHT = 1e-3  # of a box's height at a depth of 1
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
    centres = np.array([track.state[:2] for track in tracks])
    then = np.array([in_ego(track.frame.T_world_ego, track.state[:2]) for track in tracks])
    step = T_world_ego.inverse() @ centres - then
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


def at_border(boxes_px: NDArray[np.float64], camera: Camera) -> NDArray[np.bool_]:
    """(N,) which of the boxes (N, 4) are cut by the image border."""
    size_px = np.array([camera.width_px, camera.height_px])
    cut = np.hstack([boxes_px[:, :2] < BORDER_PX, boxes_px[:, 2:] > size_px - BORDER_PX])
    return np.asarray(cut.any(axis=1))


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


def within_gate(
    tracks: Sequence[VehicleTrack], observations: Sequence[Observation], T_world_ego: SE2, gate_sigma: float
) -> NDArray[np.bool_]:
    """(tracks, observations) which pairs pass the gate, by the height of the box and the track's learned size.

    A track with a known height keeps the length of its class, whatever the label of a box.
    """
    of_boxes = np.array([_box_measurements(o) for o in observations]).T
    tan_height, sigma_box_rel, turned_share, bearing, sigma_sides = of_boxes
    # The class of the track if its height was measured, else that of the box
    measured = np.array([_is_height_measured(track.observation) for track in tracks])[:, None]
    of_tracks, of_classes = (
        np.array([(d.height_m, d.sigma_height_rel, d.length_m) for d in dimensions]).T
        for dimensions in ([t.observation.dimensions for t in tracks], [o.dimensions for o in observations])
    )
    height_m, sigma_class_rel, length_m = np.where(measured, of_tracks[..., None], of_classes[:, None])
    depth = height_m / tan_height
    learned = np.array([_learned_height_m(track) for track in tracks])[:, None]
    # The error of a track's height affects its depth too
    of_last = np.array([_sigma_height_rel(track.observation) for track in tracks])[:, None]
    sigma_rel = np.hypot(sigma_box_rel, np.where(np.isnan(learned), sigma_class_rel, of_last))
    turned_m = length_m * turned_share  # the yaw is not known here
    of_class = of_tracks[0][:, None]
    x_m = np.where(np.isnan(learned), 1.0, learned / of_class) * depth + length_m / 2.0
    along = np.square(x_m * sigma_rel) + np.square(turned_m)
    across = np.square(x_m * sigma_sides) + np.square(turned_m / 2.0)
    R = T_world_ego.rotation()
    centres = T_world_ego @ np.stack([x_m, bearing * x_m], axis=-1).reshape(-1, 2)
    covs = np.empty((*x_m.shape, 2, 2))
    covs[..., 0, 0] = along
    covs[..., 0, 1] = covs[..., 1, 0] = along * bearing
    covs[..., 1, 1] = along * np.square(bearing) + across
    S = np.array([track.cov[:2, :2] for track in tracks])[:, None] + R @ covs @ R.T
    gap = centres.reshape(*x_m.shape, 2) - np.array([track.state[:2] for track in tracks])[:, None]
    out: NDArray[np.bool_] = _squared_mahalanobis(gap, S) <= gate_sigma**2
    return out


def _learned_height_m(track: VehicleTrack) -> float:
    """Height of the vehicle from its last box and the depth of its place; NaN if it is not measured."""
    seen = track.observation
    return track.place.depth_m * seen.tan_height if _is_height_measured(seen) else math.nan


def _is_height_measured(seen: Observation) -> bool:
    return _sigma_height_rel(seen) < MAX_SIGMA_HEIGHT_REL


def _box_measurements(seen: Observation) -> tuple[float, float, float, float, float]:
    """Height at a depth of 1, its relative 1-sigma, fraction of the length that the yaw may hide, bearing, sigma."""
    turned_share = 0.5 if seen.is_cut_at_side else 0.25
    sigma_sides = max(seen.sigma_left, seen.sigma_right)
    return max(seen.tan_height, MIN_TAN_HEIGHT), _sigma_height_rel(seen), turned_share, seen.bearing, sigma_sides


def _sigma_height_rel(seen: Observation) -> float:
    return math.hypot(seen.sigma_top, seen.sigma_bottom) / max(seen.tan_height, MIN_TAN_HEIGHT)


def in_ego(T_world_ego: SE2, point: NDArray[np.float64]) -> tuple[float, float]:
    """Transforms a point (2,) from world to ego, without arrays for speed."""
    c, s = math.cos(T_world_ego.yaw_rad), math.sin(T_world_ego.yaw_rad)
    x, y = float(point[0]) - T_world_ego.x_m, float(point[1]) - T_world_ego.y_m
    return c * x + s * y, c * y - s * x


def _squared_mahalanobis(gap: NDArray[np.float64], S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared Mahalanobis distance (...) of gaps (..., 2) with covariances (..., 2, 2)."""
    x, y = gap[..., 0], gap[..., 1]
    xx, xy, yy = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    out: NDArray[np.float64] = (yy * x**2 - 2.0 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    return out
