"""CP edges of lanes (Eq. 3): one frame's lane markings against the lanes that earlier frames put on the map.

A point of a line can't be recognised along the line, so a landmark is a *station*: the crossing of a lane with a line
of a grid in world. An edge measures the lane's position across its direction; along it the covariance is large. Only
what one frame saw makes edges: the completed lanes combine many frames by the odometry that the edges are to correct.
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

_CELLS = 1 << 20  # stations of one lane along one axis, before their ids repeat: 4000 km
_MIN_SPAN = 0.7  # of a station's length that its points must span: a line through fewer follows their noise


class LaneEdgesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which points of a lane become CP edges, and their uncertainty."""

    station_m: float = 4.0  # between two of a lane's landmarks
    least_points: int = 8  # of a station
    sigma_px: float = 1.0  # of the markings' mask
    sigma_across_m: float = 0.1  # across the marking: half of a painted line's width
    sigma_along_m: float = 10.0  # along the lane: unknown
    bend_m: float = 0.25  # of a station's points about their line, at the most
    max_edges: int = 16  # of a frame, the nearest
    # One frame's stations are repeated in this many more, moved by the odometry, since a segmenter that does not run on
    # each frame need not run on the graph's keyframes. Fewer than lie between two of those, so that none counts twice
    carried_frames: int = 3


@dataclass(frozen=True)
class Station:
    """A station seen by one frame: its landmark's id, its position (2,) in world and the covariance (2, 2) of that."""

    landmark: int
    point_m: Floats
    cov: Floats

    def edge(self, frame_id: int, T_world_ego: SE2) -> LandmarkEdge:
        """The CP edge of a frame in which the ego is at `T_world_ego`."""
        x_m, y_m = (T_world_ego.inverse() @ self.point_m).tolist()
        R = T_world_ego.rotation()
        cov = tuple((R.T @ self.cov @ R).ravel().tolist())
        return LandmarkEdge(
            landmark=self.landmark, frame=frame_id, x_m=x_m, y_m=y_m, cov=cov, kind=LandmarkKind.LANE_STATION
        )


def stations(points_m: Floats, lanes: Ids, config: LaneEdgesConfig) -> list[tuple[int, Floats, Floats]]:
    """(landmark, point (2,), direction (2,)) of points (N, 2) in world, each known to be on a lane of `lanes` (N,).

    Stations lie on lines of constant x or y, whichever the lane crosses more squarely.
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
            if len(along) < config.least_points or np.ptp(along) < _MIN_SPAN * config.station_m:
                continue
            gap_m = along - along.mean()
            slope = float(gap_m @ across) / float(gap_m @ gap_m)  # numpy.polyfit takes ten times as long
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
    """The stations that one frame saw, nearest first; `points_m` (N, 2) in world, the rest is of that frame."""
    T_ego_world = T_world_ego.inverse()
    seen = [
        (T_ego_world @ point, landmark, point, along) for landmark, point, along in stations(points_m, lanes, config)
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
