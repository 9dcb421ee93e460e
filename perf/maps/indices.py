"""Candidates for a place by the map's own index and by all descriptors: recall among the first six, milliseconds.

Either looks each descriptor's nearest neighbour up, and a keyframe gets a vote for each that is near enough: ours in an
inverted file of faiss, the other one among all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence

import faiss
import numpy as np
from numpy.typing import NDArray

from birdslam.loops.localiser import CANDIDATES
from birdslam.loops.place_index import PlaceIndex
from birdslam.loops.place_map import PlaceMap
from birdslam.loops.verification import MATCH_BITS
from birdslam.perf.reporting.figures import Ledger

Bytes = NDArray[np.uint8]
LookUp = Callable[[Bytes], Sequence[int]]


def _indices(ours: PlaceIndex, descriptors: Sequence[Bytes]) -> Iterator[tuple[str, LookUp]]:
    """Name and look-up of each."""
    yield "the inverted file", lambda seen: ours.look_up(seen, CANDIDATES)
    every = np.ascontiguousarray(np.concatenate(descriptors))
    owner = np.repeat(np.arange(len(descriptors)), [len(each) for each in descriptors])
    index = faiss.IndexBinaryFlat(8 * every.shape[1])
    index.add(every)

    def look_up(seen: Bytes) -> Sequence[int]:
        bits, rows = index.search(np.ascontiguousarray(seen), 1)
        votes = np.bincount(owner[rows[bits <= MATCH_BITS]], minlength=len(descriptors))
        best = np.argsort(-votes, kind="stable")[:CANDIDATES]
        return [int(row) for row in best if votes[row]]

    yield "all descriptors", look_up


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
