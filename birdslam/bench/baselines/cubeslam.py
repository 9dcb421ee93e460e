"""Yang and Scherer, "CubeSLAM" (T-RO 2019): cuboids from 2-D boxes, optimised over many views together with the camera.

Kept: a cuboid of the class's size, proposals for sampled headings of which the best fitting is taken, one optimisation
over all views of camera motions, cuboid sightings and a motion model of objects (nearly constant velocity, hardly any
sideslip), scale from the camera's height. Not kept: ORB features on objects, alignment of proposals with line segments
(a log has no images), headings from vanishing points, and telling static objects from moving ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.baselines.posegraph3 import BatchConfig, optimise_batch
from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.weights import WeightsConfig
from birdslam.types import Measurements, VehicleEdge

Floats = NDArray[np.float64]

label = "CubeSLAM"


class CuboidConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors on size and heading, how well boxes fit, and how steadily vehicles move from one frame to the next."""

    height_m: float = 1.53
    sigma_height_rel: float = 0.06
    headings: int = 36  # sampled over the whole turn
    sigma_box_px: float = 3.0
    sigma_box_rel: float = 0.03
    sigma_prior_rad: float = 0.4  # of the heading against the log's, without which front and back look alike
    sigma_heading_rad: float = 0.2  # of the proposal taken
    sigma_side_rad: float = 0.005
    steady_motion: tuple[float, float, float] = (0.1, 0.03, 0.01)


def run(log: Sequence[Measurements], camera: Camera, config: CuboidConfig | None = None) -> Trajectories:
    """Trajectories of the whole log at once."""
    config = config or CuboidConfig()
    cuboids = [msgspec.structs.replace(m, cv=tuple(cuboid(edge, camera, config) for edge in m.cv)) for m in log]
    batch = BatchConfig(metric=True, steady_motion=config.steady_motion, weights=WeightsConfig(mode="measured"))
    return optimise_batch(cuboids, batch)


def cuboid(edge: VehicleEdge, camera: Camera, config: CuboidConfig) -> VehicleEdge:
    """The sighting with its pose and covariance from the cuboid that fits the box best."""
    x1, y1, x2, y2 = edge.box_px
    width_px, height_px = max(x2 - x1, 1.0), max(y2 - y1, 1.0)
    # The nearest upright edge of a cuboid is the tallest in the image: the box's height gives its distance
    near_m = camera.fy_px * config.height_m / height_px
    bearing = (camera.cx_px - 0.5 * (x1 + x2)) / camera.fx_px
    sigma_px = config.sigma_box_px + config.sigma_box_rel * width_px
    best = (math.inf, edge.T_ego_vehicle)
    for k in range(config.headings):
        turn_rad = 2.0 * math.pi * k / config.headings
        turn_rad -= 2.0 * math.pi * (turn_rad > math.pi)
        yaw_rad = edge.T_ego_vehicle.yaw_rad + turn_rad
        centre, width_rad = _place(near_m, bearing, yaw_rad, edge.length_m, edge.width_m)
        misfit_px = width_rad * camera.fx_px - width_px
        cost = (misfit_px / sigma_px) ** 2 + (turn_rad / config.sigma_prior_rad) ** 2
        if cost < best[0]:
            best = (cost, SE2(float(centre[0]), float(centre[1]), yaw_rad))
    pose = best[1]
    away_m = math.hypot(pose.x_m, pose.y_m)
    sigma_px = config.sigma_box_px + config.sigma_box_rel * height_px
    along = away_m * math.hypot(sigma_px / height_px, config.sigma_height_rel)
    sight = np.array([pose.x_m, pose.y_m]) / max(away_m, 1e-6)
    cov = np.zeros((3, 3))
    cov[:2, :2] = along**2 * np.outer(sight, sight) + (config.sigma_side_rad * away_m + 0.1) ** 2 * np.eye(2)
    cov[2, 2] = config.sigma_heading_rad**2
    # The graph states an edge's covariance in the vehicle's own axes
    R = SE2(yaw_rad=-pose.yaw_rad).rotation()
    cov[:2, :2] = R @ cov[:2, :2] @ R.T
    return msgspec.structs.replace(edge, T_ego_vehicle=pose, cov=tuple(cov.ravel().tolist()))


def _place(near_m: float, bearing: float, yaw_rad: float, length_m: float, width_m: float) -> tuple[Floats, float]:
    """The centre (2,) of a cuboid from the distance of its nearest edge and the middle of its outline, a bearing (y/x);
    and how wide the outline is (difference of y/x)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    halves = np.array([[sl * length_m, sw * width_m] for sl in (-0.5, 0.5) for sw in (-0.5, 0.5)])
    corners = halves @ np.array([[c, s], [-s, c]])
    centre = np.array([near_m - corners[:, 0].min(), 0.0])
    centre[1] = bearing * centre[0]
    for _ in range(4):  # each step leaves about a tenth of the error
        outline = (centre[1] + corners[:, 1]) / np.maximum(centre[0] + corners[:, 0], 0.5)
        centre[1] += (bearing - 0.5 * (outline.max() + outline.min())) * centre[0]
    return centre, float(np.ptp(outline))
