"""Training targets of the multi-task network: an example from a window of a rendered frame, at the input size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats32
from birdslam.perception.decoding.multitask import CANONICAL_FOCAL_REL, CLASSES, KINDS
from birdslam.world.truth import CLASSES as SURFACES
from birdslam.world.truth import WorldFrame, WorldObject

MAX_OBJECTS = 24  # per example; the largest are kept
_ROAD, _LANE, _SKY = (SURFACES.index(name) for name in ("road", "lane", "sky"))
_CLASS_OF = {"car": 0, "van": 0, "truck": 0, "bus": 0, "pedestrian": 1, "cyclist": 1}
_KIND_OF = {"car": 0, "van": 0, "truck": 1, "bus": 2}
assert len(CLASSES) == 1 + max(_CLASS_OF.values())
assert len(KINDS) == 1 + max(_KIND_OF.values())


class TargetsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of objects used for training, in pixels of the network's input."""

    min_visible: float = 0.3  # of its body in the image; less visible objects are ignored
    min_height_px: float = 5.0
    min_width_px: float = 3.0
    min_depth_m: float = 1.0
    lane_share: float = 0.25  # min. share of paint in a mask cell that is a marking
    far_m: float = 120.0  # max. canonical depth, also that of the sky


# The columns of an example's objects; boxes and centres are in pixels of the input.
OBJECT_COLUMNS = (
    *("taught", "class", "kind", "x1_px", "y1_px", "x2_px", "y2_px", "u_px", "v_px"),
    *("log_depth", "log_length", "log_width", "log_height", "sin_alpha", "cos_alpha"),
)
COLUMN = {name: i for i, name in enumerate(OBJECT_COLUMNS)}


@dataclass(frozen=True)
class Window:
    """The part of a frame in an example, in the frame's pixels, and whether it is mirrored."""

    x0_px: int
    y0_px: int
    x1_px: int
    y1_px: int
    mirrored: bool = False


@dataclass(frozen=True)
class Example:
    """One image at the network's size (H, W) and its truth; maps are half as large.

    `image` (H, W, 3) uint8 BGR. `masks` (2, H/2, W/2) float32: the share of each cell that is road (markings
    included); 1 where it is a lane marking. `log_depth` (H/2, W/2) float32: of the canonical depth in metres; `sky`
    (H/2, W/2) bool.
    `objects` (MAX_OBJECTS, columns) float32, padded with zeros; the loss ignores a row with taught = 0 and a box.
    """

    image: NDArray[np.uint8]
    masks: Floats32
    log_depth: Floats32
    sky: Bools
    objects: Floats32


def encode(frame: WorldFrame, window: Window, width_px: int, height_px: int, config: TargetsConfig) -> Example:
    """The network's input for a window of a frame, and its targets."""
    rows, columns = slice(window.y0_px, window.y1_px), slice(window.x0_px, window.x1_px)
    half = (width_px // 2, height_px // 2)
    shrinks = window.x1_px - window.x0_px > width_px
    image = cv2.resize(
        frame.image[rows, columns], (width_px, height_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    ).astype(np.uint8, copy=False)
    classes, depth_m = frame.classes[rows, columns], frame.depth_m[rows, columns]
    lane = (classes == _LANE).astype(np.float32)
    road = (classes == _ROAD).astype(np.float32) + lane
    masks = np.stack([cv2.resize(mask, half, interpolation=cv2.INTER_AREA) for mask in (road, lane)])
    masks[1] = masks[1] >= config.lane_share
    # Canonical depth: that for a camera with the canonical focal length
    zoom = (window.x1_px - window.x0_px) * CANONICAL_FOCAL_REL / frame.camera.fx_px
    # Inverse depth is linear on a plane, so its mean is the value at the cell's centre
    nearness = cv2.resize(np.float32(1.0) / depth_m, half, interpolation=cv2.INTER_AREA) / zoom
    sky = cv2.resize((classes == _SKY).astype(np.uint8), half, interpolation=cv2.INTER_NEAREST) > 0
    log_depth = -np.log(np.clip(nearness, 1.0 / config.far_m, 2.0)).astype(np.float32)
    objects = _objects(frame, window, (width_px, height_px), zoom, config)
    if window.mirrored:
        image, masks, log_depth, sky = image[:, ::-1], masks[..., ::-1], log_depth[:, ::-1], sky[:, ::-1]
    return Example(image, masks, log_depth, sky, objects)


def _objects(frame: WorldFrame, window: Window, size: tuple[int, int], zoom: float, config: TargetsConfig) -> Floats32:
    rows = [row for body in frame.objects if (row := _row(frame, body, window, size, zoom, config)) is not None]
    rows.sort(key=lambda row: (row["y1_px"] - row["y2_px"]) * (row["x2_px"] - row["x1_px"]))
    out = np.zeros((MAX_OBJECTS, len(OBJECT_COLUMNS)), dtype=np.float32)
    for index, row in enumerate(rows[:MAX_OBJECTS]):
        out[index] = [row[name] for name in OBJECT_COLUMNS]
    return out


def _row(
    frame: WorldFrame, body: WorldObject, window: Window, size: tuple[int, int], zoom: float, config: TargetsConfig
) -> dict[str, float] | None:
    """One object as a row; None if it is not visible."""
    scale = np.array(size) / [window.x1_px - window.x0_px, window.y1_px - window.y0_px]
    # Camera coordinates refer to pixel centres, network coordinates to pixel edges
    corner_px = np.array([window.x0_px, window.y0_px]) - 0.5
    corners = (np.reshape(body.full_box_px, (2, 2)) - corner_px) * scale
    box = np.clip(corners, 0.0, size)
    extent = box[1] - box[0]
    if body.label not in _CLASS_OF or body.pixels < 1 or extent.min() < 1.0:
        return None
    camera = frame.camera
    centre_m = np.asarray(body.base_cam_m) + 0.5 * body.height_m * camera.ground.normal_cam
    depth_m = max(float(centre_m[2]), 0.1)
    pixel = np.array(
        [camera.fx_px * centre_m[0] / depth_m + camera.cx_px, camera.fy_px * centre_m[1] / depth_m + camera.cy_px]
    )
    u_px, v_px = (pixel - corner_px) * scale
    alpha_rad = body.T_ego_object.yaw_rad - math.atan2(body.T_ego_object.y_m, body.T_ego_object.x_m)
    whole = np.prod(corners[1] - corners[0])
    taught = (
        body.visible >= config.min_visible
        and extent[0] >= config.min_width_px
        and extent[1] >= config.min_height_px
        and centre_m[2] >= config.min_depth_m
        and np.prod(extent) >= 0.2 * whole
    )
    x1_px, x2_px = box[:, 0]
    if window.mirrored:
        x1_px, x2_px, u_px, alpha_rad = size[0] - x2_px, size[0] - x1_px, size[0] - u_px, -alpha_rad
    return {
        "taught": float(taught),
        "class": float(_CLASS_OF[body.label]),
        "kind": float(_KIND_OF.get(body.label, 0)),
        "x1_px": float(x1_px),
        "y1_px": float(box[0, 1]),
        "x2_px": float(x2_px),
        "y2_px": float(box[1, 1]),
        "u_px": float(u_px),
        "v_px": float(v_px),
        "log_depth": math.log(depth_m * zoom),
        "log_length": math.log(body.length_m),
        "log_width": math.log(body.width_m),
        "log_height": math.log(body.height_m),
        "sin_alpha": math.sin(alpha_rad),
        "cos_alpha": math.cos(alpha_rad),
    }
