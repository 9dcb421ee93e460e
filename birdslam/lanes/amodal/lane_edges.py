"""CP edges of lanes (Eq. 3): the lane markings of one frame against the lanes mapped by earlier frames.

A landmark is a *station*: the intersection of a lane with a grid line in world. Its position across the lane is
measured; along the lane the covariance is large. Only markings of single frames give edges: completed lanes combine
many frames with the odometry that the edges correct.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.types import LandmarkEdge, LandmarkKind

Ids = Ints

_CELLS = 1 << 20  # stations of one lane along one axis until ids repeat: 4000 km
_MIN_SPAN_RATIO = 0.7  # share of a station's length that its points must span, for a stable line fit


class LaneEdgesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which points of a lane become CP edges, and their uncertainty."""

    station_m: float = 4.0  # distance between the landmarks of a lane
    least_points: int = 8  # of a station
    sigma_px: float = 1.0  # of the markings' mask
    sigma_across_m: float = 0.1  # across the marking: half of a painted line's width
    sigma_along_m: float = 10.0  # along the lane: unknown
    bend_m: float = 0.25  # max. deviation of a station's points from their line
    max_edges: int = 16  # per frame, the nearest
    # A frame's stations are repeated in this many later frames, since the segmenter need not run on keyframes. It is
    # less than the keyframe interval, so that none counts twice.
    carried_frames: int = 3


@dataclass(frozen=True)
class Station:
    """A station seen by one frame: its landmark's id, its position (2,) in world and covariance (2, 2)."""

    landmark: int
    point_m: Floats
    cov: Floats

    def edge(self, frame_id: int, T_world_ego: SE2) -> LandmarkEdge:
        """The CP edge of frame `frame_id` with the ego at `T_world_ego`."""
        x_m, y_m = (T_world_ego.inverse() @ self.point_m).tolist()
        R = T_world_ego.rotation()
        cov = tuple((R.T @ self.cov @ R).ravel().tolist())
        return LandmarkEdge(
            landmark=self.landmark, frame=frame_id, x_m=x_m, y_m=y_m, cov=cov, kind=LandmarkKind.LANE_STATION
        )


def fit_stations(points_m: Floats, lanes: Ids, config: LaneEdgesConfig) -> list[tuple[int, Floats, Floats]]:
    """(landmark, point (2,), direction (2,)) from points (N, 2) in world and their lanes (N,).

    Stations lie on lines of constant x or y, whichever is closer to perpendicular to the lane.
    """
    found = []
    for lane in np.unique(lanes[lanes >= 0]).tolist():
        points = points_m[lanes == lane]
        spread = points - points.mean(axis=0)
        axis = int(np.argmax(np.abs(np.linalg.svd(spread, full_matrices=False)[2][0])))
        cells = np.floor(points[:, axis] / config.station_m).astype(np.int64)
        for cell in np.unique(cells).tolist():
            along, across = points[cells == cell][:, [axis, 1 - axis]].T
            middle_m = (cell + 0.5) * config.station_m
            if len(along) < config.least_points or np.ptp(along) < _MIN_SPAN_RATIO * config.station_m:
                continue
            gap_m = along - along.mean()
            slope = float(gap_m @ across) / float(gap_m @ gap_m)  # numpy.polyfit is slower
            at_m = float(across.mean()) + slope * (middle_m - float(along.mean()))
            if np.std(across - slope * gap_m) > config.bend_m:
                continue
            point, direction = np.array([middle_m, at_m]), np.array([1.0, slope]) / np.hypot(1.0, slope)
            landmark = (2 * int(lane) + axis) * _CELLS + cell % _CELLS
            found.append((landmark, *((point, direction) if axis == 0 else (point[::-1], direction[::-1]))))
    return found


def lane_stations(
    points_m: Floats,
    lanes: Ids,
    T_world_ego: SE2,
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    sigma_height_rel: float,
    config: LaneEdgesConfig,
) -> list[Station]:
    """The stations seen by one frame, nearest first; `points_m` (N, 2) in world, the rest is of that frame."""
    T_ego_world = T_world_ego.inverse()
    seen = [
        (T_ego_world @ point, landmark, point, along)
        for landmark, point, along in fit_stations(points_m, lanes, config)
    ]
    seen = sorted((s for s in seen if s[0][0] > 0.0), key=lambda s: float(s[0][0]))[: config.max_edges]
    if not seen:
        return []
    px = bev.ego_to_pixel(camera, ground, np.array([s[0] for s in seen]))
    by_image = bev.road_point_cov(camera, ground, px, config.sigma_px, sigma_pitch_rad, sigma_height_rel)
    R = T_world_ego.rotation()
    out = []
    for (_, landmark, point, along), cov_ego in zip(seen, by_image, strict=True):
        across = np.array([-along[1], along[0]])
        variance = float(across @ R @ cov_ego @ R.T @ across) + config.sigma_across_m**2
        if np.isfinite(variance):
            cov = np.outer(across, across) * variance + np.outer(along, along) * config.sigma_along_m**2
            out.append(Station(landmark, point, cov))
    return out
