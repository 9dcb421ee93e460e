"""Paint in single images, against masks by hand as comma10k has them: precision and recall at some pixels.

A folder holds imgs/NAME.png and masks/NAME.png; in a mask ff0000 (RGB) is lane marking, cc00ff the own car.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.figures import mean
from birdslam.bench.lanes.image_masks import Pair, checked
from birdslam.geometry.arrays import Bools

MARKING, OWN_CAR = (0, 0, 255), (255, 0, 204)  # BGR
REACH_PX = 5  # from a pixel of the one to one of the other
NIGHT_GREY = 40.0  # mean of an image that is darker


class PaintScore(msgspec.Struct, frozen=True, kw_only=True):
    """One image, or all of a kind together. None: there was no paint to find, or none was found."""

    image: str
    night: bool
    precision: float | None  # share of the found pixels within REACH_PX of true paint
    recall: float | None  # share of the true pixels within REACH_PX of found paint
    found_px: int
    true_px: int


class PaintReport(msgspec.Struct, frozen=True, kw_only=True):
    """A folder of images by one network; means over images that have the number."""

    network: str
    images: int
    precision: float | None
    recall: float | None
    recall_by_night: float | None
    by_image: tuple[PaintScore, ...]


def find_pairs(folder: Path) -> list[Pair]:
    """Images with their masks. Raises DatasetError where there are none, or one has no mask."""
    images = sorted((folder / "imgs").glob("*.png"))
    pairs = [Pair(number, image, folder / "masks" / image.name) for number, image in enumerate(images)]
    return checked(pairs, f"{folder}: holds no imgs/NAME.png with masks/NAME.png")


def score_paint(name: str, image: NDArray[np.uint8], found: Bools, mask: NDArray[np.uint8]) -> PaintScore:
    """Paint `found` (H, W) against a mask (H, W, 3); what lies on the own car does not count."""
    counted = (mask != OWN_CAR).any(axis=2)
    true, found = (mask == MARKING).all(axis=2) & counted, found & counted
    return PaintScore(
        image=name,
        night=float(image.mean()) < NIGHT_GREY,
        precision=_share_near(found, true),
        recall=_share_near(true, found),
        found_px=int(found.sum()),
        true_px=int(true.sum()),
    )


def report_of(network: str, scores: list[PaintScore]) -> PaintReport:
    """The means of a folder's images."""
    return PaintReport(
        network=network,
        images=len(scores),
        precision=mean([s.precision for s in scores if s.true_px]),
        recall=mean([s.recall for s in scores]),
        recall_by_night=mean([s.recall for s in scores if s.night]),
        by_image=tuple(scores),
    )


def _share_near(some: Bools, others: Bools) -> float | None:
    """The share of `some` that lies within REACH_PX of `others`; None where there are none."""
    if not some.any():
        return None
    if not others.any():
        return 0.0
    distance_px = cv2.distanceTransform((~others).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(np.mean(np.asarray(distance_px)[some] <= REACH_PX))
