"""Which keyframes look like a frame: a bag of binary words (Galvez-Lopez and Tardos 2012) with an inverted index.

The words are learned from the map's own descriptors by k-majority and kept in its file, so that nothing has to ship,
and a map of one town has the words of that town. A look-up is one product of a sparse matrix and a vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.loops.features import DESCRIPTOR_BYTES, hamming

MOST_WORDS, LEAST_WORDS = 1024, 16
DESCRIPTORS_PER_WORD = 8
LEARNED_FROM = 20_000  # descriptors at the most
ROUNDS = 5
AT_A_TIME = 1024  # descriptors, so that a map process does not grow by it
STALE_REL = 1 / 32  # of the keyframes may be missing in the matrix: a drive's own last ones are none of its loops
_SEED = 39


def learn_words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(K, 32) words of descriptors (N, 32), by k-majority from a seeded start: the same each time."""
    random = np.random.default_rng(_SEED)
    if len(descriptors) > LEARNED_FROM:
        descriptors = descriptors[np.sort(random.choice(len(descriptors), LEARNED_FROM, replace=False))]
    count = int(np.clip(len(descriptors) // DESCRIPTORS_PER_WORD, min(LEAST_WORDS, len(descriptors)), MOST_WORDS))
    if not count:
        return np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
    words = _signs(descriptors[random.choice(len(descriptors), count, replace=False)])
    for _ in range(ROUNDS):
        sums, present = np.zeros_like(words), np.zeros(count, bool)
        for begin in range(0, len(descriptors), AT_A_TIME):
            signs = _signs(descriptors[begin : begin + AT_A_TIME])
            nearest = (signs @ words.T).argmax(axis=1)
            order = np.argsort(nearest, kind="stable")
            numbers, first = np.unique(nearest[order], return_index=True)
            sums[numbers] += np.add.reduceat(signs[order], first, axis=0)
            present[numbers] = True
        words[present] = np.where(sums[present] >= 0.0, 1.0, -1.0)
    return np.packbits(words > 0.0, axis=1)


def _signs(descriptors: NDArray[np.uint8]) -> Floats32:
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2.0 - 1.0


def words_of(descriptors: NDArray[np.uint8], words: NDArray[np.uint8]) -> Ints:
    """(N,) the nearest word of each descriptor."""
    if not len(words) or not len(descriptors):
        return np.zeros(0, np.int64)
    if len(descriptors) < 64:
        out: Ints = hamming(descriptors, words).argmin(axis=1)
        return out
    signs = _signs(words).T
    begins = range(0, len(descriptors), AT_A_TIME)
    parts = [(_signs(descriptors[i : i + AT_A_TIME]) @ signs).argmax(axis=1) for i in begins]
    return np.concatenate(parts).astype(np.int64)


class PlaceIndex:
    """Of keyframes, each given by its descriptors; grows by `add`."""

    def __init__(self, words: NDArray[np.uint8]) -> None:
        self.words = words
        self._counts: list[tuple[Ints, Floats]] = []
        self._matrix: Any = None
        self._built = 0  # keyframes in the matrix
        self._idf: Floats = np.zeros(len(words))

    def __len__(self) -> int:
        return len(self._counts)

    def add(self, descriptors: NDArray[np.uint8]) -> None:
        """The next keyframe."""
        present, count = np.unique(words_of(descriptors, self.words), return_counts=True)
        self._counts.append((present, np.sqrt(count)))

    def look_up(self, descriptors: NDArray[np.uint8], most: int, among: Bools | None = None) -> list[int]:
        """The numbers of the `most` keyframes most like these descriptors, the best first; `among` (N,): only those."""
        if not self._counts or not len(descriptors) or not len(self.words):
            return []
        if len(self._counts) - self._built > STALE_REL * self._built:
            self._build()
        present, count = np.unique(words_of(descriptors, self.words), return_counts=True)
        query = np.zeros(len(self.words), np.float32)
        query[present] = np.sqrt(count) * self._idf[present]
        scores = self._matrix @ query
        if among is not None:
            scores = np.where(among[: len(scores)], scores, -1.0)
        most = min(most, len(scores))
        best = np.argpartition(-scores, most - 1)[:most]
        order = best[np.lexsort((best, -scores[best]))]
        return [int(number) for number in order if scores[number] > 0.0]

    def _build(self) -> None:
        from scipy.sparse import csr_matrix  # here: only who looks places up needs it

        used = np.bincount(np.concatenate([present for present, _ in self._counts]), minlength=len(self.words))
        self._idf = np.log((1.0 + len(self._counts)) / (1.0 + used)) + 0.1
        rows = [weight * self._idf[present] for present, weight in self._counts]
        rows = [row / max(float(np.linalg.norm(row)), 1e-9) for row in rows]
        begin = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
        columns = np.concatenate([present for present, _ in self._counts])
        data = np.concatenate(rows).astype(np.float32)
        self._built = len(rows)
        self._matrix = csr_matrix((data, columns, begin), shape=(len(rows), len(self.words)))


def index_of(descriptors: Sequence[NDArray[np.uint8]], words: NDArray[np.uint8]) -> PlaceIndex:
    """An index of keyframes."""
    index = PlaceIndex(words)
    for each in descriptors:
        index.add(each)
    return index
