"""Place recognition: each corner of a frame votes for the keyframe with the nearest descriptor.

Nearest neighbours come from an inverted file (Sivic and Zisserman 2003) of faiss: descriptors are in the lists of their
nearest words; those of a few lists are compared by Hamming distance (Jegou et al. 2008). The words are learned from the
map's descriptors by k-majority and stored in its file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats32
from birdslam.loops.features import DESCRIPTOR_BYTES
from birdslam.loops.verification import MATCH_BITS

# Number of words as a multiple of the square root of the number of descriptors; faiss recommends 4 to 16
WORDS_PER_ROOT, MIN_WORDS, MAX_WORDS = 4.0, 16, 2048
MAX_TRAINING = 20_000  # descriptors
ROUNDS = 5
BATCH = 1024  # descriptors, to limit memory
PROBES = 8  # searched lists
_SEED = 39


def words_for(descriptors: int) -> int:
    """Returns the number of words for a number of descriptors."""
    return int(np.clip(WORDS_PER_ROOT * descriptors**0.5, min(MIN_WORDS, descriptors), MAX_WORDS))


def learn_words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Learns words (K, 32) of descriptors (N, 32) by k-majority; deterministic."""
    random = np.random.default_rng(_SEED)
    count = words_for(len(descriptors))
    if len(descriptors) > MAX_TRAINING:
        descriptors = descriptors[np.sort(random.choice(len(descriptors), MAX_TRAINING, replace=False))]
    if not count:
        return np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
    words = _signs(descriptors[random.choice(len(descriptors), count, replace=False)])
    for _ in range(ROUNDS):
        sums, present = np.zeros_like(words), np.zeros(count, bool)
        for begin in range(0, len(descriptors), BATCH):
            signs = _signs(descriptors[begin : begin + BATCH])
            nearest = (signs @ words.T).argmax(axis=1)
            order = np.argsort(nearest, kind="stable")
            numbers, first = np.unique(nearest[order], return_index=True)
            sums[numbers] += np.add.reduceat(signs[order], first, axis=0)
            present[numbers] = True
        words[present] = np.where(sums[present] >= 0.0, 1.0, -1.0)
    return np.packbits(words > 0.0, axis=1)


def _signs(descriptors: NDArray[np.uint8]) -> Floats32:
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2.0 - 1.0


class PlaceIndex:
    """An index of keyframes by their descriptors."""

    def __init__(self, words: NDArray[np.uint8]) -> None:
        self.words = words
        self._lists: Any = None  # faiss's quantizer, referenced here since the inverted file does not own it
        self._file: Any = None
        self._filed = 0  # keyframes in it
        self._waiting: list[NDArray[np.uint8]] = []  # later keyframes

    def __len__(self) -> int:
        return self._filed + len(self._waiting)

    def add(self, descriptors: NDArray[np.uint8]) -> None:
        """Adds the next keyframe."""
        self._waiting.append(descriptors)

    def look_up(self, descriptors: NDArray[np.uint8], most: int, among: Bools | None = None) -> list[int]:
        """Returns the rows of the `most` keyframes most similar to the descriptors, best first.

        `among` (N,): allowed keyframes. The latest ones of a drive are indexed only when allowed; otherwise all corners
        would vote for the previous keyframe.
        """
        if not len(descriptors) or not len(self.words):
            return []
        excluded = np.zeros(0, np.int64) if among is None else np.flatnonzero(~among)
        self._put_in_file(len(self) if not len(excluded) else int(excluded[0]))
        if not self._filed:
            return []
        bits, rows = self._file.search(np.ascontiguousarray(descriptors), 1)
        votes = np.bincount(rows[(bits <= MATCH_BITS) & (rows >= 0)], minlength=self._filed)
        votes[excluded[excluded < self._filed]] = 0
        order = np.argsort(-votes, kind="stable")[:most]
        return [int(row) for row in order if votes[row]]

    def _put_in_file(self, until: int) -> None:
        """Indexes the waiting keyframes before `until`."""
        new = self._waiting[: max(until - self._filed, 0)]
        if not new:
            return
        if self._file is None:
            self._lists, self._file = _empty_file(self.words)
        rows = np.repeat(np.arange(self._filed, self._filed + len(new)), [len(each) for each in new])
        self._file.add_with_ids(np.concatenate(new), rows)
        self._filed += len(new)
        del self._waiting[: len(new)]


def _empty_file(words: NDArray[np.uint8]) -> tuple[Any, Any]:
    import faiss

    faiss.omp_set_num_threads(1)  # leave the other cores to the pipeline
    bits = 8 * DESCRIPTOR_BYTES
    lists = faiss.IndexBinaryFlat(bits)
    lists.add(np.ascontiguousarray(words))
    file = faiss.IndexBinaryIVF(lists, bits, len(words))
    file.train(np.ascontiguousarray(words))  # already trained by the words
    file.nprobe = PROBES
    return lists, file


def index_of(descriptors: Sequence[NDArray[np.uint8]], words: NDArray[np.uint8]) -> PlaceIndex:
    """Returns an index of keyframes."""
    index = PlaceIndex(words)
    for each in descriptors:
        index.add(each)
    return index
