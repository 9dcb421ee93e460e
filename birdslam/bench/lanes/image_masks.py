"""Folders of single images, each with a mask."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from birdslam.geometry.arrays import Image
from birdslam.sources.recording import DatasetError


@dataclass(frozen=True)
class Pair:
    """An image and its mask."""

    number: int
    image: Path
    mask: Path


def numbered_pairs(folder: Path, suffix: str, mask: str) -> list[Pair]:
    """Pairs of image_N.`suffix` and `mask`_N.png, by N. Raises DatasetError if there are none, or a mask is missing."""
    pairs = [
        Pair(int(match[1]), image, folder / f"{mask}_{match[1]}.png")
        for image in folder.glob(f"image_*.{suffix}")
        if (match := re.fullmatch(r"image_(\d+)", image.stem))
    ]
    missing = f"{folder}: holds no pairs image_N.{suffix}, {mask}_N.png"
    return checked(sorted(pairs, key=lambda pair: pair.number), missing)


def checked(pairs: list[Pair], missing: str) -> list[Pair]:
    """The pairs. Raises DatasetError with the message `missing` if there are none, or if an image has no mask."""
    if not pairs:
        raise DatasetError(missing)
    for pair in pairs:
        if not pair.mask.is_file():
            raise DatasetError(f"{pair.image}: has no mask {pair.mask}")
    return pairs


def read_pair(pair: Pair) -> tuple[Image, Image]:
    """(H, W, 3) BGR image and mask. Raises DatasetError."""
    image, mask = (cv2.imread(str(path), cv2.IMREAD_COLOR) for path in (pair.image, pair.mask))
    if image is None or mask is None:
        raise DatasetError(f"{pair.mask if mask is None else pair.image}: can't be read as an image")
    if image.shape != mask.shape:
        raise DatasetError(f"{pair.mask}: is of another size than {pair.image.name}")
    return np.asarray(image, np.uint8), np.asarray(mask, np.uint8)
