"""Local features of an image: corners with binary descriptors of 256 bits, compared by the Hamming distance.

Upright SIFT (Lowe 2004), since a car's camera does not roll. The signs of random differences of the
square-rooted entries (RootSIFT, Arandjelovic and Zisserman 2012) reduce a descriptor to 32 bytes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32, Ints

DESCRIPTOR_BYTES = 32
MAX_FEATURES = 900  # per image
SUMMED = 8  # entries of SIFT that each bit adds, and as many that it subtracts
_SEED = 39  # of the random differences; part of the map format


@dataclass(frozen=True)
class Features:
    """Corners of one undistorted image, in its pixels."""

    px: Floats  # (N, 2)
    sigma_px: Floats  # (N,) 1-sigma of a coordinate, larger at coarse scales
    descriptors: NDArray[np.uint8]  # (N, 32)

    def __len__(self) -> int:
        return len(self.px)


WORKING_WIDTH_PX = 700  # wider images are halved
FINEST_PX = 2.0  # size of the finest corners


def _differences() -> Floats32:
    """Returns (128, 256): each column adds SUMMED entries of a SIFT descriptor and subtracts as many others."""
    random = np.random.default_rng(_SEED)
    out = np.zeros((128, 8 * DESCRIPTOR_BYTES), np.float32)
    for column in out.T:
        entries = random.permutation(128)[: 2 * SUMMED]
        column[entries[:SUMMED]], column[entries[SUMMED:]] = 1.0, -1.0
    return out


class FeatureExtractor:
    """Extracts the features of images; deterministic."""

    def __init__(self) -> None:
        self._differences = _differences()
        self._detector = cv2.SIFT_create(  # type: ignore[attr-defined]
            MAX_FEATURES, contrastThreshold=0.02, edgeThreshold=12
        )

    def __call__(self, image: NDArray[np.uint8]) -> Features:
        """Returns the features of an image, (H, W) grey or (H, W, 3) BGR."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        scale = 1.0
        while grey.shape[1] > WORKING_WIDTH_PX:
            height_px, width_px = grey.shape
            grey, scale = cv2.resize(grey, (width_px // 2, height_px // 2), interpolation=cv2.INTER_AREA), scale * 2.0
        corners = self._detector.detect(grey, None)
        for corner in corners:
            corner.angle = 0.0
        corners = _without_duplicates(corners)
        corners, descriptors = self._detector.compute(grey, corners)
        if descriptors is None or not len(corners):
            return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, DESCRIPTOR_BYTES), np.uint8))
        descriptors = self._bits(descriptors)
        px = (np.array([corner.pt for corner in corners]) + 0.5) * scale - 0.5
        size = np.array([corner.size for corner in corners])
        sigma_px = scale * np.clip(0.5 * np.sqrt(size / FINEST_PX), 0.5, 4.0)
        return Features(px, sigma_px, descriptors)

    def _bits(self, descriptors: Floats32) -> NDArray[np.uint8]:
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        return np.packbits(root @ self._differences > 0.0, axis=1)


def _without_duplicates(corners: tuple[cv2.KeyPoint, ...]) -> list[cv2.KeyPoint]:
    """Removes duplicates: SIFT returns a corner once per orientation."""
    seen = {(corner.pt, corner.octave & 255): corner for corner in corners}
    return list(seen.values())


def match(a: NDArray[np.uint8], b: NDArray[np.uint8], most_bits: int, ratio: float) -> Ints:
    """Returns (K, 2) rows of mutually nearest descriptors (N, 32) and (M, 32) that pass Lowe's ratio test."""
    import faiss

    if len(a) < 1 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    faiss.omp_set_num_threads(1)  # the other cores are the frames'
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    bits, nearest = faiss.knn_hamming(a, b, 2)
    _, back = faiss.knn_hamming(b, a, 1)
    good = (bits[:, 0] <= most_bits) & (bits[:, 0] < ratio * bits[:, 1])
    good &= back[nearest[:, 0], 0] == np.arange(len(a))
    return np.column_stack([np.flatnonzero(good), nearest[good, 0]])


def match_near(
    a: NDArray[np.uint8],
    a_px: Floats,
    b: NDArray[np.uint8],
    b_px: Floats,
    radius_px: float,
    most_bits: int,
    ratio: float,
) -> Ints:
    """Like `match`, but only among descriptors whose pixels are within a radius."""
    from scipy.spatial import cKDTree

    if not len(a) or not len(b):
        return np.zeros((0, 2), np.int64)
    near = cKDTree(b_px).query_ball_point(a_px, radius_px)
    rows = np.repeat(np.arange(len(a)), [len(each) for each in near])
    columns = np.array([column for each in near for column in each], np.int64)
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    words = np.ascontiguousarray(a).view(np.uint64)[rows] ^ np.ascontiguousarray(b).view(np.uint64)[columns]
    distance = np.bitwise_count(words).sum(axis=1).astype(np.int64)
    order = np.lexsort((columns, distance, rows))
    rows, columns, distance = rows[order], columns[order], distance[order]
    first = np.flatnonzero(np.diff(rows, prepend=-1))
    second = np.append(distance, NEVER)[first + 1]
    second[np.append(rows, -1)[first + 1] != rows[first]] = NEVER
    back = np.lexsort((rows, distance, columns))
    nearest_row = np.full(len(b), -1)
    ends = np.flatnonzero(np.diff(columns[back], prepend=-1))
    nearest_row[columns[back][ends]] = rows[back][ends]
    good = (distance[first] <= most_bits) & (distance[first] < ratio * second)
    good &= nearest_row[columns[first]] == rows[first]
    return np.column_stack([rows[first], columns[first]])[good]


NEVER = 10_000  # bits, above any distance
