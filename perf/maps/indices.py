"""Candidates for a place by other indices than the map's own: recall among the first six, milliseconds.

Ours is a bag of binary words. Faiss looks each descriptor's nearest neighbour up, exactly or by one of its own indices,
and a keyframe gets a vote for each that is near enough. Without faiss (`pip install faiss-cpu`) ours stands alone.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.loops.localiser import CANDIDATES
from birdslam.loops.place_index import PlaceIndex
from birdslam.loops.place_map import PlaceMap
from birdslam.loops.verification import MATCH_BITS
from birdslam.perf.reporting.figures import Ledger

Bytes = NDArray[np.uint8]
LookUp = Callable[[Bytes], Sequence[int]]
LISTS_PER_ROOT, PROBES = 4, 8  # of the inverted file: faiss advises 4 to 16 roots of the number


def _indices(ours: PlaceIndex, descriptors: Sequence[Bytes]) -> Iterator[tuple[str, LookUp]]:
    """Name and look-up of each."""
    yield "words", lambda seen: ours.look_up(seen, CANDIDATES)
    if importlib.util.find_spec("faiss") is None:
        return
    import faiss

    faiss.omp_set_num_threads(1)
    every = np.ascontiguousarray(np.concatenate(descriptors))
    owner = np.repeat(np.arange(len(descriptors)), [len(each) for each in descriptors])
    bits = 8 * every.shape[1]
    for name in ("faiss, exact", "faiss, inverted file"):
        if name == "faiss, exact":
            index = faiss.IndexBinaryFlat(bits)
        else:
            lists = max(1, round(LISTS_PER_ROOT * len(every) ** 0.5))
            index = faiss.IndexBinaryIVF(faiss.IndexBinaryFlat(bits), bits, lists)
            index.train(every[:: max(1, len(every) // (40 * lists))])
            index.nprobe = PROBES
        index.add(every)
        yield name, _voting(index.search, owner, len(descriptors))


def _voting(search: Callable[[Bytes, int], tuple[Bytes, Bytes]], owner: NDArray[np.int64], count: int) -> LookUp:
    def look_up(seen: Bytes) -> Sequence[int]:
        bits, rows = search(np.ascontiguousarray(seen), 1)
        votes = np.bincount(owner[rows[bits <= MATCH_BITS]], minlength=count)
        best = np.argsort(-votes, kind="stable")[:CANDIDATES]
        return [int(row) for row in best if votes[row]]

    return look_up


def compare(
    ledger: Ledger, name: str, place_map: PlaceMap, seen: Sequence[Bytes], right: Sequence[Collection[int]]
) -> None:
    """A row for each index. `seen`: descriptors of frames, `right`: the rows of the keyframes where each was taken."""
    for index, look_up in _indices(place_map.index(), [each.descriptors for each in place_map.keyframes]):
        look_up(seen[0])  # it may be made when it is first asked
        found, took_ms = 0, []
        for descriptors, rows in zip(seen, right, strict=True):
            begun_s = time.process_time()
            candidates = look_up(descriptors)
            took_ms.append(1e3 * (time.process_time() - begun_s))
            found += not set(rows).isdisjoint(candidates)
        p50_ms = float(np.median(took_ms))
        text = f"right place among six {found} of {len(seen)}; look-up {p50_ms:.1f} ms, worst {max(took_ms):.1f}"
        ledger.add(f"{name}, by {index}", text, text=text, found=found, frames=len(seen), look_up_ms=p50_ms)
