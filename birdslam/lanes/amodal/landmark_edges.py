"""Static map initialisation (paper, Sec. 3.1): CP edges of feature tracks on the road, back-projected by Eq. 1.

The other landmarks are stations of lanes (lane_edges.py).
"""

from __future__ import annotations

import msgspec
import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.types import LandmarkEdge


class StaticMapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which points of the road become landmarks (here) and lane points (lane_mapper.py)."""

    max_landmarks: int = 40  # of a frame
    landmark_range_m: float = 20.0  # the paper's depth threshold T
    sigma_landmark_px: float = 1.0  # 1-sigma of a landmark in the image
    sigma_height_rel: float = 0.02  # of the camera's height over the road there
    max_lane_points: int = 64  # of a frame
    lane_range_m: float = 20.0  # of lane points
    lane_cell_m: float = 0.5  # one lane point per cell
    attitude_memory_m: float = 1000.0  # correlation length of the camera's tilt; roads are level on average


def landmark_edges(
    ids: Ints,
    px: Floats,
    frame_id: int,
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    config: StaticMapConfig,
    vertical_per_m: float = 0.0,
) -> tuple[LandmarkEdge, ...]:
    """CP edges of the nearest feature tracks that lie on the road: `ids` (N,) at pixels `px` (N, 2).

    `vertical_per_m` is the road's vertical curvature.
    """
    points = bev.pixel_to_ego(camera, ground, px, vertical_per_m)  # Eq. 1
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero(points[:, 0] < config.landmark_range_m)
    near = near[np.argsort(points[near, 0], kind="stable")][: config.max_landmarks]
    J = bev.road_point_errors(
        camera,
        ground,
        px[near],
        config.sigma_landmark_px,
        sigma_pitch_rad,
        config.sigma_height_rel,
        vertical_per_m,
    )
    flat, shared = (J @ np.swapaxes(J, 1, 2)).reshape(-1, 4), J[:, :, 2:].reshape(-1, 4)
    known = np.isfinite(flat).all(axis=1)
    near, flat, shared = near[known], flat[known], shared[known]
    numbers = zip(ids[near].tolist(), points[near].tolist(), flat.tolist(), shared.tolist(), strict=True)
    return tuple(
        LandmarkEdge(landmark=landmark, frame=frame_id, x_m=x_m, y_m=y_m, cov=tuple(cov), shared=tuple(moved))
        for landmark, (x_m, y_m), cov, moved in numbers
    )
