"""The car's bonnet along the lower edge of the image: below its edge there is no road.

It mirrors sky and houses, so that its inside changes from image to image, but its edge does not: the mean gradient of
images between which the car has driven keeps a fixed edge and averages the road out. A bonnet (or a dashboard, or a
black border) begins where such an edge, nearer to level than to vertical, crosses most columns along one curve.

A bonnet stays with the car, but its edge comes and goes with what it mirrors, and is now brighter and now darker than
the road. So it is dropped only where edges of either sign are no more frequent along it than elsewhere.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Grey = NDArray[np.float32]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]

_DOWNSCALE = 2  # the edge is detected in images of half the size
_LOWEST = 0.4  # of the rows that can show road: a bonnet ends in the lower ones
_LINE_SHARE = 0.7  # of the columns with an edge, those with one of the other sign beside it: more is a line
_FIT_ITERATIONS = 2  # of the fit, each with the edges near the last curve
_SAMPLES = 200  # curves that are tried
_EACH = 4  # every fourth column judges them
_ALIKE = 0.85  # of the best curve's share
_MIN_COLUMNS = 8  # for a fit
_MAX_OFFSET = 0.1  # of the image's height: half of what a curve spans, at the most, less a quarter
_MAX_ACROSS = 0.4  # gradient of the slope across over the slope downwards: lane lines have more
_SHARP = 4  # rows: so far from an edge's middle it has less than half of its strength
_MARGIN_PX = 6  # above the edge, for the smoothing of the road's image


class BonnetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When an edge is a bonnet's. By judgement, tried on the built-in world's bonnets; KITTI's cameras see none."""

    step_m: Positive = 0.5  # driven from one image of the mean to the next
    images: Annotated[int, msgspec.Meta(ge=3)] = 6  # of the mean; the edge is detected from half of them on
    edge_grey: Positive = 1.5  # per pixel, of a fixed edge in the mean: at dusk a bonnet's has 2
    changes: Share = 0.4  # of the edge's strength, its mean deviation from image to image
    on_threshold: Share = 0.5  # of the columns with such an edge, for a bonnet to be there
    off_threshold: Share = 0.1  # ... more than elsewhere in the image; with fewer it is gone
    smooth_px: Positive = 8.0  # distance of an edge from its curve


class Bonnet:
    """State: mean and mean deviation of the vertical gradients. Reader: `RoadScale`, for the pixels it aligns."""

    def __init__(self, config: BonnetConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._deviation: Grey | None = None
        self._images = 0
        self._driven_m = np.inf
        self.rows: Ints | None = None  # (W,) the first row that shows bonnet; None: there is none
        self._known: NDArray[np.float64] | None = None  # the same curve, in the rows of the detection

    def update(self, grey: NDArray[np.uint8], top_px: int, driven_m: float) -> bool:
        """Takes (H, W) grey, `driven_m` after the image before, rows from `top_px` on; whether it has come."""
        cfg = self.config
        self._driven_m += driven_m
        if self._driven_m < cfg.step_m:
            return False
        self._driven_m = 0.0
        small = cv2.resize(grey[top_px:], None, fx=1 / _DOWNSCALE, fy=1 / _DOWNSCALE, interpolation=cv2.INTER_AREA)
        slope = np.asarray(cv2.Sobel(small, cv2.CV_32F, 0, 1, ksize=3, scale=0.125), np.float32)
        self._images += 1
        share = max(1.0 / self._images, 1.0 / cfg.images)
        if self._mean is None or self._deviation is None:
            self._mean, self._deviation = slope.copy(), np.zeros_like(slope)
            return False
        cv2.accumulateWeighted(np.abs(slope - self._mean), self._deviation, share)
        cv2.accumulateWeighted(slope, self._mean, share)
        if 2 * self._images < cfg.images:
            return False
        before, self.rows = self.rows, self._edge(top_px, *grey.shape)
        return before is None and self.rows is not None

    @property
    def initialised(self) -> bool:
        """Whether an image was ever taken."""
        return self._images > 0

    @property
    def present(self) -> bool:
        """Whether there is one."""
        return self.rows is not None

    def above(self, px: Ints) -> Ints:
        """The pixels, of (N, 2), that lie above it."""
        return px if self.rows is None else px[px[:, 1] < self.rows[px[:, 0]]]

    def _edge(self, top_px: int, height: int, width: int) -> Ints | None:
        """(W,) rows of the curve that most columns agree on, less a margin; None: no bonnet."""
        cfg = self.config
        most = 1.5 * _MAX_OFFSET * height / _DOWNSCALE  # of a curve's own span
        above = round(_LOWEST * (height - top_px) / _DOWNSCALE)  # rows in which no bonnet ends
        edges = [self._level_edges(sign)[above:] for sign in (1.0, -1.0)]
        smooth = cfg.smooth_px / _DOWNSCALE
        curves = [_curve(each, smooth, most) for each in edges]
        (share, curve), other = max(zip(curves, reversed(edges), strict=True), key=lambda found: found[0][0])
        if share < cfg.on_threshold or curve is None or _share(_thick(other, smooth), curve) > _LINE_SHARE * share:
            # None, or a line, brighter or darker than both its sides: a reflection, or writing
            curve = self._known if self._goes_on(_thick(edges[0] | edges[1], smooth)) else None
        self._known = curve
        if curve is None:
            return None
        fine = np.interp(np.arange(width), _DOWNSCALE * (np.arange(len(curve)) + 0.5), curve)
        return np.clip(top_px + _DOWNSCALE * (above + fine) - _MARGIN_PX, 0, height).astype(np.int64)

    def _goes_on(self, thick: NDArray[np.uint8]) -> bool:
        """Whether more of the columns have an edge along the bonnet's so far than the rest of the image has."""
        if self._known is None:
            return False
        return _share(thick, self._known) - float(thick.mean()) >= self.config.off_threshold

    def _level_edges(self, sign: float) -> Bools:
        """Where there is a fixed edge, brighter below times `sign`."""
        cfg, mean, deviation = self.config, self._mean, self._deviation
        assert mean is not None
        assert deviation is not None
        across = np.abs(cv2.Scharr(mean, cv2.CV_32F, 1, 0, scale=1.0 / 32.0))
        strength = sign * mean
        out: Bools = (
            (strength > cfg.edge_grey) & (deviation < cfg.changes * strength) & (across < _MAX_ACROSS * strength)
        )
        # The rim of the lamps' light by night stands as still, but it is broad
        beside = np.full_like(strength, np.inf)
        beside[_SHARP:-_SHARP] = np.maximum(strength[: -2 * _SHARP], strength[2 * _SHARP :])
        return out & (beside < 0.5 * strength)


def _curve(edges: Bools, smooth: float, most: float) -> tuple[float, NDArray[np.float64] | None]:
    """The share of the columns that one parabola through the edges (rows, W) crosses at an edge, and its rows (W,).

    By random sample consensus, seeded: a point of each third of the columns. Of curves with nearly the same share the
    highest: a caption or a reflection below the bonnet's edge is on the bonnet. `smooth` rows are near, `most` is the
    curve's span; both in rows.
    """
    columns = edges.shape[1]
    rows, at = np.nonzero(edges)
    thirds = [np.flatnonzero((at >= third * columns // 3) & (at < (third + 1) * columns // 3)) for third in range(3)]
    x, thick = np.arange(columns) / columns - 0.5, _thick(edges, smooth)
    if min(len(third) for third in thirds) < _MIN_COLUMNS // 2:
        return 0.0, None
    rng = np.random.default_rng(0)
    chosen = np.stack([third[rng.integers(0, len(third), _SAMPLES)] for third in thirds], axis=1)
    powers = np.stack([x[at[chosen]] ** 2, x[at[chosen]], np.ones(chosen.shape)], axis=-1)
    tried = np.linalg.solve(powers, rows[chosen][..., None].astype(np.float64))[..., 0]  # of columns that differ
    some = slice(_EACH // 2, None, _EACH)
    place = tried @ np.stack([x[some] ** 2, x[some], np.ones(len(x[some]))])  # (samples, columns)
    row = np.round(place).astype(np.int64)
    inside = (row >= 0) & (row < len(edges))
    hit = inside & (thick[np.clip(row, 0, len(edges) - 1), np.arange(columns)[some]] > 0)
    share = np.where(np.ptp(place, axis=1) <= most, hit.mean(axis=1), 0.0)
    alike = np.flatnonzero(share >= _ALIKE * share.max())
    best = alike[np.argmin(np.median(place[alike], axis=1))]
    curve: NDArray[np.float64] = tried[best] @ np.stack([x * x, x, np.ones(columns)])
    for _ in range(_FIT_ITERATIONS):
        near = np.abs(rows - curve[at]) < smooth
        if near.sum() < _MIN_COLUMNS:
            return 0.0, None
        curve = _parabola(x[at[near]], rows[near]) @ np.stack([x * x, x, np.ones(columns)])
    return _share(thick, curve), curve


def _thick(edges: Bools, smooth: float) -> NDArray[np.uint8]:
    """Edges with what is near them."""
    return np.asarray(cv2.dilate(edges.astype(np.uint8), np.ones((2 * round(smooth) + 1, 1), np.uint8)), np.uint8)


def _share(thick: NDArray[np.uint8], curve: NDArray[np.float64]) -> float:
    """Of the columns, those in which the curve (W,) runs near an edge."""
    row = np.clip(np.round(curve).astype(np.int64), 0, len(thick) - 1)
    return float(thick[row, np.arange(len(curve))].mean())


def _parabola(x: NDArray[np.float64], y: Ints) -> NDArray[np.float64]:
    """(3,) coefficients, highest power first, by least squares, |x| <= 0.5; numpy.polyfit takes far longer."""
    A = np.stack([x * x, x, np.ones(len(x))])
    out: NDArray[np.float64] = np.linalg.solve(A @ A.T, A @ y)
    return out
