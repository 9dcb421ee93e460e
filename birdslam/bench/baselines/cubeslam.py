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

from birdslam.bench.baselines.posegraph3 import BatchConfig, optimise_batch
from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.weights import WeightsConfig
from birdslam.types import Measurements, VehicleEdge


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
    turns_rad = 2.0 * math.pi * np.arange(config.headings) / config.headings
    turns_rad -= 2.0 * math.pi * (turns_rad > math.pi)
    yaws_rad = edge.T_ego_vehicle.yaw_rad + turns_rad
    centres, widths_rad = _places(near_m, bearing, yaws_rad, edge.length_m, edge.width_m)
    misfit_px = widths_rad * camera.fx_px - width_px
    best = int(np.argmin((misfit_px / sigma_px) ** 2 + (turns_rad / config.sigma_prior_rad) ** 2))
    pose = SE2(float(centres[best, 0]), float(centres[best, 1]), float(yaws_rad[best]))
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


def _places(near_m: float, bearing: float, yaws_rad: Floats, length_m: float, width_m: float) -> tuple[Floats, Floats]:
    """Of cuboids with N headings the centres (N, 2), from the distance of the nearest edge and the middle of the
    outline, a bearing (y/x); and how wide the outlines are (N,), as differences of y/x."""
    halves = np.array([0.5 * sl * length_m + 0.5j * sw * width_m for sl in (-1, 1) for sw in (-1, 1)])
    corners = halves * np.exp(1j * yaws_rad)[:, None]
    x = near_m - corners.real.min(axis=1)
    y = bearing * x
    for _ in range(4):  # each step leaves about a tenth of the error
        outline = (y[:, None] + corners.imag) / np.maximum(x[:, None] + corners.real, 0.5)
        y += (bearing - 0.5 * (outline.max(axis=1) + outline.min(axis=1))) * x
    return np.column_stack([x, y]), np.ptp(outline, axis=1)
