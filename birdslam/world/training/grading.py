"""Evaluates findings against a rendered frame's truth. Counts are summed over frames; `figures` gives the rates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.perception import Detections, Findings
from birdslam.world.truth import CLASSES, WorldFrame, WorldObject

_ROAD, _LANE = (CLASSES.index(name) for name in ("road", "lane"))
_VEHICLES = ("car", "van", "truck", "bus")
MIN_VISIBLE_RATIO = 0.9  # of a body with a complete outline


class GradingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds. Those of vehicles are KITTI's "moderate": 25 px of 375, at most half hidden, 30 % truncated."""

    min_height_rel: float = 25.0 / 375.0  # of the image's height
    min_visible: float = 0.5
    max_truncated: float = 0.3
    iou: float = 0.5
    lane_grid_px: tuple[int, int] = (320, 96)  # grid of the network's mask, for markings
    lane_share: float = 0.25  # min. share of paint in a cell that counts as marking
    depth_max_m: float = 80.0
    near_m: float = 10.0  # the range of the bird's-eye figures
    far_m: float = 30.0
    score: float = 0.3  # min. score of the boxes whose bodies are evaluated


@dataclass
class Grades:
    """Sums and samples over frames; `figures` gives the rates."""

    config: GradingConfig = field(default_factory=GradingConfig)
    frames: int = 0
    absrel: list[float] = field(default_factory=list)  # a frame's mean
    road: Ints = field(default_factory=lambda: np.zeros(2, dtype=np.int64))  # common, either
    lane: Ints = field(default_factory=lambda: np.zeros(2, dtype=np.int64))
    scores: list[float] = field(default_factory=list)
    hits: list[bool] = field(default_factory=list)
    vehicles: int = 0
    axis_rad: list[float] = field(default_factory=list)  # error of the axis, modulo pi
    flipped: list[bool] = field(default_factory=list)
    centre_rel: list[float] = field(default_factory=list)  # of the depth, at near_m to far_m
    size_rel: list[Floats] = field(default_factory=list)
    depth_z: list[float] = field(default_factory=list)  # error over stated sigma
    edge_rel: list[float] = field(default_factory=list)  # error of each edge of an unoccluded box, over its side

    def add(self, findings: Findings, frame: WorldFrame) -> None:
        """Adds one frame; the findings refer to its image."""
        self.frames += 1
        if findings.depth is not None:
            depth_m = findings.depth.in_metres(frame.camera).depth_m
            nearness = cv2.resize(np.float32(1.0) / frame.depth_m, depth_m.shape[::-1], interpolation=cv2.INTER_AREA)
            known = nearness > 1.0 / self.config.depth_max_m
            truth_m = np.float32(1.0) / np.where(known, nearness, np.float32(1.0))
            self.absrel.append(float(np.mean(np.abs(depth_m[known] - truth_m[known]) / truth_m[known])))
        if findings.segmentation is not None:
            lane = frame.classes == _LANE
            self.road += overlap(findings.segmentation.road, (frame.classes == _ROAD) | lane)
            said, painted = (
                cv2.resize(mask.astype(np.float32), self.config.lane_grid_px, interpolation=cv2.INTER_AREA)
                for mask in (findings.segmentation.lane, lane)
            )
            self.lane += overlap(said >= 0.5, painted >= self.config.lane_share)
        if findings.detections is not None:
            self._boxes(findings.detections.only(_VEHICLES), frame)

    def _boxes(self, found: Detections, frame: WorldFrame) -> None:
        config = self.config
        vehicles = [body for body in frame.objects if body.label in _VEHICLES and body.pixels > 0]
        counted = np.array([self._counts(body, frame) for body in vehicles], dtype=bool)
        truth = _boxes_of(vehicles)
        people = _boxes_of([body for body in frame.objects if body.label not in _VEHICLES])
        self.vehicles += int(counted.sum())
        free = np.ones(len(vehicles), dtype=bool)
        shared = box_ious(found.boxes_px, truth)
        tall = found.boxes_px[:, 3] - found.boxes_px[:, 1] >= config.min_height_rel * frame.image.shape[0]
        for row in np.argsort(-found.scores, kind="stable"):
            fits = np.where(free & (shared[row] >= config.iou), shared[row] + counted, -1.0)
            best = int(np.argmax(fits)) if len(fits) else -1
            if best >= 0 and fits[best] > 0.0:
                free[best] = False
                if not counted[best]:
                    continue
                self.scores.append(float(found.scores[row]))
                self.hits.append(True)
                if vehicles[best].visible > MIN_VISIBLE_RATIO and vehicles[best].truncated == 0.0:
                    sides = np.tile(truth[best, 2:] - truth[best, :2], 2)
                    self.edge_rel += (np.abs(found.boxes_px[row] - truth[best]) / sides).tolist()
                if found.scores[row] >= config.score:
                    self._body(found, int(row), vehicles[best], frame)
            elif tall[row] and not box_ious(found.boxes_px[row : row + 1], people).max(initial=0.0) >= config.iou:
                self.scores.append(float(found.scores[row]))
                self.hits.append(False)

    def _counts(self, body: WorldObject, frame: WorldFrame) -> bool:
        config, height_px = self.config, body.box_px[3] - body.box_px[1]
        return bool(
            height_px >= config.min_height_rel * frame.image.shape[0]
            and body.visible >= config.min_visible
            and body.truncated <= config.max_truncated
        )

    def _body(self, found: Detections, row: int, body: WorldObject, frame: WorldFrame) -> None:
        if found.boxes3d is None:
            return
        said = found.boxes3d.take([row]).in_metres(frame.camera)
        x_m, y_m, yaw_rad = said.in_ego(frame.camera, frame.camera.ground)[0]
        pose = body.T_ego_object
        error_rad = math.remainder(yaw_rad - pose.yaw_rad, 2.0 * math.pi)
        self.axis_rad.append(abs(math.remainder(error_rad, math.pi)))
        self.flipped.append(abs(error_rad) > 0.5 * math.pi)
        size_m = np.array([body.length_m, body.width_m, body.height_m])
        self.size_rel.append(np.abs(np.log(said.size_m[0] / size_m)))
        depth_m = float(body.base_cam_m[2] + 0.5 * body.height_m * frame.camera.ground.normal_cam[2])
        self.depth_z.append((float(said.depth_m[0]) - depth_m) / float(said.sigma_depth_m[0]))
        if self.config.near_m <= depth_m <= self.config.far_m:
            self.centre_rel.append(math.hypot(x_m - pose.x_m, y_m - pose.y_m) / depth_m)

    def figures(self) -> dict[str, float]:
        """The rates; NaN without samples."""
        sizes = np.array(self.size_rel).reshape(-1, 3)
        return {
            "frames": self.frames,
            "depth_absrel": _mean(self.absrel),
            "road_iou": _ratio(self.road),
            "lane_iou": _ratio(self.lane),
            "vehicles": self.vehicles,
            "vehicle_ap50": average_precision(self.scores, self.hits, self.vehicles),
            "vehicle_score": best_score_threshold(self.scores, self.hits, self.vehicles),
            "yaw_median_deg": math.degrees(_median(self.axis_rad)),
            "flips": _mean([float(flip) for flip in self.flipped]),
            "centre_median_rel": _median(self.centre_rel),
            "length_median_rel": _median(sizes[:, 0].tolist()),
            "width_median_rel": _median(sizes[:, 1].tolist()),
            "height_median_rel": _median(sizes[:, 2].tolist()),
            "box_sigma_rel": 1.4826 * _median(self.edge_rel),  # box_sigma of a manifest, including the part in pixels
            "depth_sigma_ratio": 1.4826 * _median([abs(z) for z in self.depth_z]),
        }


def _boxes_of(bodies: Sequence[WorldObject]) -> Floats:
    """Boxes (N, 4) in coordinates of pixel edges, as in detections."""
    return np.array([body.box_px for body in bodies], dtype=np.float64).reshape(-1, 4) + 0.5


def overlap(guess: Bools, truth: Bools) -> Ints:
    """(2,) pixels in both, pixels in either."""
    return np.array([np.count_nonzero(guess & truth), np.count_nonzero(guess | truth)])


def box_ious(a: Floats, b: Floats) -> Floats:
    """IoU (N, M) of boxes (N, 4) and (M, 4)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=-1)
    area_a, area_b = (np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (a, b))
    out: Floats = shared / np.maximum(area_a[:, None] + area_b[None, :] - shared, 1e-9)
    return out


def average_precision(scores: list[float], hits: list[bool], truths: int) -> float:
    """Area under the precision-recall curve, with monotonic precision."""
    if truths == 0:
        return math.nan
    order = np.argsort(-np.array(scores), kind="stable")
    hit = np.array(hits, dtype=np.float64)[order]
    recall = np.concatenate([[0.0], np.cumsum(hit) / truths])
    precision = np.cumsum(hit) / np.arange(1, len(hit) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall) * best))


def best_score_threshold(scores: list[float], hits: list[bool], truths: int) -> float:
    """The score threshold with the best F1; NaN without hits."""
    if not any(hits):
        return math.nan
    order = np.argsort(-np.array(scores), kind="stable")
    hit = np.cumsum(np.array(hits, dtype=np.float64)[order])
    f1 = 2.0 * hit / (np.arange(1, len(hit) + 1) + truths)
    return float(scores[order[np.argmax(f1)]])


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _ratio(counts: Ints) -> float:
    return float(counts[0] / counts[1]) if counts[1] else math.nan
