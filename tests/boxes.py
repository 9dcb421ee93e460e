"""Boxes of cuboid cars in images of a plane road."""

from __future__ import annotations

import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import DIMENSIONS
from tests.recordings import KITTI

CAR = DIMENSIONS["car"]


def footprint_m(T_ego_car: SE2, length_m: float = CAR.length_m, width_m: float = CAR.width_m) -> Floats:
    """(4, 2) corners in ego of a car with its centre there."""
    return T_ego_car @ np.array([(sl * length_m / 2, sw * width_m / 2) for sl in (-1, 1) for sw in (-1, 1)])


def cuboid_px(
    on_road_m: Floats,
    height_m: float = CAR.height_m,
    ground: GroundPlane = KITTI.ground,
    camera: Camera = KITTI,
    lift_m: float = 0.0,
) -> Floats:
    """x1, y1, x2, y2 of a cuboid over these corners, which may exceed the image."""
    corners = np.vstack([np.column_stack([on_road_m, np.full(len(on_road_m), z + lift_m)]) for z in (0.0, height_m)])
    px = bev.ego_to_pixel(camera, ground, corners)
    return np.array([*px.min(axis=0), *px.max(axis=0)])


def car_px(T_ego_car: SE2, height_m: float = CAR.height_m, ground: GroundPlane = KITTI.ground) -> Floats:
    """The box of a car as cars are, in KITTI's camera."""
    return cuboid_px(footprint_m(T_ego_car), height_m, ground)
