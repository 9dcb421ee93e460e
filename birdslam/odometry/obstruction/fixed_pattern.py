"""Fixed-pattern mask: a pattern in the road's image that does not move while the car drives (reflection, dirt, bonnet).

It correlates perfectly at standstill and outweighs the road on smooth asphalt. It shows as correlation of equal pixels
of two images between which the car has driven. Lane lines do correlate too, so the past image, warped by the car's
motion, is first projected out of it. Where there is a pattern, the running mean of the images, which holds the pattern
and no moving road, is subtracted from each (fixed-pattern correction), without contrast normalisation: paint counts
then, and not the noise around it. The mean is over metres: one over a few images holds the road that is compared, and
at each rate elsewhere. docs/method.md has the correlations and what that cost.
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
    """When there is a fixed pattern; the thresholds lie between the correlations of docs/method.md."""

    on_threshold: Positive = 0.32  # correlation of equal pixels, above which there is a pattern
    off_threshold: Positive = 0.22  # correlation below which there is none any more
    min_baseline_m: Positive = 0.5  # driven between the two images
    memory_m: Positive = 20.0  # driven, over which the mean goes: as much as an image shows of the road
    judged_images: Annotated[int, msgspec.Meta(ge=1)] = 5  # time constant of the correlation's mean
    # Judged to be without a pattern, until one that is found must have come: one that was there is found in six
    absent_images: Annotated[int, msgspec.Meta(ge=1)] = 10


class FixedPattern:
    """State: the mean images and the mean correlation. Reader: `RoadScale`, for the images that it aligns."""

    def __init__(self, config: FixedPatternConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._recent: Grey | None = None
        self._images = 0  # that the mean is of, at most
        self._absent = 0  # images in a row that were judged to have no pattern
        self._correlation = 0.0
        self.present = False

    def update_mean(self, grey: NDArray[np.uint8], top_px: int, travelled_m: float) -> None:
        """Takes (H, W) grey into the mean, rows from `top_px` on, `travelled_m` after the image before.

        All of the first images count alike, at any rate and while the scale may be far too small.
        """
        cfg, rows = self.config, grey[top_px:]
        if self._mean is None or self._recent is None:
            self._mean, self._recent = rows.astype(np.float32), rows.astype(np.float32)
        self._images += 1
        share = 1.0 - float(np.exp(-travelled_m / cfg.memory_m))
        cv2.accumulateWeighted(rows, self._mean, max(1.0 / self._images, share))
        cv2.accumulateWeighted(rows, self._recent, 1.0 / cfg.judged_images)

    def subtract(self, grey: NDArray[np.uint8], top_px: int) -> NDArray[np.float32]:
        """The rows from `top_px` on without the fixed pattern, smoothed as a RoadImage is."""
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
        """Correlates equal pixels (N, 2) of two images; returns whether `self.present` has changed.

        `warp_past` gives the past image's grey values (N,), warped to these pixels by the car's motion, and which of
        them it shows; None where the length of that motion is not known.
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
        before = self.present
        self.present = self._correlation > (cfg.off_threshold if before else cfg.on_threshold)
        if self.present and self._absent >= cfg.absent_images and self._recent is not None:
            self._mean, self._images = self._recent.copy(), cfg.judged_images
        self._absent = 0 if self.present else self._absent + 1
        return self.present != before


def _orthogonal_part(a: NDArray[np.float64], part: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) a less its projection on `part`, both about their means."""
    a, part = a - a.mean(), part - part.mean()
    out: NDArray[np.float64] = a - part * (float(a @ part) / max(float(part @ part), 1e-9))
    return out


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9)
