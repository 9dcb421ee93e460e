"""Exact ground truth of the frames of the built-in world, in metres and pixels.

Frames are those of `birdslam.types`: ego is the camera's foot on the road, REP-103; camera is x right, y down, z
forward. The road at the ego is the plane of `WorldFrame.camera.ground`; farther away the road may differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2

# Classes of pixels. `lane` is painted lane and road boundaries; other paint (zebras, arrows, stop lines) is `road`;
# `pavement` includes kerbs; grass is `vegetation`; cyclists with their cycles are `person`
CLASSES = ("sky", "road", "lane", "pavement", "building", "vegetation", "pole_sign", "vehicle", "person", "other")
LABELS = ("car", "van", "truck", "bus", "cyclist", "pedestrian")


@dataclass(frozen=True)
class WorldObject:
    """A movable body, visible or hidden; `T_ego_object` is the centre of its footprint."""

    object_id: int
    label: str  # of LABELS
    length_m: float
    width_m: float
    height_m: float
    T_ego_object: SE2
    base_cam_m: Floats  # (3,) centre of the footprint in camera
    yaw_cam_rad: float  # about camera's down axis; the yaw of `T_ego_object`
    box_px: Floats  # (4,) x1 y1 x2 y2 of the whole body, hidden parts too, clipped to the image
    full_box_px: Floats  # (4,) the same unclipped
    visible: float  # unoccluded fraction of its projection inside the image
    truncated: float  # fraction of the full box's area outside the image
    pixels: int  # its pixels in `WorldFrame.instances`
    velocity_mps: Floats  # (2,) over the ground, in world


@dataclass(frozen=True)
class WorldLane:
    """A lane or road boundary in ego, including hidden parts and gaps of dashes."""

    lane_id: int
    kind: str  # solid, dashed, dotted, double, double_dashed, kerb (an edge without paint)
    points_m: Floats  # (N, 2) in ego, from behind the camera to 60 m ahead or more


@dataclass(frozen=True)
class WorldFrame:
    """One rendered image and its ground truth."""

    image: NDArray[np.uint8]  # (H, W, 3) BGR
    depth_m: Floats32  # (H, W) along the optical axis, inf is sky
    classes: NDArray[np.uint8]  # (H, W) indices of CLASSES
    instances: NDArray[np.uint16]  # (H, W) object_id + 1, 0 is none
    objects: tuple[WorldObject, ...]
    lanes: tuple[WorldLane, ...]
    road_m: tuple[Floats, ...]  # polygons (N, 2) in ego: the drivable road, including hidden parts
    camera: Camera  # with this frame's height, pitch and roll over the road
    T_world_cam: Floats  # (4, 4) camera axes in world
    frame_id: int
    t_source_ns: int
