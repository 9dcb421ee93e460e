"""What a vehicle's image says of its size and heading: examples of the built-in world, the layers, losses, ONNX file.

The network sees one box at a time, cut out at one scale along and across, and knows neither where in the image it was
nor how large. So what it says is independent of the road under the vehicle, by which Eq. 1 places it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.perception.crops import CHANNELS, INPUT, KINDS, MEAN_SIZE_M, OUTPUT, WINDOW, cut_out
from birdslam.world.training.export import onnx_file
from birdslam.world.training.losses import von_mises
from birdslam.world.truth import WorldFrame, WorldObject

_CONCENTRATION_MAX = 200.0
TARGETS = ("log_length", "log_width", "log_height", "alpha", "kind", "visible", "box_height_px")


class CropsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which bodies are learned from, and how boxes err."""

    least_height_px: float = 12.0
    least_visible: float = 0.35
    most_truncated: float = 0.5
    max_range_m: float = 80.0
    whole_box: float = 0.4  # how often the box is that of the whole body; else of what shows
    box_rel: float = 0.03  # of a box's edges, 1 sigma
    spare_rel: float = 0.25  # more around the window than is needed, so that it can be moved
    compress: float = 0.5


@dataclass(frozen=True)
class CropExamples:
    """N vehicles: `image` (N, H, W, 3) uint8 BGR with spare around the window, `target` (N, len(TARGETS)) float32."""

    image: NDArray[np.uint8]
    target: Floats32


def crops_of(frame: WorldFrame, config: CropsConfig, rng: np.random.Generator) -> CropExamples:
    """The vehicles of a frame that can be learned from."""
    images, targets = [], []
    for o in frame.objects:
        if o.label not in KINDS or o.visible < config.least_visible or o.truncated > config.most_truncated:
            continue
        if not 1.0 < o.base_cam_m[2] < config.max_range_m:
            continue
        box = _box_of(frame, o, config, rng)
        if box is None or box[3] - box[1] < config.least_height_px:
            continue
        image = cut_out(frame.image, box, 1.0 + config.spare_rel)
        if rng.random() < config.compress:
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 90))])
            image = cv2.imdecode(data, cv2.IMREAD_COLOR)  # type: ignore[assignment]
        pose = o.T_ego_object
        alpha_rad = math.remainder(pose.yaw_rad - math.atan2(pose.y_m, pose.x_m), 2.0 * math.pi)
        logs = np.log(np.array([o.length_m, o.width_m, o.height_m]) / MEAN_SIZE_M)
        images.append(image)
        targets.append([*logs, alpha_rad, KINDS.index(o.label), o.visible, box[3] - box[1]])
    h, w = (round(side * (1.0 + config.spare_rel)) for side in (WINDOW[1], WINDOW[0]))
    return CropExamples(
        np.array(images, np.uint8).reshape(-1, h, w, 3), np.array(targets, np.float32).reshape(-1, len(TARGETS))
    )


def _box_of(frame: WorldFrame, o: WorldObject, config: CropsConfig, rng: np.random.Generator) -> Floats | None:
    """(4,) a box as a detector might have drawn it: around what shows, or around all that is in the image."""
    x1, y1, x2, y2 = o.box_px.tolist()
    if rng.random() >= config.whole_box:
        rows = slice(max(0, math.floor(y1)), math.ceil(y2) + 1)
        columns = slice(max(0, math.floor(x1)), math.ceil(x2) + 1)
        own = frame.instances[rows, columns] == o.object_id + 1
        ys, xs = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
        if not len(ys):
            return None
        x1, x2 = columns.start + float(xs[0]), columns.start + float(xs[-1])
        y1, y2 = rows.start + float(ys[0]), rows.start + float(ys[-1])
    box = np.array([x1, y1, x2 + 1.0, y2 + 1.0])
    out: Floats = box + rng.normal(0.0, config.box_rel, 4) * np.tile(box[2:] - box[:2], 2)
    return out if np.all(out[2:] - out[:2] >= 4.0) else None


class CropNet(nn.Module):
    """(N, 3, H, W) BGR in [-1, 1] -> (N, sum of CHANNELS): see `perception.crops`."""

    def __init__(self, widths: Sequence[int] = (24, 48, 72, 96), joint: int = 128) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for index, width in enumerate(widths):
            layers.append(_convolution(channels, width, 2))
            if index:
                layers.append(_convolution(width, width, 1))
            channels = width
        self.look = nn.Sequential(*layers)
        cells = (WINDOW[0] >> len(widths)) * (WINDOW[1] >> len(widths))
        self.joint = nn.Sequential(nn.Flatten(), nn.Dropout(0.2), nn.Linear(channels * cells, joint), nn.ReLU())
        self.say = nn.Linear(joint, sum(CHANNELS.values()))

    def forward(self, image: Tensor) -> Tensor:
        """What is known of each vehicle."""
        out: Tensor = self.say(self.joint(self.look(image)))
        return out


def _convolution(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


def loss(out: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Each part; their sum is what to minimise. Sizes are Laplace's, the axis von Mises', kind and front logistic."""
    size, log_b, axis, front, kind, visible = torch.split(out.float(), list(CHANNELS.values()), dim=1)
    alpha = target[:, 3]
    log_b = log_b.clamp(-4.0, 1.0)
    off = (size - target[:, :3]).abs()
    logit = front[:, 0] * torch.cos(alpha) + front[:, 1] * torch.sin(alpha)
    return {
        "size": (off * torch.exp(-log_b) + log_b).mean(),
        "axis": von_mises(axis, alpha, _CONCENTRATION_MAX).mean(),
        "front": functional.softplus(-logit).mean(),
        "kind": functional.cross_entropy(kind, target[:, 4].long()),
        "visible": functional.binary_cross_entropy_with_logits(visible[:, 0], target[:, 5].clamp(0.0, 1.0)),
    }


def augmented(image: Tensor, target: Tensor, spare_rel: float) -> tuple[Tensor, Tensor]:
    """(B, 3, H, W) in [-1, 1] of uint8 crops (B, H', W', 3): moved, mirrored, seen by another camera in other light."""
    count, device = len(image), image.device

    def drawn(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *(shape or (1, 1, 1)), device=device)

    def happens(probability: float) -> Tensor:
        return torch.rand(count, 1, 1, 1, device=device) < probability

    x = image.permute(0, 3, 1, 2).float() / 255.0
    # The window within the spare: as large as a box that is 8 % too large or small makes it, and a little aside
    zoom = torch.exp(0.08 * torch.randn(count, device=device).clamp(-2.0, 2.0)) / (1.0 + spare_rel)
    mirror = torch.where(torch.rand(count, device=device) < 0.5, -1.0, 1.0)
    theta = torch.zeros(count, 2, 3, device=device)
    theta[:, 0, 0], theta[:, 1, 1] = zoom * mirror, zoom
    theta[:, :, 2] = 0.05 * torch.randn(count, 2, device=device).clamp(-2.0, 2.0)
    theta[:, 0, 1] = theta[:, 1, 0] = 0.02 * torch.randn(count, device=device)  # a camera that is turned a little
    theta[:, 1, 0] *= -1.0
    grid = functional.affine_grid(theta, [count, 3, WINDOW[1], WINDOW[0]], align_corners=False)
    x = functional.grid_sample(x, grid, mode="bilinear", padding_mode="border", align_corners=False)
    target = target.clone()
    target[:, 3] *= mirror
    # Coarse: seen from afar, or by a film that is compressed
    for share in (0.25, 0.4, 0.6):
        small = functional.interpolate(x, scale_factor=share, mode="bilinear", antialias=True)
        small = functional.interpolate(small, size=x.shape[2:], mode="bilinear")
        x = torch.where(happens(0.12), small, x)
    soft = functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, 1)
    x = torch.where(happens(0.3), soft, x)
    x = torch.where(happens(0.25), x + drawn(0.3, 1.5) * (x - soft), x)
    # Light and colour
    x = torch.where(happens(0.7), x * drawn(0.75, 1.25, 3, 1, 1), x)
    grey = (x * torch.tensor([0.114, 0.587, 0.299], device=device).view(1, 3, 1, 1)).sum(dim=1, keepdim=True)
    x = torch.where(happens(0.6), grey + drawn(0.0, 1.7) * (x - grey), x)
    x = torch.where(happens(0.25), grey.expand_as(x), x)
    ramp = torch.linspace(-1.0, 1.0, WINDOW[0], device=device).view(1, 1, 1, -1) * drawn(-0.4, 0.4)
    ramp = ramp + torch.linspace(-1.0, 1.0, WINDOW[1], device=device).view(1, 1, -1, 1) * drawn(-0.4, 0.4)
    x = torch.where(happens(0.4), x * (1.0 + ramp), x)
    middle = x.mean(dim=(1, 2, 3), keepdim=True).clamp(0.15, 0.75)
    toned = (middle + drawn(0.5, 1.7) * (x - middle) + drawn(-0.2, 0.2)).clamp(1e-4, 1.0)
    x = torch.where(happens(0.8), toned ** torch.exp(drawn(-0.6, 0.6)), x)
    x = torch.where(happens(0.4), x + drawn(0.005, 0.07) * torch.randn_like(x), x)
    # What stands before it: a pole, another car, dirt
    columns = torch.arange(WINDOW[0], device=device).view(1, 1, 1, -1)
    rows = torch.arange(WINDOW[1], device=device).view(1, 1, -1, 1)
    for probability, wide, tall in ((0.25, 0.12, 1.0), (0.2, 0.35, 0.5)):
        w, h = drawn(0.02, wide) * WINDOW[0], drawn(0.2 * tall, tall) * WINDOW[1]
        left, top = drawn(-0.1, 1.0) * WINDOW[0], drawn(-0.1, 0.9) * WINDOW[1]
        over = (columns >= left) & (columns < left + w) & (rows >= top) & (rows < top + h)
        x = torch.where(happens(probability) & over, drawn(0.0, 1.0, 3, 1, 1).expand_as(x), x)
    return x.clamp(0.0, 1.0) * 2.0 - 1.0, target


def to_onnx(network: CropNet) -> bytes:
    """The network as an ONNX file for any number of boxes; the normalisation is in the weights."""
    return onnx_file(network, torch.zeros(2, 3, WINDOW[1], WINDOW[0]), INPUT, (OUTPUT,), "boxes")
