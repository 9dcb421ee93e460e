"""Selection of image points on the road (Sec. 3.1) and outside vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera, GroundPlane

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_DISTANCE_M = 30.0
_BESIDE_PX, _BELOW_PX = 3, 6  # a box ends above its vehicle's shadow
# At night a vehicle's lamps glow beyond its box, within the tracking window of a corner
_GLOW_BESIDE_PX, _GLOW_ABOVE_PX = 8, 10
_DARK_GREY = 55.0  # mean grey value of an image at night, at most


def is_night(grey: NDArray[np.uint8]) -> bool:
    """Whether an image (H, W) is so dark that lamps glow."""
    return float(grey[::8, ::8].mean()) < _DARK_GREY


def outside(px: Floats, boxes_px: Floats, night: bool = False) -> Bools:
    """(N,) which of the pixels (N, 2) lie outside all boxes (B, 4), at night with a margin for glow."""
    beside_px, above_px, below_px = _BESIDE_PX, _BESIDE_PX, _BELOW_PX
    if night:
        beside_px, above_px, below_px = _GLOW_BESIDE_PX, _GLOW_ABOVE_PX, _GLOW_ABOVE_PX
    x, y = np.ascontiguousarray(px.T)
    x1, y1, x2, y2 = boxes_px.T[..., None]
    inside = (x > x1 - beside_px) & (x < x2 + beside_px) & (y > y1 - above_px) & (y < y2 + below_px)
    out: Bools = ~inside.any(axis=0)
    return out


def on_road(
    px: Floats, camera: Camera, ground: GroundPlane, boxes_px: Floats, road_mask: Bools | None, half_width_m: float
) -> Bools:
    """(N,) which of the pixels (N, 2) show road, by the mask (H, W) or else a strip ahead; outside boxes (B, 4)."""
    rays = rays_cam(camera, px)
    rho = -(rays @ ground.normal_cam) / camera.height_m  # inverse depth on the road, Eq. 1
    keep = (rho > 1.0 / MAX_DISTANCE_M) & outside(px, boxes_px)
    if road_mask is not None:
        u, v = np.round(px).astype(np.int64).T
        height_px, width_px = road_mask.shape
        keep &= road_mask[np.minimum(np.maximum(v, 0), height_px - 1), np.minimum(np.maximum(u, 0), width_px - 1)]
    else:
        keep &= np.abs(rays[:, 0]) < half_width_m * rho
    return keep
