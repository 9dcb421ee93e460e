"""Leave-one-out choice of a constant: chosen without each sequence in turn, and judged on that sequence.

For each sequence the value is taken that is best on all the others, and held to that sequence alone. *Best* is by the
mean over sequences of a score that wants places both near and honest: the negative log likelihood of their errors under
the stated covariances, capped for each one so that a box of something else does not choose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import msgspec
import numpy as np

from birdslam.bench.tracking.localisation import MAX_SQUARED_DISTANCE
from birdslam.geometry.arrays import Floats


class PlaceError(Protocol):
    """The error of a place in one frame, of a car or of a person."""

    @property
    def depth_m(self) -> float: ...
    @property
    def error_m(self) -> Floats: ...
    @property
    def mahalanobis2(self) -> float: ...
    @property
    def log_det_cov(self) -> float: ...


class LeftOut(msgspec.Struct, frozen=True, kw_only=True):
    """One constant and one sequence: the others' choice, and the median depth error by it and by the present value."""

    key: str
    sequence: str
    as_it_is: str
    chosen: str  # by the other sequences
    score_as_it_is: float
    score_chosen: float
    depth_error_as_it_is_rel: float
    depth_error_chosen_rel: float


def score(errors: Sequence[PlaceError]) -> float:
    """Mean negative log likelihood of places (m), less its constant; smaller is better."""
    distances = np.minimum([e.mahalanobis2 for e in errors], MAX_SQUARED_DISTANCE)
    return float(np.mean(0.5 * distances + 0.5 * np.array([e.log_det_cov for e in errors])))


def left_out(key: str, as_it_is: str, found: Mapping[str, Mapping[str, Sequence[PlaceError]]]) -> list[LeftOut]:
    """A row for each sequence from the errors by value and sequence; `as_it_is` is one of the values.

    Sequences without any are left out. Raises ValueError for fewer than two.
    """
    sequences = [name for name in found[as_it_is] if all(of[name] for of in found.values())]
    if len(sequences) < 2:
        raise ValueError(f"{len(sequences)} sequences with some, 2 are needed to leave one out")
    scores = {value: {name: score(of[name]) for name in sequences} for value, of in found.items()}
    rows = []
    for name in sequences:
        others = [other for other in sequences if other != name]
        means = {value: float(np.mean([of[other] for other in others])) for value, of in scores.items()}
        chosen = min(means, key=lambda value: (means[value], value != as_it_is))
        rows.append(
            LeftOut(
                key=key,
                sequence=name,
                as_it_is=as_it_is,
                chosen=chosen,
                score_as_it_is=scores[as_it_is][name],
                score_chosen=scores[chosen][name],
                depth_error_as_it_is_rel=_depth_error(found[as_it_is][name]),
                depth_error_chosen_rel=_depth_error(found[chosen][name]),
            )
        )
    return rows


def _depth_error(errors: Sequence[PlaceError]) -> float:
    return float(np.median([abs(e.error_m[0]) / e.depth_m for e in errors]))
