"""Fixed-pattern correction: removes a pattern that is fixed in the image (reflection, dirt, bonnet) from the road.

A pattern correlates at equal pixels of two images of a moving car, after projecting out the past image warped by the
motion (lane lines correlate too). If there is one, the running mean of the images is subtracted, without contrast
normalisation, which would amplify noise. The mean is over distance, so that it is independent of the frame rate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.odometry.road.road_image import Grey, RoadImage

Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class FixedPatternConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of the fixed pattern."""

    on_threshold: Positive = 0.32  # correlation of equal pixels above which a pattern appears
    off_threshold: Positive = 0.22  # correlation below which a pattern disappears
    min_baseline_m: Positive = 0.5  # minimum distance between the two images
    memory_m: Positive = 20.0  # averaging distance: the length of road that an image shows
    judged_images: Annotated[int, msgspec.Meta(ge=1)] = 5  # time constant of the correlation's mean
    # Images without a pattern after which a detected pattern is new, so that the mean restarts
    absent_images: Annotated[int, msgspec.Meta(ge=1)] = 10


class FixedPattern:
    """State: the mean images and the mean correlation. Reader: `RoadScale`, which corrects the images it aligns."""

    def __init__(self, config: FixedPatternConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._recent: Grey | None = None
        self._images = 0  # image count of the mean
        self._absent_images = 0  # consecutive images without a pattern
        self._correlation = 0.0
        self.present = False

    def update_mean(self, grey: NDArray[np.uint8], top_px: int, travelled_m: float) -> None:
        """Adds an image (H, W), rows from `top_px`, `travelled_m` after the previous one, to the mean.

        The first images have equal weights, since the scale may still be wrong.
        """
        cfg, rows = self.config, grey[top_px:]
        if self._mean is None or self._recent is None:
            self._mean, self._recent = rows.astype(np.float32), rows.astype(np.float32)
        self._images += 1
        share = 1.0 - float(np.exp(-travelled_m / cfg.memory_m))
        cv2.accumulateWeighted(rows, self._mean, max(1.0 / self._images, share))
        cv2.accumulateWeighted(rows, self._recent, 1.0 / cfg.judged_images)

    def subtract(self, grey: NDArray[np.uint8], top_px: int) -> NDArray[np.float32]:
        """The rows from `top_px` without the fixed pattern, smoothed as in RoadImage."""
        assert self._mean is not None
        difference = cv2.subtract(grey[top_px:], self._mean, dtype=cv2.CV_32F)
        return np.asarray(cv2.GaussianBlur(difference, (5, 5), 1.0), np.float32)

    def detect(
        self,
        past: RoadImage,
        present: RoadImage,
        px: NDArray[np.int64],
        baseline_m: float,
        warp_past: Callable[[], tuple[NDArray[np.float64], NDArray[np.bool_]]] | None = None,
    ) -> bool:
        """Correlates equal pixels (N, 2) of two images; returns whether `present` has changed.

        `warp_past` returns the past image's grey values (N,) warped to these pixels by the car's motion, and which of
        them are visible; None if the length of the motion is unknown.
        """
        cfg = self.config
        if baseline_m < cfg.min_baseline_m or len(px) < 2:
            return False
        a, b = (image.grey[px[:, 1] - image.top_px, px[:, 0]].astype(np.float64) for image in (past, present))
        correlation = _correlation(a, b)
        if warp_past is not None and correlation > cfg.off_threshold:
            warped, seen = warp_past()
            correlation = _correlation(_orthogonal_part(a[seen], warped[seen]), b[seen]) if seen.sum() > 1 else 0.0
        self._correlation += (correlation - self._correlation) / cfg.judged_images
        was_present = self.present
        self.present = self._correlation > (cfg.off_threshold if was_present else cfg.on_threshold)
        if self.present and self._absent_images >= cfg.absent_images and self._recent is not None:
            self._mean, self._images = self._recent.copy(), cfg.judged_images
        self._absent_images = 0 if self.present else self._absent_images + 1
        return self.present != was_present


def _orthogonal_part(a: NDArray[np.float64], part: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) `a` minus its projection on `part`, both about their means."""
    a, part = a - a.mean(), part - part.mean()
    out: NDArray[np.float64] = a - part * (float(a @ part) / max(float(part @ part), 1e-9))
    return out


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9)
