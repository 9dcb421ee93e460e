"""Detection of the car's bonnet (or a dashboard, or a black border) at the lower edge of the image.

The mean vertical gradient of images of a moving car keeps a fixed edge and averages out the road. A bonnet is a nearly
horizontal fixed edge along one parabola across most columns. Its contrast varies with reflections and changes sign, so
that a known bonnet is dropped only if edges of either sign are no more frequent along it than elsewhere.
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

_DOWNSCALE = 2  # scale of the images for detection
_MIN_ROW_RATIO = 0.4  # of the road rows: minimum row of a bonnet edge
_MAX_LINE_RATIO = 0.7  # of the edge columns, those with an adjacent edge of the other sign; above this it is a line
_FIT_ITERATIONS = 2  # refinements by the edges near the last curve
_SAMPLES = 200  # of the random sample consensus
_COLUMN_STEP = 4  # columns per scored column
_SIMILAR_RATIO = 0.85  # of the best curve's share, of equally good curves
_MIN_COLUMNS = 8  # for a fit
_MAX_SAG_RATIO = 0.1  # of a curve over the image height
_MAX_HORIZONTAL_RATIO = 0.4  # horizontal over vertical gradient; lane lines have more
_MAX_EDGE_ROWS = 4  # distance from an edge's centre at which its strength is below one half
_MARGIN_PX = 6  # above the edge, for the smoothing of the road image


class BonnetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of the bonnet detection."""

    step_m: Positive = 0.5  # distance between two images of the mean
    images: Annotated[int, msgspec.Meta(ge=3)] = 6  # images of the mean; detection after each half of them
    edge_grey: Positive = 1.5  # minimum strength of a fixed edge in the mean, per pixel
    changes: Share = 0.4  # maximum mean deviation of an edge over its strength
    on_threshold: Share = 0.5  # minimum ratio of columns with an edge, for detection
    off_threshold: Share = 0.1  # minimum excess of that ratio over the rest of the image, to keep a bonnet
    smooth_px: Positive = 8.0  # maximum distance of an edge from its curve


class Bonnet:
    """State: mean and mean deviation of the vertical gradients. Reader: `RoadScale`, which excludes its pixels."""

    def __init__(self, config: BonnetConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._deviation: Grey | None = None
        self._images = 0
        self._since_m = np.inf
        self.rows: Ints | None = None  # (W,) first row of the bonnet; None: no bonnet
        self._last_curve: NDArray[np.float64] | None = None  # the same curve in rows of the detection

    def update(self, grey: NDArray[np.uint8], top_px: int, travelled_m: float) -> bool:
        """Adds an image (H, W), `travelled_m` after the previous one, rows from `top_px`; whether a bonnet is new."""
        cfg = self.config
        self._since_m += travelled_m
        if self._since_m < cfg.step_m:
            return False
        self._since_m = 0.0
        small = cv2.resize(grey[top_px:], None, fx=1 / _DOWNSCALE, fy=1 / _DOWNSCALE, interpolation=cv2.INTER_AREA)
        slope = np.asarray(cv2.Sobel(small, cv2.CV_32F, 0, 1, ksize=3, scale=0.125), np.float32)
        self._images += 1
        share = max(1.0 / self._images, 1.0 / cfg.images)
        if self._mean is None or self._deviation is None:
            self._mean, self._deviation = slope.copy(), np.zeros_like(slope)
            return False
        cv2.accumulateWeighted(np.abs(slope - self._mean), self._deviation, share)
        cv2.accumulateWeighted(slope, self._mean, share)
        if self._images % (cfg.images // 2):  # the mean has changed little since the last fit
            return False
        before, self.rows = self.rows, self._edge(top_px, *grey.shape)
        return before is None and self.rows is not None

    @property
    def is_initialised(self) -> bool:
        """Whether an image was added."""
        return self._images > 0

    @property
    def present(self) -> bool:
        """Whether there is a bonnet."""
        return self.rows is not None

    def above(self, px: Ints) -> Ints:
        """The pixels, of (N, 2), above the bonnet."""
        return px if self.rows is None else px[px[:, 1] < self.rows[px[:, 0]]]

    def _edge(self, top_px: int, height: int, width: int) -> Ints | None:
        """(W,) rows of the curve with most inlier columns, less a margin; None: no bonnet."""
        cfg = self.config
        max_span = 1.5 * _MAX_SAG_RATIO * height / _DOWNSCALE
        above = round(_MIN_ROW_RATIO * (height - top_px) / _DOWNSCALE)  # rows above the bonnet edge
        edges = [self._fixed_edges(sign)[above:] for sign in (1.0, -1.0)]
        smooth = cfg.smooth_px / _DOWNSCALE
        curves = [_fit_curve(each, smooth, max_span) for each in edges]
        (share, curve), other = max(zip(curves, reversed(edges), strict=True), key=lambda found: found[0][0])
        if (
            share < cfg.on_threshold
            or curve is None
            or _edge_ratio(_dilate(other, smooth), curve) > _MAX_LINE_RATIO * share
        ):
            # No edge, or a line (brighter or darker than both sides): a reflection or text
            curve = self._last_curve if self._persists(_dilate(edges[0] | edges[1], smooth)) else None
        self._last_curve = curve
        if curve is None:
            return None
        fine = np.interp(np.arange(width), _DOWNSCALE * (np.arange(len(curve)) + 0.5), curve)
        return np.clip(top_px + _DOWNSCALE * (above + fine) - _MARGIN_PX, 0, height).astype(np.int64)

    def _persists(self, dilated: NDArray[np.uint8]) -> bool:
        """Whether edges are more frequent along the known bonnet edge than in the rest of the image."""
        if self._last_curve is None:
            return False
        return _edge_ratio(dilated, self._last_curve) - float(dilated.mean()) >= self.config.off_threshold

    def _fixed_edges(self, sign: float) -> Bools:
        """Fixed edges that are brighter below (`sign` 1) or above (-1)."""
        cfg, mean, deviation = self.config, self._mean, self._deviation
        assert mean is not None
        assert deviation is not None
        across = np.abs(cv2.Scharr(mean, cv2.CV_32F, 1, 0, scale=1.0 / 32.0))
        strength = sign * mean
        out: Bools = (
            (strength > cfg.edge_grey)
            & (deviation < cfg.changes * strength)
            & (across < _MAX_HORIZONTAL_RATIO * strength)
        )
        # The rim of the headlights' beam is fixed too, but not sharp
        beside = np.full_like(strength, np.inf)
        beside[_MAX_EDGE_ROWS:-_MAX_EDGE_ROWS] = np.maximum(
            strength[: -2 * _MAX_EDGE_ROWS], strength[2 * _MAX_EDGE_ROWS :]
        )
        return out & (beside < 0.5 * strength)


def _fit_curve(edges: Bools, smooth: float, max_span: float) -> tuple[float, NDArray[np.float64] | None]:
    """Fits a parabola to edges (rows, W): the ratio of columns with an edge along it, and its rows (W,).

    Seeded random sample consensus with one point of each third of the columns. Of similar curves selects the highest,
    since a caption or a reflection lies below the bonnet's edge. `smooth` is the inlier distance, `max_span` the
    maximum span of the curve; both in rows.
    """
    columns = edges.shape[1]
    rows, at = np.nonzero(edges)
    thirds = [np.flatnonzero((at >= third * columns // 3) & (at < (third + 1) * columns // 3)) for third in range(3)]
    x, dilated = np.arange(columns) / columns - 0.5, _dilate(edges, smooth)
    if min(len(third) for third in thirds) < _MIN_COLUMNS // 2:
        return 0.0, None
    rng = np.random.default_rng(0)
    chosen = np.stack([third[rng.integers(0, len(third), _SAMPLES)] for third in thirds], axis=1)
    powers = np.stack([x[at[chosen]] ** 2, x[at[chosen]], np.ones(chosen.shape)], axis=-1)
    tried = np.linalg.solve(powers, rows[chosen][..., None].astype(np.float64))[..., 0]
    some = slice(_COLUMN_STEP // 2, None, _COLUMN_STEP)
    place = tried @ np.stack([x[some] ** 2, x[some], np.ones(len(x[some]))])  # (samples, columns)
    row = np.round(place).astype(np.int64)
    inside = (row >= 0) & (row < len(edges))
    hit = inside & (dilated[np.clip(row, 0, len(edges) - 1), np.arange(columns)[some]] > 0)
    share = np.where(np.ptp(place, axis=1) <= max_span, hit.mean(axis=1), 0.0)
    alike = np.flatnonzero(share >= _SIMILAR_RATIO * share.max())
    best = alike[np.argmin(np.median(place[alike], axis=1))]
    curve: NDArray[np.float64] = tried[best] @ np.stack([x * x, x, np.ones(columns)])
    for _ in range(_FIT_ITERATIONS):
        near = np.abs(rows - curve[at]) < smooth
        if near.sum() < _MIN_COLUMNS:
            return 0.0, None
        curve = _fit_parabola(x[at[near]], rows[near]) @ np.stack([x * x, x, np.ones(columns)])
    return _edge_ratio(dilated, curve), curve


def _dilate(edges: Bools, smooth: float) -> NDArray[np.uint8]:
    """Dilates edges vertically by `smooth` rows."""
    return np.asarray(cv2.dilate(edges.astype(np.uint8), np.ones((2 * round(smooth) + 1, 1), np.uint8)), np.uint8)


def _edge_ratio(dilated: NDArray[np.uint8], curve: NDArray[np.float64]) -> float:
    """Ratio of the columns in which the curve (W,) is near an edge."""
    row = np.clip(np.round(curve).astype(np.int64), 0, len(dilated) - 1)
    return float(dilated[row, np.arange(len(curve))].mean())


def _fit_parabola(x: NDArray[np.float64], y: Ints) -> NDArray[np.float64]:
    """(3,) least-squares coefficients, highest power first, |x| <= 0.5; faster than numpy.polyfit."""
    A = np.stack([x * x, x, np.ones(len(x))])
    out: NDArray[np.float64] = np.linalg.solve(A @ A.T, A @ y)
    return out
