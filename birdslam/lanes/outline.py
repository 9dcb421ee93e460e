"""The area of a lane in the image as an outline or a mask, and a line as a polyline.

`vertical_per_m` is the road's vertical curvature over the ground (`Lanes.vertical_curvature_per_m`).
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.types import Lane, LaneLine

FROM_M, STEP_M = 1.0, 0.5  # first point and spacing of an outline
_FAR_PX = 20_000.0  # limit of coordinates for OpenCV's drawing


def line_px(
    camera: Camera, ground: GroundPlane, line: LaneLine, from_m: float = FROM_M, vertical_per_m: float = 0.0
) -> Floats:
    """(N, 2) pixels of a line from `from_m` to the end of its known range or to a crest."""
    x_m = _distances_m(ground, from_m, line.to_m, vertical_per_m)
    return _px(camera, ground, x_m, np.array([line.y_m(x) for x in x_m.tolist()]), vertical_per_m)


def lane_px(
    camera: Camera, ground: GroundPlane, lane: Lane, from_m: float = FROM_M, vertical_per_m: float = 0.0
) -> Floats:
    """(N, 2) pixels of the polygon around a lane from `from_m`: along its left bound, back along its right one."""
    x_m = _distances_m(ground, from_m, lane.to_m, vertical_per_m)
    left = _px(camera, ground, x_m, np.array([lane.left_m(x) for x in x_m.tolist()]), vertical_per_m)
    right = _px(camera, ground, x_m, np.array([lane.right_m(x) for x in x_m.tolist()]), vertical_per_m)
    return np.vstack([left, right[::-1]])


def lane_mask(camera: Camera, ground: GroundPlane, lane: Lane) -> Bools:
    """(H, W) area of a lane in the image, vehicles on it included."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    outline = lane_px(camera, ground, lane)
    if len(outline) > 2:
        cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 1)
    return mask > 0


def _distances_m(ground: GroundPlane, from_m: float, to_m: float, vertical_per_m: float) -> Floats:
    """Distances along a line up to where the line of sight touches a crest."""
    touches_m = math.sqrt(2.0 * ground.height_m / -vertical_per_m) if vertical_per_m < 0.0 else math.inf
    return np.arange(from_m, min(to_m, touches_m), STEP_M)


def _px(camera: Camera, ground: GroundPlane, x_m: Floats, y_m: Floats, vertical_per_m: float) -> Floats:
    px = bev.ego_to_pixel(camera, ground, np.column_stack([x_m, y_m, 0.5 * vertical_per_m * x_m * x_m]))
    out: Floats = np.clip(px[np.isfinite(px).all(axis=1)], -_FAR_PX, _FAR_PX)
    return out
