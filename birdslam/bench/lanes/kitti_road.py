"""The ego's lane in single images, against masks as KITTI's road benchmark has them (Fritsch et al. 2013).

A folder holds pairs image_N.png, ego_lane_N.png. In a mask magenta is the ego's lane, red is not, black is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.lanes.image_masks import Pair, numbered_pairs
from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.lanes.line_tracker import find_lines_in_image
from birdslam.lanes.outline import lane_mask, line_px
from birdslam.lanes.road_view import covered_by
from birdslam.lanes.topology import LaneRow, lane_row
from birdslam.perception import Segmentation
from birdslam.sources.recording import DatasetError
from birdslam.types import Bound, LaneLine

# KITTI's camera 2 of 2011_09_26, rectified
FOCAL_PX, CENTRE_PX, HEIGHT_M = 721.5377, (609.5593, 172.854), 1.65
MAX_DISTANCE_M = 30.0  # of the comparison
HALF_WIDTH_M, CELL_M = 10.0, 0.05  # of its grid
LANE, IGNORED = (255, 0, 255), (0, 0, 0)  # BGR


class StillScore(msgspec.Struct, frozen=True, kw_only=True):
    """The ego's lane of one image."""

    image: str
    ego_lane_iou: float  # in bird's-eye view to 30 m, of what the image shows of the lane
    width_m: float | None = None  # None: no lane was found
    left: Bound | None = None
    right: Bound | None = None


class StillsReport(msgspec.Struct, frozen=True, kw_only=True):
    """All images of a folder."""

    images: int
    ego_lane_iou_mean: float
    ego_lane_iou_least: float
    networks: tuple[str, ...]
    by_image: tuple[StillScore, ...]


def find_pairs(folder: Path) -> list[Pair]:
    """The pairs of a folder by their number. Raises DatasetError where there are none, or an image has no mask."""
    return numbered_pairs(folder, "png", "ego_lane")


def camera_of(image: NDArray[np.uint8], stated: Camera | None) -> Camera:
    """The stated camera, or KITTI's, for an image of this size. Raises DatasetError where that can't be."""
    height_px, width_px = image.shape[:2]
    if stated is not None:
        if (stated.width_px, stated.height_px) != (width_px, height_px):
            raise DatasetError(
                f"an image of {width_px}x{height_px} does not fit the camera of {stated.width_px}x{stated.height_px}"
            )
        return stated
    try:
        return Camera(
            width_px=width_px,
            height_px=height_px,
            fx_px=FOCAL_PX,
            fy_px=FOCAL_PX,
            cx_px=CENTRE_PX[0],
            cy_px=CENTRE_PX[1],
            height_m=HEIGHT_M,
        )
    except ValueError as error:
        raise DatasetError(f"an image of {width_px}x{height_px} is none of KITTI's camera: {error}") from None


@dataclass(frozen=True)
class Still:
    """What was found in one image."""

    lines: tuple[LaneLine, ...]
    row: LaneRow
    ground: GroundPlane
    area: Bools  # (H, W) of the ego's lane, as far as the image shows it


def find_lane(camera: Camera, image: NDArray[np.uint8], segmentation: Segmentation, boxes_px: Floats) -> Still:
    """The lines and the ego's lane of one image without a past."""
    lines, ground = find_lines_in_image(camera, image, segmentation, boxes_px)
    row = lane_row(lines)
    area = np.zeros(image.shape[:2], dtype=bool)
    if row.ego is not None:
        area = lane_mask(camera, ground, row.lanes[row.ego]) & ~covered_by(boxes_px, segmentation)
    return Still(lines, row, ground, area)


def score(name: str, camera: Camera, still: Still, mask: NDArray[np.uint8]) -> StillScore:
    """The lane against its mask (H, W, 3)."""
    lane = None if still.row.ego is None else still.row.lanes[still.row.ego]
    return StillScore(
        image=name,
        ego_lane_iou=iou_of(camera, still, mask),
        width_m=None if lane is None else lane.width_m,
        left=None if lane is None else lane.left_bound,
        right=None if lane is None else lane.right_bound,
    )


def iou_of(camera: Camera, still: Still, mask: NDArray[np.uint8]) -> float:
    """IoU of the lane with its mask (H, W, 3) in bird's-eye view."""
    truth, counted = (mask == LANE).all(axis=2), (mask != IGNORED).any(axis=2)
    cells = grid_px(camera)
    return iou(still.area[cells], truth[cells], counted[cells])


def grid_px(camera: Camera) -> tuple[Ints, Ints]:
    """Returns rows and columns of the pixels of a road grid up to MAX_DISTANCE_M, by the ground of the camera."""
    x_m = np.arange(1.0, MAX_DISTANCE_M, CELL_M)
    y_m = np.arange(-HALF_WIDTH_M, HALF_WIDTH_M, CELL_M)
    grid = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1).reshape(-1, 2)
    px = bev.ego_to_pixel(camera, camera.ground, grid)
    px = np.round(px[np.isfinite(px).all(axis=1)])
    inside = np.all((px >= 0) & (px < [camera.width_px, camera.height_px]), axis=1)
    column, row = px[inside].astype(np.int64).T
    return row, column


def iou(found: Bools, truth: Bools, counted: Bools) -> float:
    """Intersection over union where it counts; 1 where there is neither."""
    union = int(np.sum((found | truth) & counted))
    return 1.0 if union == 0 else float(np.sum(found & truth & counted)) / union


def report_of(scores: list[StillScore], networks: tuple[str, ...]) -> StillsReport:
    """The report of a folder's images."""
    by_road = [s.ego_lane_iou for s in scores]
    return StillsReport(
        images=len(scores),
        ego_lane_iou_mean=float(np.mean(by_road)),
        ego_lane_iou_least=min(by_road),
        networks=networks,
        by_image=tuple(scores),
    )


def draw(image: NDArray[np.uint8], camera: Camera, still: Still) -> NDArray[np.uint8]:
    """The image with its lines and the ego's lane: paint red, edges blue, the lane green."""
    out = image.copy()
    out[still.area] = (out[still.area] * 0.6 + np.array([0.0, 100.0, 0.0])).astype(np.uint8)
    for line in still.lines:
        colour = (255, 100, 0) if line.kind == "edge" else (0, 0, 255)
        cv2.polylines(out, [np.round(line_px(camera, still.ground, line)).astype(np.int32)], False, colour, 2)
    return out
