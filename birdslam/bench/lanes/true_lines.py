"""Lines and lanes of a rendered drive against its true lines, and in which lane its vehicles are."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np

from birdslam.bench.figures import median
from birdslam.sources.shipped_drive import TrueLine
from birdslam.types import Bound, Lane, LaneLine, Lanes, LineKind

RANGES_M = (5.0, 10.0, 20.0, 30.0)
MATCH_AT_M, MATCH_M = 10.0, 1.0  # a found line is the true one that is nearest here, within so much
SIDE_M = 6.0  # true lines of the ego's lane and its neighbours: these are to be found
RIGHT_M = 0.5  # of a lane's bounds, for it to be the ego's
KERB = "kerb"


class RangeScore(msgspec.Struct, frozen=True, kw_only=True):
    """Lateral errors of painted lines at one distance."""

    ahead_m: float
    lines: int
    error_median_m: float | None = None
    error_p95_m: float | None = None
    within_2_sigma: float | None = None


class LinesReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive."""

    drive: str
    frames: int
    ranges: tuple[RangeScore, ...]
    recall: float | None  # share of the painted lines within 6 m that were found, over all frames
    ego_lane_wrong: float  # share of frames whose ego lane has a bound off by more than RIGHT_M at 10 m
    width_error_rel: float | None  # median, signed; of lanes between two painted lines


@dataclass
class LineScores:
    """Collects frame by frame."""

    errors: dict[float, list[tuple[float, float]]] = field(default_factory=lambda: {x: [] for x in RANGES_M})
    seen: int = 0
    found: int = 0
    frames: int = 0
    wrong: int = 0
    widths: list[float] = field(default_factory=list)

    def add(self, lanes: Lanes | None, truth: tuple[TrueLine, ...]) -> None:
        """Adds a frame."""
        self.frames += 1
        lines = () if lanes is None else lanes.lines
        matched = match(lines, truth)
        for line in lines:
            true = matched.get(line.line)
            if true is None or line.kind is LineKind.EDGE:
                continue
            for x in RANGES_M:
                y = y_at(true, x)
                if y is not None and x <= line.to_m:
                    self.errors[x].append((line.y_m(x) - y, line.sigma_m(x)))
        wanted = [t for t in truth if t.kind != KERB and _is_near(t)]
        self.seen += len(wanted)
        self.found += sum(any(true is t for true in matched.values()) for t in wanted)
        if lanes is not None and lanes.ego is not None:
            self._add_lane(lanes.ego, truth)

    def _add_lane(self, own: Lane, truth: tuple[TrueLine, ...]) -> None:
        bounds = ego_bounds(truth, MATCH_AT_M)
        if bounds is None:
            return
        left, right = bounds
        if max(abs(own.left_m(MATCH_AT_M) - left), abs(own.right_m(MATCH_AT_M) - right)) > RIGHT_M:
            self.wrong += 1
        elif own.left_bound is Bound.PAINT and own.right_bound is Bound.PAINT:
            width = own.left_m(MATCH_AT_M) - own.right_m(MATCH_AT_M)
            self.widths.append(width / (left - right) - 1.0)

    def report(self, drive: str) -> LinesReport:
        """Returns the scores of all frames."""
        return LinesReport(
            drive=drive,
            frames=self.frames,
            ranges=tuple(_range_score(x, self.errors[x]) for x in RANGES_M),
            recall=self.found / self.seen if self.seen else None,
            ego_lane_wrong=self.wrong / max(self.frames, 1),
            width_error_rel=median(self.widths),
        )


def y_at(line: TrueLine, x_m: float) -> float | None:
    """Where a true line is `x_m` ahead; None beyond its ends."""
    x, y = line.points_m.T
    if len(x) < 2 or not x.min() <= x_m <= x.max():
        return None
    order = np.argsort(x)
    return float(np.interp(x_m, x[order], y[order]))


def match(lines: tuple[LaneLine, ...], truth: tuple[TrueLine, ...]) -> dict[int, TrueLine]:
    """Found line's number -> its true line; each true line once, the nearest first."""
    pairs = []
    for line in lines:
        for k, true in enumerate(truth):
            y = y_at(true, MATCH_AT_M)
            if y is not None and abs(line.y_m(MATCH_AT_M) - y) < MATCH_M:
                pairs.append((abs(line.y_m(MATCH_AT_M) - y), line.line, k))
    out: dict[int, TrueLine] = {}
    taken: set[int] = set()
    for _, number, k in sorted(pairs):
        if number not in out and k not in taken:
            out[number] = truth[k]
            taken.add(k)
    return out


def ego_bounds(truth: tuple[TrueLine, ...], x_m: float) -> tuple[float, float] | None:
    """y of the true lines at the ego's left and right, `x_m` ahead; None where one is missing."""
    here = [(y_at(t, 3.0), y_at(t, x_m)) for t in truth]
    left = [far for near, far in here if near is not None and far is not None and near > 0.0]
    right = [far for near, far in here if near is not None and far is not None and near <= 0.0]
    if not left or not right:
        return None
    return min(left), max(right)


def _is_near(line: TrueLine) -> bool:
    y = y_at(line, MATCH_AT_M)
    return y is not None and abs(y) < SIDE_M


def _range_score(x_m: float, errors: list[tuple[float, float]]) -> RangeScore:
    if not errors:
        return RangeScore(ahead_m=x_m, lines=0)
    e, sigma = np.array(errors).T
    return RangeScore(
        ahead_m=x_m,
        lines=len(e),
        error_median_m=float(np.median(np.abs(e))),
        error_p95_m=float(np.quantile(np.abs(e), 0.95)),
        within_2_sigma=float(np.mean(np.abs(e) < 2.0 * sigma)),
    )
