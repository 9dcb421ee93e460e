"""Training of Frustum-PointNet: targets from bodies of the built-in world, layers, losses, and ONNX export."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_eval

from birdslam.geometry.arrays import Bools, Floats, Floats32
from birdslam.geometry.camera import Camera
from birdslam.perception.decoding.depth import DepthMap
from birdslam.perception.pointnet import frustum_of
from birdslam.perception.pointnet_manifest import Body, Points
from birdslam.world.training.export import onnx_file
from birdslam.world.training.losses import von_mises
from birdslam.world.truth import WorldFrame, WorldObject

POINTS = Points(name="points", count=512, features=("x", "y", "z", "u", "v", "log_depth"), scale=0.5)
BODY = Body(output="body")
VEHICLES = ("car", "van", "truck", "bus")
INPUT, OUTPUT = POINTS.name, BODY.output
FAR_M = 300.0  # depth of the sky
MAX_CONCENTRATION = 200.0


class FrustumConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Selection of bodies for training."""

    least_pixels: int = 50
    least_visible: float = 0.4
    most_truncated: float = 0.5
    max_range_m: float = 70.0
    margin_rel: float = 0.15  # around a box, for errors of its edges


class DepthErrorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Error model of a depth network: 1-sigmas as fractions of the depth, and blur.

    Errors are common to a frame and to a body; the relief of a body is too flat, and borders are blurred.
    """

    frame_rel: float = 0.06
    body_rel: float = 0.06
    wave_rel: float = 0.015  # over a body, smoothly
    pixel_rel: float = 0.005
    relief: tuple[float, float] = (0.4, 1.15)
    blur_px: tuple[float, float] = (0.3, 2.2)
    box_rel: float = 0.03  # of a box's edges


@dataclass(frozen=True)
class FrustumExample:
    """One body in one frame: the depth map around its box, and its truth."""

    depth_m: Floats32  # (h, w) of the block; FAR_M for sky
    own: Bools  # (h, w) pixels of the body
    corner: tuple[int, int]  # row and column of the block in the map
    camera: Camera  # its image is the map
    box_px: Floats  # (4,)
    centre_cam_m: Floats  # (3,) of the body
    size_m: Floats  # (3,) length, width, height
    alpha_rad: float  # yaw in ego minus the bearing of the centre


def frusta_of(frame: WorldFrame, config: FrustumConfig) -> list[FrustumExample]:
    """The training examples of a frame."""
    return [frustum_example(o, frame, config) for o in select_bodies(frame, config)]


def select_bodies(frame: WorldFrame, config: FrustumConfig) -> list[WorldObject]:
    """The vehicles that are sufficiently visible."""
    return [
        o
        for o in frame.objects
        if o.label in VEHICLES
        and o.pixels >= config.least_pixels
        and o.visible >= config.least_visible
        and o.truncated <= config.most_truncated
        and 1.0 < o.base_cam_m[2] < config.max_range_m
    ]


def frustum_example(o: WorldObject, frame: WorldFrame, config: FrustumConfig) -> FrustumExample:
    """The block of the frame's depth around a body, and its truth."""
    depth = np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(FAR_M)).astype(np.float32)
    height, width = depth.shape
    x1, y1, x2, y2 = o.box_px.tolist()
    mx, my = config.margin_rel * (x2 - x1) + 1.0, config.margin_rel * (y2 - y1) + 1.0
    rows = slice(max(0, math.floor(y1 - my)), min(height, math.ceil(y2 + my) + 1))
    columns = slice(max(0, math.floor(x1 - mx)), min(width, math.ceil(x2 + mx) + 1))
    up_cam = frame.camera.ground.normal_cam
    pose = o.T_ego_object
    return FrustumExample(
        depth_m=depth[rows, columns].copy(),
        own=frame.instances[rows, columns] == o.object_id + 1,
        corner=(rows.start, columns.start),
        camera=frame.camera,
        box_px=np.array([x1, y1, x2 + 1.0, y2 + 1.0]),
        centre_cam_m=o.base_cam_m + up_cam * o.height_m / 2.0,
        size_m=np.array([o.length_m, o.width_m, o.height_m]),
        alpha_rad=math.remainder(pose.yaw_rad - math.atan2(pose.y_m, pose.x_m), 2.0 * math.pi),
    )


def add_depth_errors(example: FrustumExample, config: DepthErrorConfig, rng: np.random.Generator) -> Floats32:
    """The block's depth (h, w) with random errors of a depth network."""
    log_depth = np.log(example.depth_m)
    own = example.own
    middle = np.median(log_depth[own])
    log_depth = np.where(own, middle + rng.uniform(*config.relief) * (log_depth - middle), log_depth)
    log_depth = log_depth + np.where(own, rng.normal(0.0, config.body_rel), rng.normal(0.0, config.body_rel))
    h, w = own.shape
    wave = rng.normal(0.0, config.wave_rel, (3, 4)).astype(np.float32)
    log_depth = log_depth + cv2.resize(wave, (w, h), interpolation=cv2.INTER_CUBIC)
    log_depth = cv2.GaussianBlur(log_depth.astype(np.float32), (0, 0), rng.uniform(*config.blur_px))
    log_depth = log_depth + rng.normal(0.0, config.pixel_rel, own.shape) + rng.normal(0.0, config.frame_rel)
    return np.exp(log_depth).astype(np.float32)


def box_of(example: FrustumExample, config: DepthErrorConfig, rng: np.random.Generator) -> Floats:
    """The example's box (4,) with random errors of a detector."""
    size = np.tile(example.box_px[2:] - example.box_px[:2], 2)
    out: Floats = example.box_px + rng.normal(0.0, config.box_rel, 4) * size
    return out


def points_of(example: FrustumExample, depth_m: Floats32, box_px: Floats) -> Floats:
    """Pseudo-lidar points (N, 3) of the block's pixels inside a box, in the camera frame."""
    camera = example.camera
    whole = DepthMap(
        np.broadcast_to(np.float32(1.0), (camera.height_px, camera.width_px)), camera.width_px, camera.height_px
    )
    rows, columns = whole.cells(box_px.tolist())
    r0, c0 = example.corner
    h, w = depth_m.shape
    rows = slice(min(max(rows.start, r0), r0 + h), min(max(rows.stop, r0), r0 + h))
    columns = slice(min(max(columns.start, c0), c0 + w), min(max(columns.stop, c0), c0 + w))
    rays = whole.points_cam_m(camera, rows, columns)
    block = depth_m[rows.start - r0 : rows.stop - r0, columns.start - c0 : columns.stop - c0]
    out: Floats = rays * block.reshape(-1, 1)
    return out


def training_pair(
    example: FrustumExample, config: DepthErrorConfig, rng: np.random.Generator
) -> tuple[Floats32, Floats32] | None:
    """Features (C, P) and targets (TARGETS,) of an example with random errors; None with too few points."""
    depth_m = add_depth_errors(example, config, rng)
    frustum = frustum_of(points_of(example, depth_m, box_of(example, config, rng)), POINTS)
    if frustum is None:
        return None
    features = frustum.features
    x, y, z = example.centre_cam_m.tolist()
    c, s = math.cos(frustum.azimuth_rad), math.sin(frustum.azimuth_rad)
    centre = np.array([c * x - s * z, y, s * x + c * z]) - frustum.middle_m
    yaw_rad = example.alpha_rad - math.atan2(x, z) + frustum.azimuth_rad
    if rng.random() < 0.5:  # mirrored
        features, centre, yaw_rad = mirrored(features), centre * [-1.0, 1.0, 1.0], -yaw_rad
    log_size = np.log(example.size_m / BODY.mean_m)
    return features, np.concatenate([centre, log_size, [yaw_rad, 1.0]]).astype(np.float32)


def mirrored(features: Floats32) -> Floats32:
    """The points with left and right exchanged."""
    sign = np.array([-1.0 if name in ("x", "u") else 1.0 for name in POINTS.features], np.float32)
    return features * sign[:, None]


class PointNet(nn.Module):
    """(N, C, P) -> (N, 12), see `perception.pointnet_manifest.Body`: layers per point, maximum, layers per body."""

    def __init__(self, point_widths: Sequence[int] = (48, 96, 160), body_widths: Sequence[int] = (128, 64)) -> None:
        super().__init__()
        self.points = _layers(len(POINTS.features), point_widths)
        self.body = _layers(2 * point_widths[-1] + 1, body_widths)
        self.head = nn.Linear(body_widths[-1], 12)

    def forward(self, points: Tensor) -> Tensor:
        """The outputs for each body."""
        count = points.shape[2]
        of_each = self.points(points.transpose(1, 2).flatten(0, 1)).unflatten(0, (-1, count))
        depth = points[:, POINTS.features.index("log_depth"), 0:1]
        common = torch.cat([of_each.amax(dim=1), of_each.mean(dim=1), depth.to(of_each.dtype)], dim=1)
        out: Tensor = self.head(self.body(common))
        return out


def _layers(channels: int, widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(channels, width), nn.BatchNorm1d(width), nn.ReLU(inplace=True)]
        channels = width
    return nn.Sequential(*layers)


def _folded(layers: nn.Sequential) -> nn.Sequential:
    """The layers with batch normalization folded into the weights."""
    parts = list(layers)
    folded = (fuse_linear_bn_eval(parts[i], parts[i + 1]) for i in range(0, len(parts), 3))
    return nn.Sequential(*(module for linear in folded for module in (linear, nn.ReLU())))


def loss(out: Tensor, target: Tensor) -> dict[str, Tensor]:
    """The parts of the loss; minimize their sum."""
    out = out.float()
    off = out[:, :3] - target[:, :3]
    log_b = out[:, 3].clamp(-3.0, 3.0)
    yaw = target[:, 6]
    axis, front = out[:, 7:9], out[:, 9:11]
    log_b_size = out[:, 11].clamp(-5.0, 1.0)
    logit = front[:, 0] * torch.cos(yaw) + front[:, 1] * torch.sin(yaw)
    size = (out[:, 4:7] - target[:, 3:6]).abs().sum(dim=1)
    return {
        "depth": (off[:, 2].abs() * torch.exp(-log_b) + log_b).mean(),
        "across": 2.0 * functional.smooth_l1_loss(out[:, :2], target[:, :2], beta=0.1),
        "size": 0.5 * (size * torch.exp(-log_b_size) + 3.0 * log_b_size).mean(),
        "axis": von_mises(axis, yaw, MAX_CONCENTRATION).mean(),
        "front": functional.softplus(-logit).mean(),
    }


def to_onnx(network: PointNet) -> bytes:
    """The network as an ONNX file for any number of boxes."""
    network = copy.deepcopy(network).eval()
    network.points, network.body = _folded(network.points), _folded(network.body)
    example = torch.zeros(2, len(POINTS.features), POINTS.count)
    return onnx_file(network, example, INPUT, (OUTPUT,), "boxes")


def manifest(parameters: int, sha256: str) -> str:
    """The manifest of an exported network."""
    features = ", ".join(f'"{name}"' for name in POINTS.features)
    return f"""\
# Frustum-PointNet of {parameters} parameters. Trained by `make train` on the built-in world alone.
title = "Frustum-PointNet of the built-in world"
role = "pointnet"
sha256 = "{sha256}"

[points]
name = "{INPUT}"
count = {POINTS.count}
layout = "{POINTS.layout}"
features = [{features}]
scale = {POINTS.scale}

[pointnet]
decoding = "body"
output = "{OUTPUT}"
mean_m = {list(BODY.mean_m)}
"""
