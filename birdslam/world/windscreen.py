"""What stands still between the road and the camera: drops, dirt, a reflection on the glass, the car's own bonnet.

Drawn over images that are rendered or recorded, seeded, with OpenCV and numpy alone.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Edit = Callable[[int, int, Image], Image]  # an image's index, how many there are, the image -> what is seen of it

KINDS = ("nothing", "drops", "dirt", "reflection")
BONNET_SHARE = 0.14  # of the image's height, in its middle


class Overlay:
    """`draw` puts one of KINDS over an image, the same each time.

    Dirt is opaque, a drop shows the image upside down and blurred within a bright rim, a reflection is added to what
    lies behind it.
    """

    def __init__(self, kind: str, width_px: int, height_px: int, seed: int) -> None:
        self.kind = kind
        rng = np.random.default_rng(seed)
        count = {"drops": 60, "dirt": 45, "reflection": 40}.get(kind, 0)
        cover = np.zeros((height_px, width_px), np.float32)  # share of the overlay in each pixel
        brightness = np.zeros((height_px, width_px), np.float32)  # its own brightness
        for _ in range(count):
            centre = (int(rng.integers(0, width_px)), int(rng.integers(0, height_px)))
            radius = int(rng.integers(5, 26) * width_px / 1242)
            light = float(rng.uniform(15.0, 70.0))
            if kind == "reflection":  # of what lies on the dashboard: edges over the lower half
                centre = (centre[0], height_px // 2 + centre[1] // 2)
                end = (centre[0] + int(rng.integers(-150, 150)), centre[1] + int(rng.integers(-20, 20)))
                cv2.line(brightness, centre, end, light, int(rng.integers(1, 4)), cv2.LINE_AA)
            else:
                cv2.circle(cover, centre, radius, 1.0, -1, cv2.LINE_AA)
                cv2.circle(brightness, centre, radius, light if kind == "dirt" else 0.0, -1, cv2.LINE_AA)
                if kind == "drops":
                    cv2.ellipse(brightness, centre, (radius, radius), 0.0, 200.0, 340.0, light, 2, cv2.LINE_AA)
        self._cover = cv2.GaussianBlur(cover, (0, 0), 1.5)[..., None]
        self._light = cv2.GaussianBlur(brightness, (0, 0), 1.0)[..., None]

    def draw(self, image: Image) -> Image:
        """(H, W) grey or (H, W, 3)."""
        if self.kind == "nothing":
            return image
        seen = image.reshape(*image.shape[:2], -1).astype(np.float32)
        if self.kind == "dirt":
            drawn = (1.0 - self._cover) * seen + self._cover * self._light
        else:
            inside = cv2.GaussianBlur(image[::-1], (0, 0), 6.0).reshape(seen.shape)
            drawn = (1.0 - self._cover) * seen + self._cover * inside + self._light
        return np.clip(drawn, 0.0, 255.0).astype(np.uint8).reshape(image.shape)


def from_middle(kind: str, seed: int) -> Edit:
    """One of KINDS over the second half of the images."""
    overlays: dict[tuple[int, ...], Overlay] = {}

    def edit(index: int, count: int, image: Image) -> Image:
        size = (image.shape[1], image.shape[0])
        overlay = overlays.setdefault(size, Overlay(kind, *size, seed))
        return overlay.draw(image) if 2 * index >= count else image

    return edit


def bonnet(image: Image, lacquer: float = 40.0, mirrored: float = 0.35) -> Image:
    """A car's own bonnet along the lower edge: lacquer of one brightness that mirrors, blurred, what is over it."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    high = BONNET_SHARE * height
    centre, axes = (width // 2, height + round(high)), (round(0.62 * width), round(2.0 * high))
    cv2.ellipse(mask, centre, axes, 0.0, 0.0, 360.0, 1.0, -1, cv2.LINE_AA)
    upside_down = cv2.GaussianBlur(image[::-1], (0, 0), sigmaX=4.0, sigmaY=10.0).astype(np.float32)
    shown = lacquer + mirrored * np.roll(upside_down, round(0.5 * height), axis=0)
    cover = mask if image.ndim == 2 else mask[..., None]
    return np.clip((1.0 - cover) * image + cover * shown, 0.0, 255.0).astype(np.uint8)
