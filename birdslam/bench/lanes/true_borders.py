"""The ego's lane of a real drive against its borders, traced by hand on the road that the drive passes later.

Borders are left offsets from the trajectory of the camera over the distance travelled, so one trace is the truth of all
frames. The road is the camera's height below the trajectory, which includes pitch and hills.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.figures import mean, median, number
from birdslam.bench.lanes.kitti_road import IGNORED, LANE, find_lane, iou_of
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera
from birdslam.lanes.road_view import covered_by
from birdslam.perception import Segmentation
from birdslam.sources.recording import DatasetError, Recording
from birdslam.types import Lanes

RANGES_M = (10.0, 20.0, 30.0)
MIN_STEP_M, STEP_M, AHEAD_M = 0.5, 0.5, 60.0  # of the trajectory, of a border's points, and how far these go
START_S = 2.0  # frames before are not counted: the line tracker starts
FALSE_M = 0.5  # error of a bound at RANGES_M[0] that makes the lane a false one
LOW_IOU = 0.8
_SHIFT = 4  # fractional bits of cv2.fillPoly


class Borders(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distance travelled and left offset, metres, of points on the left and the right border of the ego's lane.

    `yaw_rad` turns the camera of the poses to the right, until images of the same road from near and from far agree.
    """

    left: list[tuple[float, float]]
    right: list[tuple[float, float]]
    yaw_rad: float = 0.0


class BorderRange(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of the lane's bounds and coverage of its centre at one distance."""

    ahead_m: float
    frames: int
    error_median_m: float | None
    error_p95_m: float | None
    within_2_sigma: float | None


class BordersReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive: the lane of single images, and of the tracker after START_S."""

    drive: str
    images: int
    iou_mean: float | None  # of single images, as in `kitti_road`
    iou_low: float | None  # share of images below LOW_IOU
    frames: int
    with_lane: float | None
    false: float | None  # share of the frames with a lane whose bound is off by more than FALSE_M
    ranges: tuple[BorderRange, ...]


def read_borders(path: Path) -> Borders:
    """Raises DatasetError."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Borders)
    except (OSError, msgspec.MsgspecError) as error:
        raise DatasetError(f"{path}: {error}") from None


class TrueBorders:
    """The borders of each frame's lane in the frame's ego axes."""

    def __init__(self, recording: Recording, borders: Borders) -> None:
        """Raises DatasetError without true poses."""
        rows = recording.truth_poses()
        if rows is None:
            raise DatasetError(f"{recording.name}: has no true poses")
        self._camera = recording.camera
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3] = rows
        sin, cos = math.sin(borders.yaw_rad), math.cos(borders.yaw_rad)
        turn = np.array([[cos, 0.0, sin, 0.0], [0.0, 1.0, 0.0, 0.0], [-sin, 0.0, cos, 0.0], [0.0, 0.0, 0.0, 1.0]])
        self._T_world_cam: Floats = T @ recording.T_cam0_cam() @ turn
        at = self._T_world_cam[:, :3, 3]
        kept = [0]
        for k in range(1, len(at)):
            if np.linalg.norm(at[k] - at[kept[-1]]) > MIN_STEP_M:
                kept.append(k)
        self._at_m, self._down = at[kept], self._T_world_cam[kept, :3, 1]
        self._distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._at_m, axis=0), axis=1))])
        self._frames_m = np.interp(np.arange(len(at)), kept, self._distance_m)
        along = np.gradient(self._at_m, self._distance_m, axis=0)
        self._along = along / np.linalg.norm(along, axis=1, keepdims=True)
        self._left, self._right = np.array(borders.left), np.array(borders.right)
        self._end_m = min(self._left[-1, 0], self._right[-1, 0])

    def covers(self, frame_id: int, ahead_m: float) -> bool:
        """Whether the borders are known `ahead_m` metres from the frame."""
        return bool(self._frames_m[frame_id] + ahead_m < self._end_m)

    def borders_m(self, frame_id: int) -> tuple[Floats, Floats]:
        """(N, 3) points of the left and the right border in the ego's axes, from near to far."""
        start = self._frames_m[frame_id] + 2.0
        at = np.arange(start, min(self._end_m, start + AHEAD_M), STEP_M)
        T_cam_world = np.linalg.inv(self._T_world_cam[frame_id])
        R = self._camera.ground.R_ego_cam
        out = []
        for border in (self._left, self._right):
            points = self._road(at, np.interp(at, *border.T)) @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
            out.append(points @ R.T + [0.0, 0.0, self._camera.height_m])
        return out[0], out[1]

    def _road(self, distance_m: Floats, left_m: Floats) -> Floats:
        """(N, 3) world points of the road; beyond its end the trajectory goes straight on."""
        at, along, down = (
            np.column_stack([np.interp(distance_m, self._distance_m, column) for column in values.T])
            for values in (self._at_m, self._along, self._down)
        )
        at = at + along * np.maximum(distance_m - self._distance_m[-1], 0.0)[:, None]
        left = np.cross(along, down)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        out: Floats = at + self._camera.height_m * down + left * left_m[:, None]
        return out

    def image_iou(self, frame_id: int, image: NDArray[np.uint8], segmentation: Segmentation, boxes_px: Floats) -> float:
        """IoU of the lane that is found in this image alone, as in `kitti_road`."""
        still = find_lane(self._camera, image, segmentation, boxes_px)
        return iou_of(self._camera, still, self.mask(frame_id, covered_by(boxes_px, segmentation)))

    def mask(self, frame_id: int, covered: Bools) -> NDArray[np.uint8]:
        """(H, W, 3) mask as in `kitti_road`; ignored beyond the known borders and where vehicles cover the road."""
        left, right = (_pixels(self._camera, border) for border in self.borders_m(frame_id))
        out = np.zeros((self._camera.height_px, self._camera.width_px, 3), np.uint8)
        out[:] = (0, 0, 255)
        outline = np.clip(np.vstack([left, right[::-1]]), -20_000.0, 20_000.0)
        cv2.fillPoly(out, [np.round(outline * 2**_SHIFT).astype(np.int32)], LANE, shift=_SHIFT)
        out[: max(0, int(np.ceil(max(left[-1, 1], right[-1, 1]))) + 1)] = IGNORED
        out[covered] = IGNORED
        return out


def _pixels(camera: Camera, points: Floats) -> Floats:
    cam = (points - [0.0, 0.0, camera.height_m]) @ camera.ground.R_ego_cam
    out: Floats = camera.to_px(cam[:, :2] / cam[:, 2:])
    return out


@dataclass
class BorderScores:
    """Collects single images and frames of the tracker."""

    ious: list[float] = field(default_factory=list)
    has_lane: list[bool] = field(default_factory=list)
    is_false: list[bool] = field(default_factory=list)
    errors: dict[float, list[tuple[float, float, float]]] = field(default_factory=lambda: {x: [] for x in RANGES_M})

    def add(self, lanes: Lanes | None, left: Floats, right: Floats) -> None:
        """Adds a frame of the tracker: its lanes and the true borders (N, 2 or 3), from near to far."""
        own = None if lanes is None else lanes.ego
        self.has_lane.append(own is not None)
        if own is None:
            return
        for x in RANGES_M:
            if x > min(own.to_m, left[-1, 0], right[-1, 0]):
                continue
            true = [float(np.interp(x, border[:, 0], border[:, 1])) for border in (left, right)]
            off = own.left_m(x) - true[0], own.right_m(x) - true[1]
            self.errors[x].append((abs(off[0]), abs(off[1]), abs(sum(off)) / 2.0 / own.sigma_m(x)))
            if x == RANGES_M[0]:
                self.is_false.append(max(map(abs, off)) > FALSE_M)

    def report(self, drive: str) -> BordersReport:
        """Returns the scores of all frames."""
        return BordersReport(
            drive=drive,
            images=len(self.ious),
            iou_mean=mean(self.ious),
            iou_low=mean([iou < LOW_IOU for iou in self.ious]),
            frames=len(self.has_lane),
            with_lane=mean(self.has_lane),
            false=mean(self.is_false),
            ranges=tuple(_range_of(x, self.errors[x]) for x in RANGES_M),
        )


def _range_of(x_m: float, errors: list[tuple[float, float, float]]) -> BorderRange:
    bounds = [error for left, right, _ in errors for error in (left, right)]
    return BorderRange(
        ahead_m=x_m,
        frames=len(errors),
        error_median_m=median(bounds),
        error_p95_m=float(np.quantile(bounds, 0.95)) if bounds else None,
        within_2_sigma=mean([sigmas < 2.0 for _, _, sigmas in errors]),
    )


def text_of(report: BordersReport) -> str:
    """Lines for a terminal."""
    images = f"{report.images} single images: mean IoU of the ego lane {number(report.iou_mean, 3)}, "
    images += f"{number(report.iou_low)} below {LOW_IOU}"
    out = [
        f"{report.drive}: {images}" if report.images else f"{report.drive}:",
        f"  {report.frames} frames after {START_S:g} s: ego lane in {number(report.with_lane)}, "
        f"false in {number(report.false)} of these",
    ]
    out += [
        f"  {at.ahead_m:4.0f} m ahead: error of the bounds {number(at.error_median_m)} m median, "
        f"{number(at.error_p95_m)} m p95, centre within 2 sigma {number(at.within_2_sigma)}, {at.frames} frames"
        for at in report.ranges
    ]
    return "\n".join(out)
