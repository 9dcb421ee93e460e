"""ENet (Paszke et al. 2016) on bird's-eye occupancy grids, and its training grids from the built-in world.

Differences from its paper: interpolation instead of max-unpooling, for ONNX, and two input channels, road and lane
boundary.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lanes import AmodalLanes, LanesConfig, points_of
from birdslam.perception import Segmentation
from birdslam.world.truth import CLASSES, WorldFrame


class LaneSamplesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors added to the grids of a simulated drive."""

    warm_up_frames: int = 8
    every: int = 2  # frames between two samples of one drive
    sigma_pitch_rad: float = 0.004  # of the ground plane used for projection, per frame
    sigma_drift_rel: float = 0.02  # of the odometry's scale, per drive
    sigma_turn_rad: float = 0.0015  # of its heading, per frame
    hidden_share: float = 0.35  # of the frames in which a part of the masks is lost
    speck_share: float = 0.3  # of the frames with false paint
    lane_lost: float = 0.15  # of the painted pixels, in tiles


class _Bottleneck(nn.Module):
    """A residual block of ENet: reduction to a quarter of the channels, one convolution, expansion."""

    def __init__(self, inputs: int, outputs: int, kind: str = "plain", dilation: int = 1, dropout: float = 0.1) -> None:
        super().__init__()
        inner = max(outputs // 4, 4)
        self.kind = kind
        down = kind == "down"
        entry = nn.Conv2d(inputs, inner, 2, 2, bias=False) if down else nn.Conv2d(inputs, inner, 1, bias=False)
        if kind == "asymmetric":
            middle: nn.Module = nn.Sequential(
                nn.Conv2d(inner, inner, (5, 1), padding=(2, 0), bias=False),
                nn.Conv2d(inner, inner, (1, 5), padding=(0, 2), bias=False),
            )
        elif kind == "up":
            middle = nn.ConvTranspose2d(inner, inner, 2, 2, bias=False)
        else:
            middle = nn.Conv2d(inner, inner, 3, padding=dilation, dilation=dilation, bias=False)
        self.branch = nn.Sequential(
            entry,
            nn.BatchNorm2d(inner),
            nn.PReLU(inner),
            middle,
            nn.BatchNorm2d(inner),
            nn.PReLU(inner),
            nn.Conv2d(inner, outputs, 1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.Dropout2d(dropout),
        )
        same = inputs == outputs
        self.bypass = (
            nn.Identity() if same else nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))
        )
        self.activation = nn.PReLU(outputs)

    def forward(self, x: Tensor) -> Tensor:
        way = x
        if self.kind == "down":
            way = functional.max_pool2d(way, 2)
        way = self.bypass(way)
        if self.kind == "up":
            way = functional.interpolate(way, scale_factor=2.0, mode="nearest")
        out: Tensor = self.activation(way + self.branch(x))
        return out


class ENet(nn.Module):
    """(B, 2, H, W) occupancy -> (B, 2, H, W) logits; H and W divide by 8. 0.23 M parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.entry = nn.Sequential(nn.Conv2d(2, 16, 3, 2, 1, bias=False), nn.BatchNorm2d(16), nn.PReLU(16))
        section = [
            _Bottleneck(128, 128, kind, dilation)
            for kind, dilation in (
                ("plain", 1),
                ("dilated", 2),
                ("asymmetric", 1),
                ("dilated", 4),
                ("plain", 1),
                ("dilated", 8),
                ("asymmetric", 1),
                ("dilated", 16),
            )
        ]
        self.body = nn.Sequential(
            _Bottleneck(16, 64, "down", dropout=0.01),
            *[_Bottleneck(64, 64, dropout=0.01) for _ in range(4)],
            _Bottleneck(64, 128, "down"),
            *section,
        )
        self.up_quarter = _Bottleneck(128, 64, "up")
        self.refine_quarter = nn.Sequential(_Bottleneck(64, 64), _Bottleneck(64, 64))
        self.up_half = _Bottleneck(64, 16, "up")
        self.refine_half = _Bottleneck(16, 16)
        self.exit = nn.ConvTranspose2d(16, 2, 2, 2)

    def forward(self, grids: Tensor) -> Tensor:
        x = self.refine_quarter(self.up_quarter(self.body(self.entry(grids))))
        out: Tensor = self.exit(self.refine_half(self.up_half(x)))
        return out


def loss(logits: Tensor, target: Tensor) -> Tensor:
    """Cross entropy and soft Dice of each channel; boundary cells have four times the weight."""
    weight = torch.ones_like(target)
    weight[:, 1] += 3.0 * target[:, 1]
    entropy = functional.binary_cross_entropy_with_logits(logits, target, weight)
    p = torch.sigmoid(logits)
    overlap = 2.0 * (p * target).sum((0, 2, 3)) + 1.0
    return entropy + (1.0 - overlap / ((p + target).sum((0, 2, 3)) + 1.0)).mean()


def truth_grids(frame: WorldFrame, config: LanesConfig) -> Floats32:
    """(2, rows, columns) of 0 and 1: the road and its painted lines, including hidden parts, dashes joined."""
    out = np.zeros((2, *config.shape), dtype=np.float32)
    for polygon in frame.road_m:
        cv2.fillPoly(out[0], [_cells(polygon, config)], (1.0,))
    # Closes the gap between a side road and the kerb
    out[0] = cv2.morphologyEx(out[0], cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for lane in frame.lanes:
        if lane.kind != "kerb" and len(lane.points_m) > 1:
            cv2.polylines(out[1], [_cells(lane.points_m, config)], False, (1.0,), 1)
    return out


def _cells(points_m: Floats, config: LanesConfig) -> NDArray[np.int32]:
    """(column, row) (N, 2) in OpenCV's order of points in ego."""
    at = (points_m + np.array([config.behind_m, config.half_width_m])) / config.cell_m - 0.5
    return np.round(np.clip(at[:, ::-1], -10_000, 10_000)).astype(np.int32)


def samples(
    frames: Iterator[WorldFrame], rng: np.random.Generator, lanes: LanesConfig, config: LaneSamplesConfig
) -> Iterator[tuple[Floats32, Floats32]]:
    """Pairs (accumulated grids, true grids) of a drive with realistic noise of masks, odometry and ground plane."""
    gathered = AmodalLanes(lanes)
    scale = 1.0 + config.sigma_drift_rel * rng.standard_normal()
    T_world_ego, T_before = SE2(), None
    for index, frame in enumerate(frames):
        T_true = _on_road(frame)
        if T_before is not None:
            step = T_before.between(T_true)
            turn = step.yaw_rad + config.sigma_turn_rad * rng.standard_normal()
            T_world_ego = T_world_ego @ SE2(step.x_m * scale, step.y_m * scale, turn)
        T_before = T_true
        ground = frame.camera.ground
        seen = GroundPlane(
            ground.height_m, ground.pitch_rad + config.sigma_pitch_rad * rng.standard_normal(), ground.roll_rad
        )
        if gathered.has_moved(T_world_ego):
            boxes = np.array([o.box_px for o in frame.objects if o.pixels > 0]).reshape(-1, 4)
            masks = _noisy_masks(frame, rng, config)
            gathered.add(T_world_ego, *points_of(masks, frame.camera, seen, boxes, lanes))
        if index >= config.warm_up_frames and index % config.every == 0:
            yield gathered.grids(T_world_ego), truth_grids(frame, lanes)


def _on_road(frame: WorldFrame) -> SE2:
    """The ego in world: the camera's foot and the heading of its optical axis."""
    forward = frame.T_world_cam[:3, 2]
    return SE2(
        float(frame.T_world_cam[0, 3]), float(frame.T_world_cam[1, 3]), float(np.arctan2(forward[1], forward[0]))
    )


def _noisy_masks(frame: WorldFrame, rng: np.random.Generator, config: LaneSamplesConfig) -> Segmentation:
    """The masks of road and paint with typical network errors: rough edges, missing parts, false paint."""
    height, width = frame.classes.shape
    lane = frame.classes == CLASSES.index("lane")
    road = lane | (frame.classes == CLASSES.index("road"))
    tiles = rng.random((12, 40)) < config.lane_lost
    lane = lane & ~cv2.resize(tiles.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
    if rng.random() < 0.5:
        lane = cv2.dilate(lane.astype(np.uint8), np.ones((1, 3), np.uint8)).astype(bool)
    wave = cv2.resize(rng.standard_normal((6, 20)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    road = road & (wave < 1.5)
    if rng.random() < config.hidden_share:  # a shadow, glare, a wiper
        left, right = np.sort(rng.integers(0, width, 2))
        road[:, left:right], lane[:, left:right] = False, False
    if rng.random() < config.speck_share:
        paint = lane.astype(np.uint8)
        start = rng.integers([0, height // 2], [width, height])
        cv2.line(paint, start.tolist(), (start + rng.integers([-60, 2], [60, 30])).tolist(), (1,), 2)
        lane = paint.astype(bool) & road
    return Segmentation(road=road, lane=lane)
