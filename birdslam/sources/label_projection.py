"""Projects KITTI tracking labels to the image of another camera than camera 2.

The cuboid of a label is in camera 0; its box in another image is the hull of the projected cuboid. It is slightly
larger than a drawn box, since real cars have rounded corners.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.trajectory import Transform, inverse

DONT_CARE = "DontCare"  # a region without a body
MIN_DISTANCE_M = 0.1  # min. depth of a projected point
MIN_INSIDE_RATIO = 0.98  # share of a hull's area in the image, below it the object is truncated
# Corners of a cuboid by (length, height, width), and edges: pairs of corners that differ in one coordinate
_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-1.0, 0.0) for z in (-0.5, 0.5)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i) if np.count_nonzero(_CORNERS[i] != _CORNERS[j]) == 1])


@dataclass(frozen=True)
class Label:
    """A labelled object in one frame; `place_m` (3,) is its bottom centre in camera 0 (x right, y down, z ahead)."""

    frame: int
    track: int
    kind: str
    truncated: float
    occluded: int
    box_px: tuple[float, float, float, float]
    height_m: float
    width_m: float
    length_m: float
    place_m: tuple[float, float, float]
    rotation_y_rad: float


def project_labels(labels: Iterable[Label], camera: Camera, T_cam0_camera: Transform) -> list[Label]:
    """The labels in the camera's image with their boxes and truncation there.

    "DontCare" regions keep their boxes, since they are far away; occlusion is unchanged.
    """
    out = []
    for label in labels:
        hull = None if label.kind == DONT_CARE else hull_px(label, camera, T_cam0_camera)
        if label.kind == DONT_CARE:
            out.append(label)
        elif hull is not None:
            low = np.clip(hull[:2], 0.0, [camera.width_px, camera.height_px])
            high = np.clip(hull[2:], 0.0, [camera.width_px, camera.height_px])
            inside = float(np.prod(high - low) / np.prod(hull[2:] - hull[:2]))
            if inside > 0.0:
                box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
                out.append(replace(label, box_px=box, truncated=float(inside < MIN_INSIDE_RATIO)))
    return out


def hull_px(label: Label, camera: Camera, T_cam0_camera: Transform) -> Floats | None:
    """(4,) x1, y1, x2, y2 of the projected cuboid in pixels, not clipped; None behind the camera."""
    R_cam0_body = Rotation.from_euler("y", label.rotation_y_rad).as_matrix()
    size_m = np.array([label.length_m, label.height_m, label.width_m])
    p_cam0 = (_CORNERS * size_m) @ R_cam0_body.T + label.place_m
    T_camera_cam0 = inverse(T_cam0_camera)
    corners = p_cam0 @ T_camera_cam0[:3, :3].T + T_camera_cam0[:3, 3]
    ends = corners[_EDGES]  # (12, 2, 3)
    near = ends[:, :, 2] < MIN_DISTANCE_M
    ends = ends[~near.all(axis=1)]
    if not len(ends):
        return None
    for edge in ends:  # an edge through the camera's plane is clipped in front of it
        (a, b) = edge if edge[0, 2] < edge[1, 2] else edge[::-1]
        if a[2] < MIN_DISTANCE_M:
            a += (MIN_DISTANCE_M - a[2]) / (b[2] - a[2]) * (b - a)
    points = ends.reshape(-1, 3)
    u = camera.fx_px * points[:, 0] / points[:, 2] + camera.cx_px
    v = camera.fy_px * points[:, 1] / points[:, 2] + camera.cy_px
    return np.array([u.min(), v.min(), u.max(), v.max()])
