"""Places of vehicles by depth, the second source of the paper's dynamic object localization.

A depth map gives a point per pixel, the pseudo-lidar; the points in a vehicle's box are its frustum. The body comes
from a Frustum-PointNet, from a detector that estimates bodies itself, or from a fit of the class's footprint to the
points (body_fit.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import road_point_cam
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import wrap
from birdslam.perception import Boxes3d, DepthMap, Detections
from birdslam.road_users.placement.body_fit import fit_footprint
from birdslam.road_users.placement.depth_fusion import DepthPlace, PseudoLidarConfig, lateral_variance
from birdslam.road_users.placement.localisation import Dimensions, Observation, corners_of, line_of_sight_cov

Floats = NDArray[np.float64]

MIN_ROAD_CELLS = 50  # of the map, for a scale


class FrustumNetwork(Protocol):
    """Estimates a body from the points of each frustum, as `perception.pointnet.PointNet` does."""

    def locate(self, frusta_cam_m: Sequence[Floats], labels: Sequence[str], camera: Camera) -> Boxes3d | None: ...


def locate_by_depth(
    observations: list[Observation],
    detections: Detections,
    depth: DepthMap | None,
    camera: Camera,
    ground: GroundPlane,
    config: PseudoLidarConfig,
    road: NDArray[np.bool_] | None = None,
    network: FrustumNetwork | None = None,
) -> tuple[list[Observation], list[DepthPlace | None]]:
    """Returns the observations and the place by depth of each (N each), None without one.

    Bodies from the detector need no depth map; they also measure the lengths of the observations. `depth` and the mask
    `road` (H, W) are of the same frame.
    """
    if detections.boxes3d is not None and network is None:
        return locate_detected_bodies(observations, detections, camera, ground, config)
    if depth is None:
        return observations, [None] * len(observations)
    return observations, locate_in_depth_map(observations, depth, camera, ground, config, road, network)


def locate_detected_bodies(
    seen: Sequence[Observation], detections: Detections, camera: Camera, ground: GroundPlane, config: PseudoLidarConfig
) -> tuple[list[Observation], list[DepthPlace | None]]:
    """For each observation, the body that the detector estimated for its box.

    The length is fused from class and body by their variances. The nearest face of the body keeps its place.
    """
    if detections.boxes3d is None or config.rule == "off":
        return list(seen), [None] * len(seen)
    bodies = detections.boxes3d.take([o.row for o in seen])
    measured = [
        msgspec.structs.replace(o, dimensions=_fuse_length(o.dimensions, *lengths))
        for o, *lengths in zip(seen, bodies.size_m[:, 0].tolist(), bodies.sigma_size_m[:, 0].tolist(), strict=True)
    ]
    places = make_places(bodies, measured, camera, ground)
    return measured, [p and _keep_face(p, o) for p, o in zip(places, measured, strict=True)]


def locate_in_depth_map(
    seen: Sequence[Observation],
    depth: DepthMap,
    camera: Camera,
    ground: GroundPlane,
    config: PseudoLidarConfig,
    road: NDArray[np.bool_] | None = None,
    network: FrustumNetwork | None = None,
) -> list[DepthPlace | None]:
    """A place for each observation in the frame of `depth`, None without usable depth.

    A map without metric scale needs the mask `road` (H, W). Bodies are fitted if the network returns nothing.
    """
    metres = in_metres(depth, camera, ground, road, config)
    if metres is None or config.rule == "off" or not seen:
        return [None] * len(seen)
    if network is not None:
        frusta = [frustum_points(o, metres, camera) for o in seen]
        able = [i for i, points in enumerate(frusta) if len(points) >= config.least_points]
        bodies = network.locate([frusta[i] for i in able], [seen[i].label for i in able], camera)
        if bodies is not None:
            # Add the errors of this depth map to the sigmas of the network
            widened = replace(bodies, sigma_depth_m=np.hypot(bodies.sigma_depth_m, metres.sigma_rel * bodies.depth_m))
            found = dict(zip(able, make_places(widened, [seen[i] for i in able], camera, ground), strict=True))
            return [found.get(i) for i in range(len(seen))]
    return [fit_footprint(o, metres, camera, ground, config) for o in seen]


def _fuse_length(of_class: Dimensions, length_m: float, sigma_m: float) -> Dimensions:
    sigma_class_m = of_class.sigma_length_rel * of_class.length_m
    share = sigma_class_m**2 / (sigma_class_m**2 + sigma_m**2)
    together_m = of_class.length_m + share * (length_m - of_class.length_m)
    return msgspec.structs.replace(
        of_class, length_m=together_m, sigma_length_rel=math.sqrt(1.0 - share) * sigma_class_m / together_m
    )


def _keep_face(place: DepthPlace, seen: Observation) -> DepthPlace:
    assert place.size_m is not None
    own = msgspec.structs.replace(seen.dimensions, length_m=place.size_m[0])
    own_m, together_m = (max(x for x, _ in corners_of(d, place.yaw_rad)) for d in (own, seen.dimensions))
    return msgspec.structs.replace(place, centre_m=place.centre_m * (1.0 + (together_m - own_m) / place.centre_m[0]))


def make_places(
    bodies: Boxes3d, seen: Sequence[Observation], camera: Camera, ground: GroundPlane
) -> list[DepthPlace | None]:
    """The bodies (N) of the observations (N) as places in ego; None for a body without an estimate."""
    bodies = bodies.in_metres(camera)
    poses = bodies.in_ego(camera, ground)
    return [
        DepthPlace(
            np.array([x_m, y_m]),
            line_of_sight_cov(y_m / x_m, sigma_depth_m**2, lateral_variance(o, x_m)),
            wrap(yaw_rad),
            sigma_yaw_rad,
            flip,
            tuple(size_m),
        )
        if x_m > 0.0 and math.isfinite(sigma_depth_m)
        else None
        for o, (x_m, y_m, yaw_rad), sigma_depth_m, sigma_yaw_rad, flip, size_m in zip(
            seen,
            poses.tolist(),
            bodies.sigma_depth_m.tolist(),
            bodies.sigma_alpha_rad.tolist(),
            bodies.flip.tolist(),
            bodies.size_m.tolist(),
            strict=True,
        )
    ]


def in_metres(
    depth: DepthMap,
    camera: Camera,
    ground: GroundPlane,
    road: NDArray[np.bool_] | None,
    config: PseudoLidarConfig,
) -> DepthMap | None:
    """The depth map in metres, scaled by Eq. 1 on the road if it is not metric; None if too little road is visible."""
    depth = depth.in_metres(camera)
    if depth.metric:
        return depth
    if road is None:
        return None
    factor = estimate_road_factor(depth, camera, ground, road, config)
    return None if factor is None else depth.scaled(factor)


def estimate_road_factor(
    depth: DepthMap, camera: Camera, ground: GroundPlane, road: NDArray[np.bool_], config: PseudoLidarConfig
) -> float | None:
    """Factor from the map to metres, by Eq. 1 on the near road; None if too little road is visible."""
    height, width = depth.depth_m.shape
    sx, sy = depth.scale
    u, v = np.meshgrid((np.arange(width) + 0.5) / sx - 0.5, (np.arange(height) + 0.5) / sy - 0.5)
    px = np.column_stack([u.ravel(), v.ravel()])
    rows, columns = np.rint(px[:, 1]).astype(np.int64), np.rint(px[:, 0]).astype(np.int64)
    px = px[road[np.clip(rows, 0, road.shape[0] - 1), np.clip(columns, 0, road.shape[1] - 1)]]
    z_m = road_point_cam(camera, ground, px)[:, 2] if len(px) else np.zeros(0)
    near = (z_m >= config.road_near_m) & (z_m <= config.road_far_m)
    if near.sum() < MIN_ROAD_CELLS:
        return None
    return float(np.median(z_m[near] / depth.at(px[near])))


def frustum_points(seen: Observation, depth: DepthMap, camera: Camera) -> Floats:
    """(N, 3) points of the pseudo-lidar in an observation's box, in the camera frame."""
    return depth.points_cam_m(camera, *depth.cells(seen.box_px))
