"""The resolution at which ego-motion is estimated: pixels of a lens whose focal length is known to suit it.

What follows corners and compares roads has its lengths in pixels of cameras of 600 to 900 px of focal length. A film
with more pixels shows no more of the road but the encoder's blocks and the sensor's noise: it is made smaller first, by
the mean over areas, so that a pixel is the same angle. One with fewer is made larger: with its own pixels the same
smoothing, windows and limits would be other angles of the road.
"""

from __future__ import annotations

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera

FOCAL_PX = 720.0  # that of an image that is made smaller or larger
LARGEST_FOCAL_PX = 900.0  # with more it is made smaller
SMALLEST_FOCAL_PX = 600.0  # with less it is made larger
MIN_FOCAL_PX = 400.0  # with still less it stays: made larger it would cost four times the time and show little more


class WorkingResolution:
    """Images, boxes, masks and pixels of one camera at the working resolution; `camera` is that of the images there."""

    def __init__(self, camera: Camera) -> None:
        focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._given = camera
        self.is_given = SMALLEST_FOCAL_PX <= focal_px <= LARGEST_FOCAL_PX or focal_px < MIN_FOCAL_PX
        self._interpolation = cv2.INTER_AREA if focal_px > FOCAL_PX else cv2.INTER_CUBIC
        width_px, height_px = camera.width_px, camera.height_px
        if not self.is_given:
            width_px, height_px = (round(side * FOCAL_PX / focal_px) for side in (width_px, height_px))
        self._scale = np.array([width_px / camera.width_px, height_px / camera.height_px])
        x, y = self._scale
        self.camera = camera
        if not self.is_given:
            self.camera = replace(
                camera,
                width_px=width_px,
                height_px=height_px,
                fx_px=camera.fx_px * x,
                fy_px=camera.fy_px * y,
                cx_px=(camera.cx_px + 0.5) * x - 0.5,
                cy_px=(camera.cy_px + 0.5) * y - 0.5,
            )

    def image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W) or (H, W, 3). Raises ValueError for another size than the camera's."""
        if self.is_given:
            return image
        if image.shape[:2] != (self._given.height_px, self._given.width_px):
            raise ValueError(f"an image of {image.shape[1]}x{image.shape[0]} is none of this camera")
        size = self.camera.width_px, self.camera.height_px
        return np.asarray(cv2.resize(image, size, interpolation=self._interpolation), np.uint8)

    def boxes_px(self, boxes_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 4) x1, y1, x2, y2 of the given image."""
        if self.is_given:
            return boxes_px
        return (boxes_px + 0.5) * np.tile(self._scale, 2) - 0.5

    def mask(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """(H, W) of the given image."""
        if self.is_given or mask is None:
            return mask
        size = self.camera.width_px, self.camera.height_px
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0

    def given_px(self, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) pixels of the given image for those here."""
        return px if self.is_given else (px + 0.5) / self._scale - 0.5
