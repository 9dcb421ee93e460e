"""Which corners lie on the road: those that the paper keeps for its static map and its metric scale (Sec. 3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera, GroundPlane

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FARTHEST_M = 30.0
_BESIDE_PX, _BELOW_PX = 3, 6  # a box ends above its vehicle's shadow


def outside(px: Floats, boxes_px: Floats) -> Bools:
    """(N,) which of the pixels (N, 2) lie outside all vehicles' boxes (B, 4)."""
    x, y = np.ascontiguousarray(px.T)
    x1, y1, x2, y2 = boxes_px.T[..., None]
    inside = (x > x1 - _BESIDE_PX) & (x < x2 + _BESIDE_PX) & (y > y1 - _BESIDE_PX) & (y < y2 + _BELOW_PX)
    out: Bools = ~inside.any(axis=0)
    return out


def on_road(
    px: Floats, camera: Camera, ground: GroundPlane, boxes_px: Floats, road_mask: Bools | None, half_width_m: float
) -> Bools:
    """(N,) which of the pixels (N, 2) show road: in the mask (H, W), else in a strip in front; outside vehicles."""
    rays = rays_cam(camera, px)
    rho = -(rays @ ground.normal_cam) / camera.height_m  # inverse depth on the road, Eq. 1
    keep = (rho > 1.0 / FARTHEST_M) & outside(px, boxes_px)
    if road_mask is not None:
        u, v = np.round(px).astype(np.int64).T
        height_px, width_px = road_mask.shape
        keep &= road_mask[np.minimum(np.maximum(v, 0), height_px - 1), np.minimum(np.maximum(u, 0), width_px - 1)]
    else:
        keep &= np.abs(rays[:, 0]) < half_width_m * rho
    return keep
