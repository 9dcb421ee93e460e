"""The road from above, resampled from the image for the detection of lines.

Rows are at growing distances, as far apart as the image resolves; columns are a regular lattice across the road. So a
painted line is equally wide in all rows.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats, Floats32
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.perception import Segmentation

Grid = Floats32

MIN_ROW_DISTANCE_M = 3.0  # first row; most cameras see the road from 5 m on
MAX_ROW_DISTANCE_M = 50.0
MAX_BONNET_DISTANCE_M = 15.0  # max. distance at which a bonnet covers the road
ROW_STEP_M = 0.25  # between near rows
HALF_WIDTH_M = 10.0  # half length of a row
LATTICE_M = 0.04  # spacing of columns: a painted line of 0.12 m has three


@dataclass(frozen=True)
class RoadView:
    """An image and its masks from above: (R, C) over increasing `x_m` (R,) and `y_m` (C,).

    `outside` marks cells outside the image, `hidden` cells that vehicles cover.
    """

    x_m: Floats
    y_m: Floats
    row_m: Floats  # (R,) length of road of a row
    sigma_y_m: Floats  # (R,) one pixel across the road
    pixel_rad: float  # one pixel in the slope of a ray
    grey: Grid
    road: Bools
    paint: Bools
    hidden: Bools
    outside: Bools
    excess: Grid | None  # yellow: (red + green) / 2 - blue; None for a grey image


@functools.lru_cache(maxsize=4)
def _columns_m() -> Floats:
    out: Floats = np.arange(-HALF_WIDTH_M, HALF_WIDTH_M + 0.5 * LATTICE_M, LATTICE_M)
    out.flags.writeable = False
    return out


def _rows_m(fy_px: float, height_m: float) -> Floats:
    """Distances of the rows: `ROW_STEP_M` apart, or one pixel (x^2 / f H on the road) where that is more."""
    near = np.arange(MIN_ROW_DISTANCE_M, MAX_ROW_DISTANCE_M, ROW_STEP_M)
    turn_m = np.sqrt(ROW_STEP_M * fy_px * height_m)  # beyond, one pixel is more
    near = near[near < turn_m]
    first = fy_px * height_m / turn_m  # pixels below the horizon
    far = fy_px * height_m / np.arange(first, fy_px * height_m / MAX_ROW_DISTANCE_M, -1.0)
    out: Floats = np.concatenate([near, far[(far > near[-1] + 0.5 * ROW_STEP_M) & (far <= MAX_ROW_DISTANCE_M)]])
    return out


def road_view(
    camera: Camera,
    ground: GroundPlane,
    image: NDArray[np.uint8],
    segmentation: Segmentation,
    boxes_px: Floats,
    bonnet_px: Floats | None = None,
) -> RoadView:
    """Resamples `image`, (H, W) grey or (H, W, 3) BGR, and its masks; `boxes_px` (B, 4) are the vehicles' boxes.

    `bonnet_px` (N, 2) is the upper edge of the ego's bonnet: below it the image reflects road and paint.
    """
    x_m, y_m = _rows_m(camera.fy_px, ground.height_m), _columns_m()
    u, v = _pixels(camera, ground, x_m, y_m)
    outside = (u < 0.0) | (u > camera.width_px - 1) | (v < 0.0) | (v > camera.height_px - 1)
    if bonnet_px is not None:
        near = x_m < MAX_BONNET_DISTANCE_M
        outside[near] |= v[near] > np.interp(u[near], *bonnet_px.T)

    def seen(plane: NDArray[np.uint8], how: int) -> NDArray[np.uint8]:
        return np.asarray(cv2.remap(plane, u, v, how, borderMode=cv2.BORDER_REPLICATE))

    excess = None
    if image.ndim == 3:
        sampled = seen(image, cv2.INTER_LINEAR)
        grey = cv2.cvtColor(sampled, cv2.COLOR_BGR2GRAY)
        blue, green, red = (plane.astype(np.float32) for plane in cv2.split(sampled))
        excess = np.asarray(0.5 * (green + red) - blue, np.float32)
    else:
        grey = seen(image, cv2.INTER_LINEAR)
    covered = covered_by(boxes_px, segmentation)
    road, paint, hidden = (
        seen(mask.view(np.uint8), cv2.INTER_NEAREST) > 0 for mask in (segmentation.road, segmentation.lane, covered)
    )
    row_m = np.gradient(x_m)
    return RoadView(
        x_m,
        y_m,
        row_m,
        x_m / camera.fx_px,
        1.0 / camera.fy_px,
        np.asarray(grey, np.float32),
        road & ~outside,
        paint & ~outside & ~hidden,
        hidden,
        outside,
        excess,
    )


def covered_by(boxes_px: Floats, segmentation: Segmentation) -> Bools:
    """(H, W) what vehicles cover: their boxes (B, 4) without the road that is visible in the corners."""
    out = np.zeros(segmentation.road.shape, bool)
    for x1, y1, x2, y2 in boxes_px:
        out[max(0, int(y1)) : max(0, int(np.ceil(y2))), max(0, int(x1)) : max(0, int(np.ceil(x2)))] = True
    return out & ~(segmentation.road | segmentation.lane)


def nearest_visible_m(camera: Camera, ground: GroundPlane, bonnet_px: Floats | None) -> float:
    """Distance at which the road straight ahead enters the view: above the bonnet or at the image's border."""
    lowest = camera.height_px - 1.0
    v = lowest if bonnet_px is None else min(lowest, float(np.interp(camera.cx_px, *bonnet_px.T)))
    x_m = float(bev.pixel_to_ego(camera, ground, np.array([[camera.cx_px, v]]))[0, 0])
    return x_m if np.isfinite(x_m) else MAX_ROW_DISTANCE_M


def _pixels(camera: Camera, ground: GroundPlane, x_m: Floats, y_m: Floats) -> tuple[Grid, Grid]:
    """(R, C) columns and rows of the image: bev.ego_to_pixel for a grid."""
    ahead, left, up = ground.R_ego_cam
    right, down, depth = (
        (a * x_m - c * ground.height_m)[:, None] + b * y_m for a, b, c in zip(ahead, left, up, strict=True)
    )
    depth = np.maximum(depth, 1e-3)
    u = camera.fx_px * (right / depth) + camera.cx_px
    v = camera.fy_px * (down / depth) + camera.cy_px
    return u.astype(np.float32), v.astype(np.float32)
