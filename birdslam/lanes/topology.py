"""Lanes from lines: selects the lines that bound lanes, finds the ego's lane, and completes a lane with one line.

Arrows, kerbs and tar look like lines too. Dynamic programming from left to right selects the bounds with the most
plausible row of lanes: a bound gains its probability of existence, a strip between two bounds costs by its width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.lanes.curves import basis
from birdslam.types import Bound, Lane, LaneLine, LineKind

AT_M = 8.0  # distance at which lanes are compared: in view of most cameras and precise
MIN_LANE_M, MAX_LANE_M = 2.3, 4.2
MIN_STRIP_M = 0.8  # a hard shoulder or a cycle lane; a painted line closer to an edge replaces it
NO_LANE_COST = 0.6  # of a strip that is not a lane
WIDE_COST = 0.4  # of a strip wider than MAX_STRIP_M
MIN_KERB_M, MAX_KERB_M = 0.1, 0.6  # distance of a kerbstone past the edge, since a mask's border is imprecise
WIDTH_M, WIDTH_SIGMA_M = 3.3, 0.5  # prior of lane widths: 2.75 to 3.75 m by road standards, and wider ones
MAX_STRIP_M = 1.5 * WIDTH_M  # of one lane: a wider strip is nearer to two
MIN_END_WIDTH_M = 1.9  # a lane ends where it is narrower
STEP_M, MIN_END_SIGMAS = 2.0, 2.0  # step and confidence of the search for a lane's end


@dataclass(frozen=True)
class LaneRow:
    """Lanes from left to right and the index of the ego's lane, None if unknown."""

    lanes: tuple[Lane, ...]
    ego: int | None


def lane_row(
    lines: tuple[LaneLine, ...], mean_width_m: float = WIDTH_M, mean_width_sigma_m: float = WIDTH_SIGMA_M
) -> LaneRow:
    """The lanes between the lines; `mean_width_m` is the mean width of the ego's lane so far."""
    bounds = _select_bounds(lines)
    lanes = [_lane_between(left, right) for left, right in pairwise(bounds) if _is_lane(left, right)]
    ego = next((k for k, lane in enumerate(lanes) if _holds_ego(lane)), None)
    if ego is None:
        own = _complete_ego_lane(bounds, mean_width_m, mean_width_sigma_m)
        if own is not None:
            lanes.append(own)
            lanes.sort(key=lambda lane: -lane.centre_m(AT_M))
            ego = lanes.index(own)
    return LaneRow(tuple(lanes), ego)


def _holds_ego(lane: Lane) -> bool:
    """Whether the ego's origin is in the lane; at x = 0, since the ego may be oblique to it."""
    return lane.left_m(0.0) > 0.0 >= lane.right_m(0.0)


def _select_bounds(lines: tuple[LaneLine, ...]) -> list[LaneLine]:
    """The lines that bound lanes, from left to right."""
    edges = [line for line in lines if line.kind is LineKind.EDGE]
    paint = [line for line in lines if line.kind is not LineKind.EDGE and not any(_is_kerb(line, e) for e in edges)]
    usable = paint + [
        line
        for line in lines
        if line.kind is LineKind.EDGE and all(abs(line.y_m(AT_M) - p.y_m(AT_M)) > MIN_STRIP_M for p in paint)
    ]
    usable.sort(key=lambda line: -line.y_m(AT_M))
    best: list[tuple[float, list[LaneLine]]] = []
    for k, line in enumerate(usable):
        gain = line.existence
        choice: tuple[float, list[LaneLine]] = (gain, [line])
        for j in range(k):
            score = best[j][0] + gain - _strip_cost(usable[j], line)
            if score > choice[0]:
                choice = score, [*best[j][1], line]
        best.append(choice)
    return max(best, key=lambda item: item[0])[1] if best else []


def _is_kerb(line: LaneLine, edge: LaneLine) -> bool:
    """Whether a bright line is a kerbstone: it lies just past the road's edge, paint lies before it."""
    past_m = (line.y_m(AT_M) - edge.y_m(AT_M)) * math.copysign(1.0, edge.y_m(AT_M))
    return MIN_KERB_M < past_m < MAX_KERB_M


def _strip_cost(left: LaneLine, right: LaneLine) -> float:
    width = left.y_m(AT_M) - right.y_m(AT_M)
    if width < MIN_STRIP_M:
        return 2.0
    if width < MIN_LANE_M:
        return NO_LANE_COST
    return 0.0 if width < MAX_STRIP_M else WIDE_COST


def _is_lane(left: LaneLine, right: LaneLine) -> bool:
    """Whether the strip between two bounds is a lane."""
    width = left.y_m(AT_M) - right.y_m(AT_M)
    if width < MIN_LANE_M or left.offset_m - right.offset_m < MIN_STRIP_M:
        return False
    return width < MAX_STRIP_M or (left.kind is LineKind.EDGE and right.kind is LineKind.EDGE)


def _curve(line: LaneLine | Lane) -> Floats:
    return np.array([line.offset_m, line.slope, line.curvature_per_m, line.curvature_rate_per_m2])


def _bound_of(line: LaneLine) -> Bound:
    return Bound.EDGE if line.kind is LineKind.EDGE else Bound.PAINT


def _lane_between(left: LaneLine, right: LaneLine) -> Lane:
    """The lane between two lines: its centre is their mean; the errors of their shapes are correlated."""
    a, b = _curve(left), _curve(right)
    P, Q = np.array(left.cov).reshape(4, 4), np.array(right.cov).reshape(4, 4)
    shared = _shared_covariance(P, Q)
    cov = 0.25 * (P + Q + shared + shared.T)
    width_cov = P + Q - shared - shared.T
    centre = 0.5 * (a + b)
    edges = left.kind is LineKind.EDGE and right.kind is LineKind.EDGE
    ends_m, splits_m = (None, None) if edges else _find_ends(a - b, width_cov, min(left.seen_to_m, right.seen_to_m))
    return Lane(
        offset_m=float(centre[0]),
        slope=float(centre[1]),
        curvature_per_m=float(centre[2]),
        curvature_rate_per_m2=float(centre[3]),
        cov=tuple(cov.ravel().tolist()),
        width_m=float(a[0] - b[0]),
        width_slope=float(a[1] - b[1]),
        width_sigma_m=math.sqrt(max(0.0, float(width_cov[0, 0]))),
        to_m=min(left.to_m, right.to_m),
        left=left.line,
        right=right.line,
        left_bound=_bound_of(left),
        right_bound=_bound_of(right),
        carriageway=edges and a[0] - b[0] > MAX_LANE_M,
        ends_m=ends_m,
        splits_m=splits_m,
    )


def _find_ends(width: Floats, cov: Floats, seen_to_m: float) -> tuple[float | None, float | None]:
    """Distances at which a lane is too narrow for a car, and as wide as two lanes, within the seen range of its lines.

    `width` (4,) is the difference of its lines' curves, `cov` (4, 4) its covariance.
    """
    x = np.arange(STEP_M, seen_to_m, STEP_M)
    at = basis(x)
    metres = at @ width
    sure = MIN_END_SIGMAS * np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", at, cov, at), 0.0))
    narrow, wide = metres + sure < MIN_END_WIDTH_M, metres - sure > 2.0 * MIN_LANE_M
    ends_m = float(x[np.argmax(narrow)]) if narrow.any() else None
    splits_m = float(x[np.argmax(wide)]) if wide.any() and width[0] < MAX_LANE_M else None
    return ends_m, splits_m


def _shared_covariance(P: Floats, Q: Floats) -> Floats:
    """(4, 4) covariance between two lines of one road: common slope, curvature and rate, independent offsets."""
    shared = np.zeros((4, 4))
    shared[1:, 1:] = np.minimum(P[1:, 1:].diagonal(), Q[1:, 1:].diagonal())[:, None] * np.eye(3)
    return shared


def _complete_ego_lane(bounds: list[LaneLine], mean_width_m: float, mean_width_sigma_m: float) -> Lane | None:
    """The ego's lane if it has a line on one side only."""
    left = [line for line in bounds if line.offset_m > 0.0]
    right = [line for line in bounds if line.offset_m <= 0.0]
    near_left, near_right = (left[-1] if left else None), (right[0] if right else None)
    known = min(
        (line for line in (near_left, near_right) if line is not None),
        key=lambda line: abs(abs(line.offset_m) - 0.5 * mean_width_m),
        default=None,
    )
    if known is None or abs(known.offset_m) > mean_width_m:
        return None
    sign = -1.0 if known is near_left else 1.0
    shape = _curve(known)
    shape[0] += sign * 0.5 * mean_width_m
    cov = np.array(known.cov).reshape(4, 4).copy()
    cov[0, 0] += 0.25 * mean_width_sigma_m**2
    at_left = known is near_left
    return Lane(
        offset_m=float(shape[0]),
        slope=float(shape[1]),
        curvature_per_m=float(shape[2]),
        curvature_rate_per_m2=float(shape[3]),
        cov=tuple(cov.ravel().tolist()),
        width_m=mean_width_m,
        width_slope=0.0,
        width_sigma_m=mean_width_sigma_m,
        to_m=known.to_m,
        left=known.line if at_left else None,
        right=None if at_left else known.line,
        left_bound=_bound_of(known) if at_left else Bound.WIDTH,
        right_bound=Bound.WIDTH if at_left else _bound_of(known),
    )
