"""Which corners lie on the road: those that the paper keeps for its static map and its metric scale (Sec. 3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FARTHEST_M = 30.0
_BESIDE_PX, _BELOW_PX = 3, 6  # a box ends above its vehicle's shadow


def outside(px: Floats, boxes_px: Floats) -> Bools:
    """(N,) which of the pixels (N, 2) lie outside all vehicles' boxes (B, 4)."""
    out = np.ones(len(px), bool)
    for x1, y1, x2, y2 in boxes_px:
        beside = (px[:, 0] > x1 - _BESIDE_PX) & (px[:, 0] < x2 + _BESIDE_PX)
        out &= ~(beside & (px[:, 1] > y1 - _BESIDE_PX) & (px[:, 1] < y2 + _BELOW_PX))
    return out


def on_road(
    px: Floats, camera: Camera, ground: GroundPlane, boxes_px: Floats, road_mask: Bools | None, half_width_m: float
) -> Bools:
    """(N,) which of the pixels (N, 2) show road: in the mask (H, W), else in a strip in front; outside vehicles."""
    rays = np.column_stack([camera.to_xy(px), np.ones(len(px))])
    rho = -(rays @ ground.normal_cam) / camera.height_m  # inverse depth on the road, Eq. 1
    keep = (rho > 1.0 / FARTHEST_M) & outside(px, boxes_px)
    if road_mask is not None:
        at = np.round(px).astype(np.int64)
        at = np.clip(at, 0, [road_mask.shape[1] - 1, road_mask.shape[0] - 1])
        keep &= road_mask[at[:, 1], at[:, 0]]
    else:
        keep &= np.abs(rays[:, 0]) < half_width_m * rho
    return keep
