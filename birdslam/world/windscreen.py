"""Draws fixed obstructions over images: drops, dirt, a reflection on the windscreen, the ego's bonnet.

For rendered or recorded images, seeded, with OpenCV and numpy only.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from birdslam.geometry.arrays import Image

Edit = Callable[[int, int, Image], Image]  # index of an image, number of images, image -> edited image

KINDS = ("drops", "rain", "drops_defocused", "dirt", "reflection")
# Defocused drops: number, radius and blur in image widths, opacity, refraction towards their centre, and light that
# they add (sky) or absorb
_DEFOCUSED_DROPS, _DEFOCUSED_RADIUS_REL, _DEFOCUS_REL = 45, (0.012, 0.04), 0.006
_DEFOCUSED_COVER, _BEND, _DEFOCUSED_LIGHT_GREY = (0.4, 0.95), (-0.5, 0.5), (-25.0, 35.0)
BONNET_SHARE = 0.14  # of the image height, at the centre column
BONNET_GREY, REFLECTED_RATIO = 40.0, 0.35  # brightness of a bonnet, and its reflectance


class Overlay:
    """`draw` draws one of KINDS over an image, always at the same position.

    Dirt is opaque. A drop shows the image upside down and blurred within a bright rim; rain has many small drops. A
    reflection is added to the image. A defocused drop is a wide, faint disc without a rim that blurs and refracts the
    image, and absorbs or adds light.
    """

    def __init__(self, kind: str, width_px: int, height_px: int, seed: int) -> None:
        self.kind = kind
        if kind == "drops_defocused":
            self._lens = _Lens(width_px, height_px, seed)
            return
        rng = np.random.default_rng(seed)
        count = {"drops": 60, "rain": 1200, "dirt": 45, "reflection": 40}[kind]
        cover = np.zeros((height_px, width_px), np.float32)  # opacity of each pixel
        brightness = np.zeros((height_px, width_px), np.float32)  # of the overlay
        for _ in range(count):
            centre = (int(rng.integers(0, width_px)), int(rng.integers(0, height_px)))
            largest = 8 if kind == "rain" else 26
            radius = max(1, int(rng.integers(largest // 5, largest) * width_px / 1242))
            light = float(rng.uniform(15.0, 70.0))
            if kind == "reflection":  # objects on the dashboard: edges in the lower half
                centre = (centre[0], height_px // 2 + centre[1] // 2)
                end = (centre[0] + int(rng.integers(-150, 150)), centre[1] + int(rng.integers(-20, 20)))
                cv2.line(brightness, centre, end, light, int(rng.integers(1, 4)), cv2.LINE_AA)
            else:
                cv2.circle(cover, centre, radius, 1.0, -1, cv2.LINE_AA)
                cv2.circle(brightness, centre, radius, light if kind == "dirt" else 0.0, -1, cv2.LINE_AA)
                if kind in ("drops", "rain"):
                    thick = 2 if kind == "drops" else 1
                    cv2.ellipse(brightness, centre, (radius, radius), 0.0, 200.0, 340.0, light, thick, cv2.LINE_AA)
        self._cover = cv2.GaussianBlur(cover, (0, 0), 1.5)[..., None]
        self._light = cv2.GaussianBlur(brightness, (0, 0), 1.0)[..., None]

    def draw(self, image: Image) -> Image:
        """(H, W) grey or (H, W, 3)."""
        if self.kind == "drops_defocused":
            return self._lens.draw(image)
        seen = image.reshape(*image.shape[:2], -1).astype(np.float32)
        if self.kind == "dirt":
            drawn = (1.0 - self._cover) * seen + self._cover * self._light
        else:
            inside = cv2.GaussianBlur(image[::-1], (0, 0), 6.0).reshape(seen.shape)
            drawn = (1.0 - self._cover) * seen + self._cover * inside + self._light
        return np.clip(drawn, 0.0, 255.0).astype(np.uint8).reshape(image.shape)


class _Lens:
    """Defocused drops: `draw` shows the image through them."""

    def __init__(self, width_px: int, height_px: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        v, u = np.mgrid[:height_px, :width_px].astype(np.float32)
        self._u, self._v = u.copy(), v.copy()  # source position of each pixel
        self._cover = np.zeros((height_px, width_px), np.float32)
        self._light = np.zeros((height_px, width_px), np.float32)
        self._blur_px = _DEFOCUS_REL * width_px
        for _ in range(_DEFOCUSED_DROPS):
            x, y = rng.uniform(0.0, width_px), rng.uniform(0.0, height_px)
            radius = rng.uniform(*_DEFOCUSED_RADIUS_REL) * width_px
            shape = np.exp(-((np.square((u - x) / radius) + np.square((v - y) / (1.2 * radius))) ** 2))  # a soft disc
            shape[shape < 1e-3] = 0.0
            bend = rng.uniform(*_BEND) * shape
            self._u += bend * (x - u)
            self._v += bend * (y - v)
            self._cover = np.maximum(self._cover, rng.uniform(*_DEFOCUSED_COVER) * shape)
            self._light += rng.uniform(*_DEFOCUSED_LIGHT_GREY) * shape

    def draw(self, image: Image) -> Image:
        """(H, W) grey or (H, W, 3)."""
        bent = cv2.remap(image, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        behind = cv2.GaussianBlur(bent, (0, 0), self._blur_px).astype(np.float32)
        cover, light = (part if image.ndim == 2 else part[..., None] for part in (self._cover, self._light))
        return np.clip((1.0 - cover) * bent + cover * behind + light, 0.0, 255.0).astype(np.uint8)


def from_share(kind: str, seed: int, share: float) -> Edit:
    """One of KINDS over the images from a fraction of the sequence on; 0: from the first one."""
    overlays: dict[tuple[int, ...], Overlay] = {}

    def edit(index: int, count: int, image: Image) -> Image:
        size = (image.shape[1], image.shape[0])
        overlay = overlays.setdefault(size, Overlay(kind, *size, seed))
        return overlay.draw(image) if index >= share * count else image

    return edit


def bonnet(image: Image) -> Image:
    """The ego's bonnet along the lower edge, which reflects the image above it, blurred."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    high = BONNET_SHARE * height
    centre, axes = (width // 2, height + round(high)), (round(0.62 * width), round(2.0 * high))
    cv2.ellipse(mask, centre, axes, 0.0, 0.0, 360.0, 1.0, -1, cv2.LINE_AA)
    upside_down = cv2.GaussianBlur(image[::-1], (0, 0), sigmaX=4.0, sigmaY=10.0).astype(np.float32)
    shown = BONNET_GREY + REFLECTED_RATIO * np.roll(upside_down, round(0.5 * height), axis=0)
    cover = mask if image.ndim == 2 else mask[..., None]
    return np.clip((1.0 - cover) * image + cover * shown, 0.0, 255.0).astype(np.uint8)
