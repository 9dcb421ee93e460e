"""Working resolution of the odometry: images are resized so that a pixel covers about the same angle.

The pixel thresholds of the odometry apply to focal lengths of 600 to 900 px. Larger images are downscaled by area
averaging, smaller ones are upscaled.
"""

from __future__ import annotations

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera

FOCAL_PX = 720.0  # of resized images
MAX_FOCAL_PX = 900.0  # images above this are downscaled
MIN_FOCAL_PX = 600.0  # images below this are upscaled
MIN_UPSCALED_FOCAL_PX = 400.0  # images below this are not resized: upscaling would cost time and add no detail


class WorkingResolution:
    """Converts images, boxes, masks and pixels of one camera; `camera` is that of the resized images."""

    def __init__(self, camera: Camera) -> None:
        focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._original = camera
        self.is_original = MIN_FOCAL_PX <= focal_px <= MAX_FOCAL_PX or focal_px < MIN_UPSCALED_FOCAL_PX
        self._interpolation = cv2.INTER_AREA if focal_px > FOCAL_PX else cv2.INTER_CUBIC
        width_px, height_px = camera.width_px, camera.height_px
        if not self.is_original:
            width_px, height_px = (round(side * FOCAL_PX / focal_px) for side in (width_px, height_px))
        self._scale = np.array([width_px / camera.width_px, height_px / camera.height_px])
        x, y = self._scale
        self.camera = camera
        if not self.is_original:
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
        """Resizes an image (H, W) or (H, W, 3). Raises ValueError for another size than the camera's."""
        if self.is_original:
            return image
        if image.shape[:2] != (self._original.height_px, self._original.width_px):
            raise ValueError(
                f"image of {image.shape[1]}x{image.shape[0]} does not fit the camera of "
                f"{self._original.width_px}x{self._original.height_px}"
            )
        size = self.camera.width_px, self.camera.height_px
        return np.asarray(cv2.resize(image, size, interpolation=self._interpolation), np.uint8)

    def boxes_px(self, boxes_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Converts boxes (N, 4) x1, y1, x2, y2 of the original image."""
        if self.is_original:
            return boxes_px
        return (boxes_px + 0.5) * np.tile(self._scale, 2) - 0.5

    def mask(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """Resizes a mask (H, W) of the original image."""
        if self.is_original or mask is None:
            return mask
        size = self.camera.width_px, self.camera.height_px
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0

    def original_px(self, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Converts pixels (N, 2) to the original image."""
        return px if self.is_original else (px + 0.5) / self._scale - 0.5
