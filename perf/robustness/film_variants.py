"""Variants of a film: other sizes and rates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from msgspec.structs import replace

from birdslam.geometry.arrays import Image
from birdslam.geometry.camera import Camera

Timed = tuple[int, Image]  # t_source_ns, the raw image

MIN_WIDTH_PX, MAX_WIDTH_PX = 320, 3840


@dataclass(frozen=True)
class Variant:
    """The differences to the original film."""

    name: str
    size: float = 1.0
    every: int = 1  # use only each n-th image

    def camera(self, camera: Camera) -> Camera:
        """The camera of the changed images; `camera` is that of the original film."""
        if self.size == 1.0:
            return camera
        width_px, height_px = (round(side * self.size) for side in (camera.width_px, camera.height_px))
        x, y = width_px / camera.width_px, height_px / camera.height_px
        return replace(
            camera,
            width_px=width_px,
            height_px=height_px,
            fx_px=camera.fx_px * x,
            fy_px=camera.fy_px * y,
            cx_px=(camera.cx_px + 0.5) * x - 0.5,
            cy_px=(camera.cy_px + 0.5) * y - 0.5,
        )

    def fits(self, camera: Camera) -> bool:
        """Whether the width is within the supported range."""
        return MIN_WIDTH_PX <= camera.width_px * self.size <= MAX_WIDTH_PX

    def images(self, film: Iterator[Timed]) -> Iterator[Timed]:
        """The changed images of a film."""
        for k, (t_ns, image) in enumerate(film):
            if k % self.every:
                continue
            if self.size != 1.0:
                size = round(image.shape[1] * self.size), round(image.shape[0] * self.size)
                how = cv2.INTER_AREA if self.size < 1.0 else cv2.INTER_CUBIC
                image = np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)
            yield t_ns, image


PARTS = ("starts", "sizes")
_SIZES, _EVERY = (1.0, 0.5, 0.75, 2.0), (1, 2, 3)


def variants(camera: Camera, part: str) -> list[Variant]:
    """The variants of a part of PARTS for a film of this camera, the unchanged one first."""
    every = {
        "starts": [_other(1.0, 1), _other(0.5, 1), _other(1.0, 2), _other(1.0, 3)],
        "sizes": [_other(size, n) for size in _SIZES for n in _EVERY],
    }[part]
    return [variant for variant in every if variant.fits(camera)]


def _other(size: float, every: int) -> Variant:
    parts = [f"{size:g} of the size"] * (size != 1.0) + [f"every {every} images"] * (every != 1)
    return Variant(", ".join(parts) or "unchanged", size=size, every=every)
