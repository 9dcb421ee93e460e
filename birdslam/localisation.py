"""Vehicles in bird's-eye view from their boxes (paper, dynamic object localization).

The paper's Eq. 1 on the bottom edge gives the depth of a vehicle's nearest face. The size of the box gives it too, from
what the vehicle measures: a prior of its class at first, then what was learned while the road under it was in view. The
two are fused by their variances, so that a box whose bottom the image cuts off still has an honest depth. The centre of
the footprint lies half of the vehicle's extent along the line of sight further on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam import bev
from birdslam.camera import Camera, GroundPlane


class Dimensions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a class of vehicle measures, and how much its members differ (1-sigma, as a fraction)."""

    length_m: float
    width_m: float
    height_m: float
    sigma_length_rel: float = 0.12
    sigma_width_rel: float = 0.3  # of the outline across the line of sight: the length shows too where it is oblique
    sigma_height_rel: float = 0.08


DIMENSIONS = {
    "car": Dimensions(4.0, 1.7, 1.53),
    "van": Dimensions(5.0, 1.9, 2.1, sigma_height_rel=0.12),
    "truck": Dimensions(7.0, 2.4, 3.0, sigma_length_rel=0.3, sigma_height_rel=0.2),
    "bus": Dimensions(11.0, 2.5, 3.1, sigma_length_rel=0.2, sigma_height_rel=0.1),
    "motorcycle": Dimensions(2.1, 0.8, 1.6, sigma_height_rel=0.12),
}
NO_MEASUREMENT_REL = 1e3
CENTRE_STEPS = 3  # each leaves about a tenth of the error


class LocalisationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How boxes become places; the class table also says which labels are vehicles."""

    vehicles: dict[str, Dimensions] = msgspec.field(default_factory=lambda: dict(DIMENSIONS))
    sigma_box_rel: float = 0.02  # a detector's edges scatter with the size of the box
    sigma_box_px: float = 1.5
    sigma_camera_height_rel: float = 0.02
    sigma_road_rad: float = 0.003  # of the road under the vehicle against the road under the ego
    sigma_cut_rel: float = 1.0  # an edge cut by the image says nothing within the whole box
    cut_margin_px: float = 4.0
    cut_margin_rel: float = 0.1  # of the box: detectors draw an edge that the image cuts off a little inside of it
    size_floor_rel: float = 0.03  # a learned size is never surer: it has the ground plane's common error in it
    width_drift_rel: float = 0.01  # a frame: the outline turns with the line of sight
    same_vehicle_iou: float = 0.6  # boxes of different classes on one vehicle: the better score stays
    max_range_m: float = 80.0


@dataclass(frozen=True)
class Observation:
    """One vehicle's box in one frame.

    `bearing` is y/x in ego of its middle column; `depth_m` (ego's x of the nearest face) is Eq. 1 on its bottom edge;
    `tan_height` and `tan_width` are its size at a depth of 1. Sigmas of depths and sizes are fractions.
    """

    label: str
    score: float
    box_px: tuple[float, float, float, float]
    bearing: float
    sigma_bearing: float
    depth_m: float
    sigma_depth_rel: float
    tan_height: float
    sigma_height_rel: float
    tan_width: float
    sigma_width_rel: float
    dimensions: Dimensions


@dataclass(frozen=True)
class Outline:
    """A vehicle's height and width across the line of sight, as logarithms of metres with variances."""

    log_height: float
    var_height: float
    log_width: float
    var_width: float

    @staticmethod
    def of_class(dimensions: Dimensions) -> Outline:
        """What is known of a vehicle before it was measured."""
        return Outline(
            math.log(dimensions.height_m),
            dimensions.sigma_height_rel**2,
            math.log(dimensions.width_m),
            dimensions.sigma_width_rel**2,
        )


@dataclass(frozen=True)
class Place:
    """Where an observed vehicle is in ego: its nearest face's depth, its footprint's centre (2,), and cov (2, 2)."""

    depth_m: float
    centre_m: NDArray[np.float64]
    cov: NDArray[np.float64]


def iou(a_px: NDArray[np.float64], b_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection over union, (A, B), of boxes (A, 4) and (B, 4) given as x1, y1, x2, y2."""
    a, b = np.reshape(a_px, (-1, 1, 4)), np.reshape(b_px, (1, -1, 4))
    span = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0.0, None)
    shared = span[..., 0] * span[..., 1]
    area_a = (a[..., 2] - a[..., 0]) * (a[..., 3] - a[..., 1])
    area_b = (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    out: NDArray[np.float64] = shared / np.maximum(area_a + area_b - shared, 1e-9)
    return out


def centre_of(depth_m: float, bearing: float, dimensions: Dimensions, yaw_rad: float) -> NDArray[np.float64]:
    """The footprint's centre (2,) in ego from its nearest depth and the bearing (y/x) of the box's middle column.

    `yaw_rad` is the vehicle's against the ego. The middle of an oblique vehicle's outline is not the column of its
    centre: the centre is moved sideways until the bearings of its outermost corners have the box's middle.
    """
    forward, left = np.array([math.cos(yaw_rad), math.sin(yaw_rad)]), np.array([-math.sin(yaw_rad), math.cos(yaw_rad)])
    halves = dimensions.length_m / 2.0 * forward, dimensions.width_m / 2.0 * left
    corners = np.array([sl * halves[0] + sw * halves[1] for sl in (-1, 1) for sw in (-1, 1)])
    centre = np.array([depth_m - corners[:, 0].min(), 0.0])
    centre[1] = bearing * centre[0]
    for _ in range(CENTRE_STEPS):
        x, y = (centre + corners).T
        outline = y / np.maximum(x, 0.1)
        centre[1] += (bearing - (outline.max() + outline.min()) / 2.0) * centre[0]
    return centre


def place(seen: Observation, outline: Outline, yaw_rad: float, config: LocalisationConfig) -> tuple[Place, Outline]:
    """The observation's place in ego by Eq. 1 and by the size of the box, and the outline with what was learned.

    In logarithms a depth is the difference of a size and its angle, so that the cues are fused as they are:
    log depth = log height - log tan_height = log width - log tan_width = log of Eq. 1.
    """
    road = (math.log(seen.depth_m), seen.sigma_depth_rel**2)
    var_height, var_width = seen.sigma_height_rel**2, seen.sigma_width_rel**2
    log_tan_height, log_tan_width = math.log(seen.tan_height), math.log(seen.tan_width)
    by_height = (outline.log_height - log_tan_height, outline.var_height + var_height)
    by_width = (outline.log_width - log_tan_width, outline.var_width + var_width)
    log_depth, var_depth = fuse(road, by_height, by_width)

    # What the road says of the size, and only it: a prior that comes back through another cue would be counted twice.
    log_height, learned_height = fuse(
        (outline.log_height, outline.var_height), (road[0] + log_tan_height, road[1] + var_height)
    )
    log_width, learned_width = fuse(
        (outline.log_width, outline.var_width), (road[0] + log_tan_width, road[1] + var_width)
    )
    floor = config.size_floor_rel**2
    learned = Outline(
        log_height, max(learned_height, floor), log_width, max(learned_width, floor) + config.width_drift_rel**2
    )

    depth_m = math.exp(log_depth)
    centre = centre_of(depth_m, seen.bearing, seen.dimensions, yaw_rad)
    along, across = np.array([1.0, seen.bearing]), np.array([0.0, 1.0])
    sigma_reach_m = seen.dimensions.sigma_length_rel * (centre[0] - depth_m)
    cov = (depth_m**2 * var_depth + sigma_reach_m**2) * np.outer(along, along)
    cov += (centre[0] * seen.sigma_bearing) ** 2 * np.outer(across, across)
    return Place(depth_m, centre, cov), learned


def fuse(*estimates: tuple[float, float]) -> tuple[float, float]:
    """Mean and variance of independent (mean, variance) of the same number, weighted by their information."""
    information = sum(1.0 / variance for _, variance in estimates)
    return sum(mean / variance for mean, variance in estimates) / information, 1.0 / information


def localise(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    labels: tuple[str, ...],
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    config: LocalisationConfig,
) -> list[Observation]:
    """The vehicles among the boxes (N, 4), best score first.

    A box whose bottom lies above the horizon or past `max_range_m` has no place on the road and is left out.
    """
    found: list[Observation] = []
    taken: list[NDArray[np.float64]] = []
    for i in np.argsort(-scores, kind="stable"):
        dimensions, box = config.vehicles.get(labels[i]), boxes_px[i]
        if dimensions is None or (taken and iou(box, np.array(taken)).max() > config.same_vehicle_iou):
            continue
        observation = _observe(box, float(scores[i]), labels[i], dimensions, camera, ground, sigma_pitch_rad, config)
        if observation is not None:
            taken.append(box)
            found.append(observation)
    return found


def _observe(
    box: NDArray[np.float64],
    score: float,
    label: str,
    dimensions: Dimensions,
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    config: LocalisationConfig,
) -> Observation | None:
    x1, y1, x2, y2 = (float(edge) for edge in box)
    width_px, height_px = x2 - x1, y2 - y1
    if width_px < 1.0 or height_px < 1.0:
        return None
    foot_px = np.array([[(x1 + x2) / 2.0, y2]])
    near = bev.pixel_to_ego(camera, ground, foot_px)[0]  # Eq. 1
    if not np.isfinite(near).all() or not 0.0 < near[0] < config.max_range_m:
        return None
    sigma_edge = np.array([width_px, height_px]) * config.sigma_box_rel + config.sigma_box_px
    margin_px = config.cut_margin_px
    cut_side = x1 < margin_px or x2 > camera.width_px - margin_px
    cut_top = y1 < margin_px
    cut_bottom = y2 > camera.height_px - margin_px - config.cut_margin_rel * height_px
    road_rad = math.hypot(sigma_pitch_rad, config.sigma_road_rad, float(sigma_edge[1]) / camera.fy_px)
    # d depth / d angle is depth^2 / height. A cut bottom is no measurement at all, only a bound.
    sigma_depth_rel = math.hypot(near[0] / ground.height_m * road_rad, config.sigma_camera_height_rel)
    cut_rel = config.sigma_cut_rel
    return Observation(
        label=label,
        score=score,
        box_px=(x1, y1, x2, y2),
        bearing=float(near[1] / near[0]),
        sigma_bearing=float(cut_rel * width_px if cut_side else sigma_edge[0]) / camera.fx_px,
        depth_m=float(near[0]),
        sigma_depth_rel=NO_MEASUREMENT_REL if cut_bottom else sigma_depth_rel,
        tan_height=height_px / camera.fy_px,
        sigma_height_rel=float(cut_rel if cut_bottom or cut_top else 1.4 * sigma_edge[1] / height_px),
        tan_width=width_px / camera.fx_px,
        sigma_width_rel=float(cut_rel if cut_side else 1.4 * sigma_edge[0] / width_px),
        dimensions=dimensions,
    )
