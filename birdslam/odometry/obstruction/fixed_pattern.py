"""What stands still in the road's image while the car drives: reflections on the windscreen, dirt, a bonnet.

It agrees with itself best where the car is held to stand, and on smooth asphalt it outweighs the road. The same pixels
of two images between which the car has driven show it: of a road they have nothing in common, so that their correlation
stays below 0.2 (KITTI 00, 01, 06, 0005), while a windscreen's reflection over smooth asphalt gives 0.4 to 0.7 (the
motorway clip, where a dashboard's edge is mirrored). Lines along the way stand in the image too, in a bend as long as
it bends the same, and give as much: so what the road has where the car has driven on is taken out of what stood before
the two are compared. With that lines come to 0.2, and dirt and drops keep the 0.4 to 0.5 that they have (the built-in
world's ramps and motorways). Where a pattern stands still, the mean of the last images is taken out of each, which
holds what stands still and no road that moves, and the rest is compared as bright as it is: paint counts, and not the
noise around it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.odometry.road.alignment import Grey, RoadImage

Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class StandingPatternConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When a pattern counts as one that stands still; the two correlations lie between those of the drives above."""

    begins_at: Positive = 0.32  # correlation of the same pixels from which on a pattern stands still
    ends_at: Positive = 0.22  # correlation below which it is gone
    min_baseline_m: Positive = 0.5  # driven between the two images
    memory_images: Annotated[int, msgspec.Meta(ge=2)] = 8  # shorter than a dash's period at 30 m/s and 25 Hz
    judged_images: Annotated[int, msgspec.Meta(ge=1)] = 5  # in a row that have to agree on it


class StandingPattern:
    """`learn` each image that the car drove to, `judge` pairs of them."""

    def __init__(self, config: StandingPatternConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._images = 0
        self._correlation = 0.0
        self.present = False

    def learn(self, grey: NDArray[np.uint8], top_px: int) -> None:
        """(H, W) grey; of the rows from `top_px` on."""
        if self._mean is None:
            self._mean = np.zeros((grey.shape[0] - top_px, grey.shape[1]), np.float32)
        self._images += 1
        cv2.accumulateWeighted(grey[top_px:], self._mean, max(1.0 / self._images, 1.0 / self.config.memory_images))

    def without(self, grey: NDArray[np.uint8], top_px: int) -> NDArray[np.float32]:
        """The rows from `top_px` on, less what stands still, smoothed as a RoadImage is."""
        assert self._mean is not None
        rest = cv2.subtract(grey[top_px:], self._mean, dtype=cv2.CV_32F)
        return np.asarray(cv2.GaussianBlur(rest, (5, 5), 1.0), np.float32)

    def judge(
        self,
        past: RoadImage,
        present: RoadImage,
        px: NDArray[np.int64],
        baseline_m: float,
        driven: Callable[[], tuple[NDArray[np.float64], NDArray[np.bool_]]] | None = None,
    ) -> bool:
        """Looks at the same pixels (N, 2) of two images; whether `present` has changed.

        `driven` gives (N,) what the past image has where the car's motion puts these pixels, and whether it has it;
        None where the length of that motion is not known.
        """
        cfg = self.config
        if baseline_m < cfg.min_baseline_m or len(px) < 2:
            return False
        a, b = (image.grey[px[:, 1] - image.top_px, px[:, 0]].astype(np.float64) for image in (past, present))
        alike = _correlation(a, b)
        if driven is not None and alike > cfg.ends_at:
            there, seen = driven()
            alike = _correlation(_without(a[seen], there[seen]), b[seen]) if seen.sum() > 1 else 0.0
        self._correlation += (alike - self._correlation) / cfg.judged_images
        before = self.present
        self.present = self._correlation > (cfg.ends_at if before else cfg.begins_at)
        return self.present != before


def _without(a: NDArray[np.float64], part: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) what of a is not a multiple of `part`, both about their means."""
    a, part = a - a.mean(), part - part.mean()
    out: NDArray[np.float64] = a - part * (float(a @ part) / max(float(part @ part), 1e-9))
    return out


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9)
