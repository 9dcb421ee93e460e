"""Vehicles in bird's-eye view from their boxes: Eq. 1 on the bottom edge (paper, dynamic object localization).

The bottom edge is the vehicle's nearest face. The centre of its footprint lies half of its extent along the line of
sight further on, which takes its dimensions (a prior of its class) and its yaw against the ego.
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
    """What a class of vehicle measures, and how much its members differ (1-sigma of the length)."""

    length_m: float
    width_m: float
    sigma_length_m: float


DIMENSIONS = {
    "car": Dimensions(4.0, 1.7, 0.5),
    "van": Dimensions(5.0, 1.9, 0.7),
    "truck": Dimensions(7.0, 2.4, 2.0),
    "bus": Dimensions(11.0, 2.5, 2.0),
    "motorcycle": Dimensions(2.1, 0.8, 0.3),
}

CENTRE_STEPS = 3  # each leaves about a tenth of the error


class LocalisationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How boxes become places; the class table also says which labels are vehicles."""

    vehicles: dict[str, Dimensions] = msgspec.field(default_factory=lambda: dict(DIMENSIONS))
    sigma_box_rel: float = 0.02  # a detector's edges scatter with the size of the box
    sigma_box_px: float = 1.5
    sigma_height_rel: float = 0.02  # of the camera over the road
    sigma_cut_rel: float = 0.5  # an edge cut by the image says nothing within half the box
    cut_margin_px: float = 3.0
    same_vehicle_iou: float = 0.6  # boxes of different classes on one vehicle: the better score stays
    max_range_m: float = 80.0


@dataclass(frozen=True)
class Observation:
    """One vehicle in one frame, in ego. `near_m` is Eq. 1 on the box's bottom centre, `centre_m` the footprint's."""

    label: str
    score: float
    box_px: tuple[float, float, float, float]
    near_m: NDArray[np.float64]  # (2,)
    centre_m: NDArray[np.float64]  # (2,)
    cov: NDArray[np.float64]  # (2, 2) of centre_m
    dimensions: Dimensions


def iou(a_px: NDArray[np.float64], b_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection over union, (A, B), of boxes (A, 4) and (B, 4) given as x1, y1, x2, y2."""
    a, b = np.reshape(a_px, (-1, 1, 4)), np.reshape(b_px, (1, -1, 4))
    span = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0.0, None)
    shared = span[..., 0] * span[..., 1]
    area_a = (a[..., 2] - a[..., 0]) * (a[..., 3] - a[..., 1])
    area_b = (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    out: NDArray[np.float64] = shared / np.maximum(area_a + area_b - shared, 1e-9)
    return out


def centre_of(
    near_m: NDArray[np.float64], bearing: float, dimensions: Dimensions, yaw_rad: float
) -> NDArray[np.float64]:
    """The footprint's centre (2,) in ego from its nearest depth and the bearing (y/x) of the box's middle column.

    `yaw_rad` is the vehicle's against the ego. The middle of an oblique vehicle's outline is not the column of its
    centre: the centre is moved sideways until the bearings of its outermost corners have the box's middle.
    """
    forward, left = np.array([math.cos(yaw_rad), math.sin(yaw_rad)]), np.array([-math.sin(yaw_rad), math.cos(yaw_rad)])
    halves = dimensions.length_m / 2.0 * forward, dimensions.width_m / 2.0 * left
    corners = np.array([sl * halves[0] + sw * halves[1] for sl in (-1, 1) for sw in (-1, 1)])
    centre = np.array([near_m[0] - corners[:, 0].min(), 0.0])
    centre[1] = bearing * centre[0]
    for _ in range(CENTRE_STEPS):
        x, y = (centre + corners).T
        outline = y / np.maximum(x, 0.1)
        centre[1] += (bearing - (outline.max() + outline.min()) / 2.0) * centre[0]
    return centre


def localise(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    labels: tuple[str, ...],
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    config: LocalisationConfig,
) -> list[Observation]:
    """The vehicles among the boxes (N, 4), best score first, headed like the ego until a track knows better.

    A box whose bottom lies above the horizon or past `max_range_m` has no place on the road and is left out.
    """
    found: list[Observation] = []
    taken: list[NDArray[np.float64]] = []
    for i in np.argsort(-scores, kind="stable"):
        dimensions, box = config.vehicles.get(labels[i]), boxes_px[i]
        if dimensions is None or (taken and iou(box, np.array(taken)).max() > config.same_vehicle_iou):
            continue
        foot_px = np.array([[(box[0] + box[2]) / 2.0, box[3]]])
        near = bev.pixel_to_ego(camera, ground, foot_px)[0]  # Eq. 1
        if not np.isfinite(near).all() or not 0.0 < near[0] < config.max_range_m:
            continue
        width_px, height_px = box[2] - box[0], box[3] - box[1]
        cut_side = box[0] < config.cut_margin_px or box[2] > camera.width_px - config.cut_margin_px
        cut_bottom = box[3] > camera.height_px - config.cut_margin_px
        sigma_px = np.array(
            [
                (config.sigma_cut_rel if cut_side else config.sigma_box_rel) * width_px + config.sigma_box_px,
                (config.sigma_cut_rel if cut_bottom else config.sigma_box_rel) * height_px + config.sigma_box_px,
            ]
        )
        cov = bev.road_point_cov(camera, ground, foot_px, sigma_px, sigma_pitch_rad, config.sigma_height_rel)[0]
        bearing = near[1] / near[0]
        along = np.array([1.0, bearing])
        cov = cov + (dimensions.sigma_length_m / 2.0) ** 2 * np.outer(along, along)
        if not np.isfinite(cov).all():  # the pixel noise reaches past the horizon
            continue
        taken.append(box)
        found.append(
            Observation(
                label=labels[i],
                score=float(scores[i]),
                box_px=(float(box[0]), float(box[1]), float(box[2]), float(box[3])),
                near_m=near,
                centre_m=centre_of(near, bearing, dimensions, yaw_rad=0.0),
                cov=cov,
                dimensions=dimensions,
            )
        )
    return found
