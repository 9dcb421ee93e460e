"""Life of the tracks of one kind of road users: birth, confirmation with an id, coasting, deletion.

A track without an id lives for a short time, one with an id survives an occlusion. What differs between kinds is data:
how long a track lives without boxes, and how many tracks there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from birdslam.geometry.arrays import Bools, Floats
from birdslam.road_users.track import EgoFrame, Track, TrackingConfig

IMPOSSIBLE_COST = 1e9


class RowFilter(Protocol):
    """States of all tracks; row k is that of the k-th track, from birth to deletion."""

    def keep_rows(self, rows: Sequence[int]) -> None: ...


AnyTrack = TypeVar("AnyTrack", bound=Track)


class LifeCycle(Generic[AnyTrack]):
    """Calls per frame: count_missed(), observe() per matched track, add(), delete_lost(), confirm().

    Rows are removed from `tracks` and from all filters at once; the caller adds those of new tracks.
    """

    def __init__(self, config: TrackingConfig, forget_s: float, filters: Sequence[RowFilter], first_id: int) -> None:
        """`forget_s` is the time without a box of a track with an id."""
        from scipy.optimize import linear_sum_assignment  # lazy: 9 MB that only the tracking process needs

        self._assign = linear_sum_assignment
        self.tracks: list[AnyTrack] = []
        self.next_id = first_id
        self._filters = tuple(filters)
        self._config, self._forget_s = config, forget_s

    def count_missed(self) -> None:
        """Counts a frame with detections for all tracks; observe() resets the count."""
        for track in self.tracks:
            track.missed += 1

    def associate(self, cost: Floats, possible: Bools, birth_cost: float) -> list[tuple[int, int]]:
        """Pairs (row of a track, box) of least total cost (N, M); a box without a track costs `birth_cost`."""
        known, boxes = cost.shape
        births = np.where(np.eye(boxes, dtype=np.bool_), birth_cost, IMPOSSIBLE_COST)
        rows, columns = self._assign(np.vstack([np.where(possible, cost, IMPOSSIBLE_COST), births]))
        return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if i < known and possible[i, j]]

    def births(self, scores: Sequence[float], matched: Iterable[int]) -> list[int]:
        """The boxes that start a track: unmatched ones with a sufficient score."""
        taken = set(matched)
        return [k for k, score in enumerate(scores) if k not in taken and score >= self._config.birth_score]

    def observe(self, track: AnyTrack, frame: EgoFrame, label: str) -> None:
        """Counts a box with this label."""
        track.frame, track.missed = frame, 0
        track.hits += 1
        track.votes[label] += 1

    def is_confirmed(self, track: AnyTrack) -> bool:
        """Whether a track has enough boxes for an id."""
        return track.hits >= self._config.confirm_hits

    def delete_lost(self, t_source_ns: int, is_gone: Callable[[int], bool] = lambda _: False) -> None:
        """Deletes tracks without recent boxes, and the rows that `is_gone`."""
        kept = [k for k, t in enumerate(self.tracks) if not self._is_lost(t, t_source_ns) and not is_gone(k)]
        if len(kept) < len(self.tracks):
            self.tracks = [self.tracks[row] for row in kept]
            for states in self._filters:
                states.keep_rows(kept)

    def _is_lost(self, track: AnyTrack, t_source_ns: int) -> bool:
        lasting = self.is_confirmed(track) or not track.missed
        patience_s = self._forget_s if lasting else self._config.forget_unconfirmed_s
        return (t_source_ns - track.frame.t_source_ns) * 1e-9 > patience_s

    def confirm(self, frame: EgoFrame, id_of: Callable[[AnyTrack], int | None] = lambda _: None) -> list[AnyTrack]:
        """The confirmed tracks with a box in this frame by id; new ones get an id, by `id_of` or the next."""
        seen = [track for track in self.tracks if track.frame.frame_id == frame.frame_id and self.is_confirmed(track)]
        for track in seen:
            if track.number < 0 and (own := id_of(track)) is not None:
                track.number = own
            elif track.number < 0:
                track.number, self.next_id = self.next_id, self.next_id + 1
        return sorted(seen, key=lambda track: track.number)
