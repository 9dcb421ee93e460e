"""Which keyframes look like a frame: each of its corners votes for the keyframe with the descriptor nearest to it.

The nearest is looked for by an inverted file (Sivic and Zisserman 2003) of faiss: descriptors lie in the lists of their
nearest words, and those in a few lists are compared bit by bit (Hamming embedding, Jegou et al. 2008). The words are
learned from the map's own descriptors by k-majority and kept in its file, so that nothing has to ship.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats32
from birdslam.loops.features import DESCRIPTOR_BYTES
from birdslam.loops.verification import MATCH_BITS

# How many words: in a list lie as many descriptors as there are lists, within a factor; faiss advises 4 to 16
WORDS_PER_ROOT, MIN_WORDS, MAX_WORDS = 4.0, 16, 2048
LEARNED_FROM = 20_000  # descriptors at the most
ROUNDS = 5
AT_A_TIME = 1024  # descriptors, so that a map process does not grow by it
PROBES = 8  # lists that are looked into
_SEED = 39


def words_for(descriptors: int) -> int:
    """How many words an index of so many descriptors has."""
    return int(np.clip(WORDS_PER_ROOT * descriptors**0.5, min(MIN_WORDS, descriptors), MAX_WORDS))


def learn_words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(K, 32) words of descriptors (N, 32), by k-majority from a seeded start: the same each time."""
    random = np.random.default_rng(_SEED)
    count = words_for(len(descriptors))
    if len(descriptors) > LEARNED_FROM:
        descriptors = descriptors[np.sort(random.choice(len(descriptors), LEARNED_FROM, replace=False))]
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


class PlaceIndex:
    """Of keyframes, each given by its descriptors; grows by `add`."""

    def __init__(self, words: NDArray[np.uint8]) -> None:
        self.words = words
        self._lists: Any = None  # faiss's, of words: its file of descriptors does not keep them alive itself
        self._file: Any = None
        self._filed = 0  # keyframes in it
        self._waiting: list[NDArray[np.uint8]] = []  # those after them

    def __len__(self) -> int:
        return self._filed + len(self._waiting)

    def add(self, descriptors: NDArray[np.uint8]) -> None:
        """The next keyframe."""
        self._waiting.append(descriptors)

    def look_up(self, descriptors: NDArray[np.uint8], most: int, among: Bools | None = None) -> list[int]:
        """The numbers of the `most` keyframes most like these descriptors, the best first.

        `among` (N,): only those. The last ones, which a drive has just made, are filed once they are among them: else
        each corner would vote for the keyframe before it.
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
        """The keyframes that wait, before this one."""
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
    import faiss  # here: only who looks places up needs it

    faiss.omp_set_num_threads(1)  # the other cores are the frames'
    bits = 8 * DESCRIPTOR_BYTES
    lists = faiss.IndexBinaryFlat(bits)
    lists.add(np.ascontiguousarray(words))
    file = faiss.IndexBinaryIVF(lists, bits, len(words))
    file.train(np.ascontiguousarray(words))  # it is: by its words
    file.nprobe = PROBES
    return lists, file


def index_of(descriptors: Sequence[NDArray[np.uint8]], words: NDArray[np.uint8]) -> PlaceIndex:
    """An index of keyframes."""
    index = PlaceIndex(words)
    for each in descriptors:
        index.add(each)
    return index
