"""Namdev et al., "Multibody VSLAM with relative scale solution for curvilinear motion reconstruction" (ICRA 2013).

Kept: ego and objects are reconstructed apart, each up to a scale of its own; an object's scale against the ego's is the
one for which its motion in the world is locally linear. Where both move uniformly every scale does (Fig. 1 of the
BirdSLAM paper): only then a wide prior on the object's size decides.
Not kept: motion segmentation and a reconstruction of each object from dense tracks. An object's reconstruction is here
the bearing of its box and its distance in unknown units, the inverse of the box's height. The ego's global scale, which
a monocular method can't know, is that of the log's odometry.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.bench.baselines.trajectories import Trajectories, dead_reckoned
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.types import Measurements, VehicleEdge


class NamdevConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The scale of an object is the height in metres that its box stands for."""

    window_frames: int = 41
    start_height_m: float = 1.5
    sigma_height_m: float = 0.5
    least_height_m: float = 0.4
    sigma_depth_rel: float = 0.03  # noise of the inverse of a box's height


def run(log: Sequence[Measurements], camera: Camera, config: NamdevConfig | None = None) -> Trajectories:
    """Trajectories of the whole log; each object's scale is that of the window around a frame."""
    config = config or NamdevConfig()
    ego = dead_reckoned(log).ego
    out = Trajectories(ego=ego)
    seen: dict[int, list[VehicleEdge]] = {}
    for m in log:
        for edge in m.cv:
            seen.setdefault(edge.vehicle, []).append(edge)
    for vehicle, edges in seen.items():
        poses = [ego[edge.frame] for edge in edges]
        origin = np.array([[pose.x_m, pose.y_m] for pose in poses])
        ray = np.array([pose.rotation() @ _unscaled(edge, camera) for pose, edge in zip(poses, edges, strict=True)])
        for k, edge in enumerate(edges):
            near = slice(max(0, k - config.window_frames // 2), k + config.window_frames // 2 + 1)
            at = origin[k] + _linear_scale(origin[near], ray[near], config) * ray[k]
            heading = poses[k].yaw_rad + edge.T_ego_vehicle.yaw_rad
            out.put_vehicle(vehicle, edge.frame, SE2(float(at[0]), float(at[1]), heading))
    return out


def _unscaled(edge: VehicleEdge, camera: Camera) -> Floats:
    """Towards the box, as long as one metre of height makes it: (2,) in ego."""
    x1, y1, x2, y2 = edge.box_px
    ahead = camera.fy_px / max(y2 - y1, 1.0)
    return np.array([ahead, ahead * (camera.cx_px - 0.5 * (x1 + x2)) / camera.fx_px])


def _linear_scale(origin: Floats, ray: Floats, config: NamdevConfig) -> float:
    """The scale s for which `origin + s * ray` (N, 2) bends least from uniform motion on a straight line.

    Where ego and object both move uniformly every s does equally well: the paper's Fig. 1. There the prior decides.
    """
    if len(origin) < 4:
        return config.start_height_m
    t = np.linspace(-1.0, 1.0, len(origin))
    line, _ = np.linalg.qr(np.column_stack([np.ones_like(t), t]))
    bend_origin, bend_ray = (p - line @ (line.T @ p) for p in (origin, ray))
    noise_m = config.sigma_depth_rel * config.start_height_m * float(np.linalg.norm(ray, axis=1).mean())
    prior = (noise_m / config.sigma_height_m) ** 2
    scale = config.start_height_m * prior - float((bend_origin * bend_ray).sum())
    return max(scale / (prior + float((bend_ray**2).sum())), config.least_height_m)
