"""Image augmentation: effects of camera, lens, exposure and compression, stronger than in the renderer.

Strong photometric augmentation lets the network generalize from rendered to real images.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats32
from birdslam.world.training.targets import Window


class AugmentationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Probabilities of the effects; their strengths are random within the range of real cameras."""

    mirror: float = 0.5
    crop: float = 0.5
    crop_min: float = 0.6  # of the width and of the height
    squeeze: float = 0.25  # a taller image, squeezed to the input's aspect
    grey: float = 0.3
    tone: float = 0.8
    colour: float = 0.7
    light: float = 0.4
    local_contrast: float = 0.2
    blur: float = 0.3
    sharpen: float = 0.25
    coarse: float = 0.25
    noise: float = 0.4
    compress: float = 0.3
    hide: float = 0.2


def draw_window(width_px: int, height_px: int, config: AugmentationConfig, rng: np.random.Generator) -> Window:
    """A random window of a frame: the whole, a crop, or a column that is squeezed to the input's aspect ratio."""
    wide, tall = 1.0, 1.0
    if rng.random() < config.squeeze:
        wide = rng.uniform(0.4, 0.8)
    elif rng.random() < config.crop:
        wide = rng.uniform(config.crop_min, 1.0)
        tall = float(np.clip(wide * rng.uniform(0.85, 1.2), config.crop_min, 1.0))
    crop_width, crop_height = round(wide * width_px), round(tall * height_px)
    x0 = int(rng.integers(0, width_px - crop_width + 1))
    y0 = int(rng.integers(0, height_px - crop_height + 1))
    return Window(x0, y0, x0 + crop_width, y0 + crop_height, bool(rng.random() < config.mirror))


def photometric(image: NDArray[np.uint8], config: AugmentationConfig, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Augments an image (H, W, 3) as if from another camera in other light."""
    height_px, width_px = image.shape[:2]

    def happens(probability: float) -> bool:
        return bool(rng.random() < probability)

    if happens(config.hide):
        image = _hide(image, rng)
    out = image.astype(np.float32) / np.float32(255.0)
    if happens(config.light):
        out *= _light(width_px, height_px, rng)[..., None]
    if happens(config.colour):
        out *= rng.uniform(0.75, 1.25, 3).astype(np.float32)
        grey = out @ np.array([0.114, 0.587, 0.299], dtype=np.float32)
        saturation = np.float32(rng.uniform(0.0, 1.7))
        out = grey[..., None] + saturation * (out - grey[..., None])
    if happens(config.grey):
        weights = rng.dirichlet([2.0, 6.0, 3.0]).astype(np.float32)
        out = np.repeat((out @ weights)[..., None], 3, axis=2)
    if happens(config.blur):
        out = _blur(out, rng)
    if happens(config.coarse):
        share = rng.uniform(0.35, 0.9)
        small = cv2.resize(out, (round(width_px * share), round(height_px * share)), interpolation=cv2.INTER_AREA)
        out = cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)
    if happens(config.sharpen):
        soft = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.7, 1.5))
        out = out + np.float32(rng.uniform(0.3, 1.5)) * (out - soft)
    if happens(config.tone):
        middle = np.float32(np.clip(out.mean(), 0.15, 0.75))
        out = middle + np.float32(rng.uniform(0.55, 1.7)) * (out - middle) + np.float32(rng.uniform(-0.2, 0.2))
        out = np.clip(out, 0.0, 1.0) ** np.float32(np.exp(rng.uniform(-0.6, 0.6)))
    if happens(config.noise):
        noise = rng.standard_normal(out.shape if happens(0.5) else (height_px, width_px, 1), dtype=np.float32)
        out = out + np.float32(rng.uniform(0.005, 0.06)) * noise
    pixels: NDArray[np.uint8] = np.clip(out * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    if happens(config.local_contrast):
        pixels = _equalised(pixels, rng)
    if happens(config.compress):
        _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 85))])
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)  # type: ignore[assignment]
    return pixels


def _light(width_px: int, height_px: int, rng: np.random.Generator) -> Floats32:
    """Uneven light: a smooth field, or a shadow with a hard edge."""
    coarse = rng.uniform(0.5, 1.4, (3, 5)).astype(np.float32)
    field = cv2.resize(coarse, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    if rng.random() < 0.5:
        field = np.ones((height_px, width_px), dtype=np.float32)
        for _ in range(int(rng.integers(1, 4))):
            centre = rng.uniform(0.0, 1.0, 2) * [width_px, height_px]
            corners = centre + rng.uniform(-0.35, 0.35, (4, 2)) * [width_px, height_px]
            hull = cv2.convexHull(corners.astype(np.int32))
            cv2.fillConvexPoly(field, hull, float(rng.uniform(0.2, 0.8)))
    return field.astype(np.float32, copy=False)


def _blur(out: Floats32, rng: np.random.Generator) -> Floats32:
    if rng.random() < 0.6:
        return cv2.GaussianBlur(out, (0, 0), rng.uniform(0.4, 1.6)).astype(np.float32, copy=False)
    length = int(rng.integers(3, 8))
    kernel = np.zeros((length, length), dtype=np.float32)
    angle = rng.uniform(0.0, np.pi)
    reach = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    start, end = (0.5 * (length - 1) - reach).astype(int), (0.5 * (length - 1) + reach).astype(int)
    cv2.line(kernel, (int(start[0]), int(start[1])), (int(end[0]), int(end[1])), 1.0)
    return cv2.filter2D(out, -1, kernel / kernel.sum()).astype(np.float32, copy=False)


def _equalised(pixels: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    clahe = cv2.createCLAHE(clipLimit=float(rng.uniform(1.0, 4.0)), tileGridSize=(8, 4))
    lab = cv2.cvtColor(pixels, cv2.COLOR_BGR2YCrCb)
    lab[..., 0] = clahe.apply(np.ascontiguousarray(lab[..., 0]))
    return cv2.cvtColor(lab, cv2.COLOR_YCrCb2BGR).astype(np.uint8, copy=False)


def _hide(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Small patches of one colour or of noise, such as dirt."""
    height_px, width_px = image.shape[:2]
    out = image.copy()
    for _ in range(int(rng.integers(1, 5))):
        w, h = int(width_px * rng.uniform(0.02, 0.08)), int(height_px * rng.uniform(0.04, 0.15))
        x, y = int(rng.integers(0, width_px - w)), int(rng.integers(0, height_px - h))
        patch = rng.integers(0, 256, (h, w, 3) if rng.random() < 0.5 else (1, 1, 3), dtype=np.uint8)
        out[y : y + h, x : x + w] = patch
    return out
