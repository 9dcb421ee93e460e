"""Image of the road with normalised local brightness and contrast, and its gradients."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.float32]


class RoadImage:
    """The part of a grey image that can show road, with local brightness and contrast normalised.

    Otherwise edges of shadows outweigh the texture of the road. `floor_grey` is added to the contrast over `window_px`,
    so that noise on smooth road is not amplified.
    """

    def __init__(self, grey: NDArray[np.uint8], top_px: int, window_px: int, floor_grey: float) -> None:
        self.top_px = top_px
        smooth = cv2.GaussianBlur(grey[top_px:], (5, 5), 1.0)
        window = (window_px, window_px)
        mean = cv2.boxFilter(smooth, cv2.CV_32F, window)
        contrast = cv2.sqrBoxFilter(smooth, cv2.CV_32F, window)
        cv2.subtract(contrast, cv2.multiply(mean, mean), dst=contrast)
        cv2.sqrt(np.maximum(contrast, 0.0, out=contrast), dst=contrast)
        np.add(contrast, np.float32(floor_grey), out=contrast)
        difference = cv2.subtract(smooth, mean, dst=mean, dtype=cv2.CV_32F)
        self.grey: Grey = cv2.divide(difference, contrast, dst=mean, scale=10.0)  # type: ignore[assignment]
        self._gradients: tuple[Grey, Grey] | None = None

    @classmethod
    def from_normalised(cls, grey: Grey, top_px: int) -> RoadImage:
        """Image of rows from `top_px` on that are already normalised."""
        image = cls.__new__(cls)
        image.top_px, image.grey, image._gradients = top_px, grey, None
        return image

    @property
    def gradients(self) -> tuple[Grey, Grey]:
        """d grey / du and d grey / dv (grey levels per pixel)."""
        if self._gradients is None:
            self._gradients = (
                cv2.Scharr(self.grey, cv2.CV_32F, 1, 0, scale=1.0 / 32.0),
                cv2.Scharr(self.grey, cv2.CV_32F, 0, 1, scale=1.0 / 32.0),
            )  # type: ignore[assignment]
        assert self._gradients is not None
        return self._gradients
