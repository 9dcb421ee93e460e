"""What CC and CP edges of a log are worth: their errors over a few frames, against the truth and against each other.

Of images and of simulated drives these statistics are to be the same: an ablation on a simulation whose landmarks know
more than real ones tells nothing of the car.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import LandmarkEdge, Measurements

SPAN = 4  # frames: as far as the graph ties a key frame to the one before
LEAST_M = 1.0  # a shorter way's length says nothing of the scale
WILD = 0.5  # a CP edge whose length is farther off, as a logarithm, is no measurement of it
OUTLIER = 3.0  # sigmas: an error past it is of no landmark
NORMAL = 1.4826  # of a normal error: sigma over the median of its size


class EdgeStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Of ways of SPAN frames. Lengths' errors are logarithms; spreads are robust sigmas."""

    spans: int
    points_per_frame: float  # CP edges
    shared: float  # landmarks that both ends of a span see
    cc: float  # spread of the odometry's length over the true one
    cc_later: float  # autocorrelation of that, one span on
    cc_tail: float  # the share past three spreads; of a normal error .0027
    cp: float  # spread of the length by landmarks over the odometry's
    cp_stated: float  # the median of what the edges' covariances say of it
    # What of the odometry's error the landmarks see: 1 if theirs is independent of it, 0 if they have the same; and its
    # 1-sigma, by the spread of both
    seen: float
    seen_sigma: float
    # 1-sigma of what the landmarks of a span share, along the ego's axis and across it: by the products of the errors
    # of any two of them. NaN: they share less than that shows
    common_along_m: float
    common_across_m: float


def edge_statistics(log: Sequence[Measurements], ego: Mapping[int, SE2]) -> EdgeStatistics | None:
    """Of one log, whose true poses `ego` has by frame; None where it has fewer than ten spans with both edges."""
    rows = [row for k in range(len(log) - SPAN) if (row := _span(log[k : k + SPAN + 1], ego)) is not None]
    table = np.array(rows).reshape(-1, 4)
    cc, cp, stated, shared = table.T
    both = np.abs(cp) < WILD  # False where there is no CP
    along_m, across_m = _common(log, ego)
    if both.sum() < 10:
        return None
    e, d = cc[both], cp[both]
    sigma = _spread(cc)
    errors2 = max(float((e * e).sum()), 1e-12)  # exact edges have none
    seen = -float((e * d).sum()) / errors2
    return EdgeStatistics(
        spans=len(cc),
        points_per_frame=sum(len(m.cp) for m in log) / len(log),
        shared=float(shared.mean()),
        cc=sigma,
        cc_later=float((cc[:-SPAN] * cc[SPAN:]).mean() / max(float((cc * cc).mean()), 1e-12))
        if len(cc) > 2 * SPAN
        else math.nan,
        cc_tail=float((np.abs(cc - np.median(cc)) > 3.0 * sigma).mean()),
        cp=_spread(d),
        cp_stated=float(np.median(stated[both])),
        seen=seen,
        # Spans overlap: so many are independent
        seen_sigma=float(np.sqrt((d * d).sum() / errors2 / max(both.sum() / SPAN, 1.0))),
        common_along_m=along_m,
        common_across_m=across_m,
    )


def _common(log: Sequence[Measurements], ego: Mapping[int, SE2]) -> tuple[float, float]:
    spans = []
    for first, last in zip(log, log[SPAN:], strict=False):
        then = {(e.kind, e.landmark): np.array([e.x_m, e.y_m]) for e in first.cp}
        now = {(e.kind, e.landmark): np.array([e.x_m, e.y_m]) for e in last.cp}
        if both := then.keys() & now.keys():
            T = ego[first.frame_id].between(ego[last.frame_id])
            spans.append(np.array([T @ now[key] - then[key] for key in sorted(both)]))  # Eq. 3, the motion known
    if not spans:
        return math.nan, math.nan
    limit = OUTLIER * NORMAL * np.median(np.abs(np.concatenate(spans)), axis=0)
    products, weight = np.zeros(2), 0
    for errors in spans:
        errors = errors[(np.abs(errors) <= limit).all(axis=1)]
        pairs = len(errors) * (len(errors) - 1)
        products += errors.sum(axis=0) ** 2 - (errors**2).sum(axis=0)
        weight += pairs
    along, across = (math.sqrt(p / weight) if weight and p > 0.0 else math.nan for p in products.tolist())
    return along, across


def _spread(x: Floats) -> float:
    return NORMAL * float(np.median(np.abs(x - np.median(x))))


def _span(log: Sequence[Measurements], ego: Mapping[int, SE2]) -> tuple[float, float, float, float] | None:
    """(error of CC, CP over CC, its stated sigma, shared landmarks); None for a gap, or an ego at rest."""
    T_first_last = SE2()
    for before, m in itertools.pairwise(log):
        if m.cc is None or m.cc.from_frame != before.frame_id:
            return None
        T_first_last = T_first_last @ m.cc.T_from_to
    true = ego[log[0].frame_id].between(ego[log[-1].frame_id])
    true_m, cc_m = math.hypot(true.x_m, true.y_m), math.hypot(T_first_last.x_m, T_first_last.y_m)
    if min(true_m, cc_m) < LEAST_M:
        return None
    then, now = ({(e.kind, e.landmark): e for e in m.cp} for m in (log[0], log[-1]))
    pairs = [(then[key], edge) for key, edge in now.items() if key in then]
    cp, stated = _by_landmarks(pairs, T_first_last) if pairs else (math.nan, math.nan)
    return math.log(cc_m / true_m), cp, stated, float(len(pairs))


def _by_landmarks(pairs: Sequence[tuple[LandmarkEdge, LandmarkEdge]], T_first_last: SE2) -> tuple[float, float]:
    """The way's length by landmarks, weighted by information, over the odometry's (a logarithm), and its 1-sigma."""
    R = T_first_last.rotation()
    information, moment = np.zeros((2, 2)), np.zeros(2)
    for then, now in pairs:
        weight = np.linalg.inv(np.reshape(then.cov, (2, 2)) + R @ np.reshape(now.cov, (2, 2)) @ R.T)
        information += weight
        moment += weight @ (np.array([then.x_m, then.y_m]) - R @ np.array([now.x_m, now.y_m]))  # Eq. 3
    length_m = math.hypot(T_first_last.x_m, T_first_last.y_m)
    along = np.array([T_first_last.x_m, T_first_last.y_m]) / length_m
    found_m = float(along @ np.linalg.solve(information, moment))
    sigma_m = math.sqrt(float(along @ np.linalg.solve(information, along)))
    return math.log(max(found_m, 1e-3) / length_m), sigma_m / length_m
