"""Points of paint and of the road's edges, row by row of a `RoadView`.

Paint is bright between two darker sides: the step filter of Nieto et al. 2011, 2 I(y) - I(y-t) - I(y+t) -
|I(y-t) - I(y+t)|, which a shadow's border does not answer to. A network's mask says which of the bright ridges are
lines; where it is coarser than the image, the ridge says where the line is. Edges are where the road's mask ends.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.geometry.bev import tilted
from birdslam.lanes.road_view import LATTICE_M, RoadView

SIDE_M = 0.28  # from a line's middle to the asphalt beside it; lines are up to 0.3 m wide
APART_M = 0.3  # between two ridges
SYMBOL_M = 0.45  # wider paint is an arrow, a letter or a crossing's bar; lines are up to 0.3 m, and blurred by a pixel
HEAD_M, HEAD_RATIO = 0.25, 1.4  # of an arrow's head, over its mean; a line is as wide all along
CRACK_M = 0.2  # darker stripes up to this width are filled before paint is segmented
SYMBOL_LENGTH_M = 9.0  # longer paint is a line, whatever it touches
SYMBOL_SHARE = 0.5  # of the contrast of an image's brightest paint: kerbstones are paler
BAND_M = 1.2  # the widest paint that stands out from its row
MIN_CONTRAST = 6.0  # grey levels of a ridge over both sides
NOISE_FACTOR = 5.0  # ... and in multiples of what bare road answers
# A ridge that no network has counts as far as a line of 0.14 m is two pixels wide: farther off it may be a kerbstone, a
# rail or a joint as well, and blurs with the paint beside it
RESOLVED_M = 0.07
MASK_REACH_M = 0.24  # from a mask's paint to its ridge
WIDEST_M = 0.9  # of a mask's paint: a wider one is no line
SIGMA_RIDGE_M = 0.03  # of a ridge's middle, beside a share of a pixel
SIGMA_MASK_M = 0.08  # of a mask's middle
PIXEL_SHARE = 0.7  # sigma of a ridge in pixels
MAX_ROW_M = 0.4  # of road that a far row counts for
UNSEEN_WEIGHT = 0.5  # of a ridge that no mask knows, as evidence
SCRAP_SHARE = 0.1  # of the largest piece of the road's mask: a smaller one is a scrap
ROAD_REACH_M = 0.4  # a line at the road's edge lies partly outside its mask
GAP_M = 0.25  # of the road's mask: what is less is a mark's border, or noise; a kerb is wider
# Two stripes are a double line: so far apart from middle to middle at the most, alike, with asphalt between
DOUBLE_M, STRIPE_SHARE, GAP_SHARE = 0.4, 0.5, 0.6
DOUBLE_PIXEL_M = 0.025  # the coarsest that shows their gap
MIN_DOUBLE, MAX_DOUBLE = 6, 16  # rows of an image that are looked at
SIGMA_EDGE_M = 0.25
EDGE_PIXELS = 3.0  # sigma of a mask's border in pixels: networks see a half or a quarter of the resolution


@dataclass(frozen=True)
class LinePoints:
    """N points in ego: `x_m`, `y_m`, evidence `weight` (metres of road, at most the row's).

    1-sigma: `sigma_m` across the road, and `sigma_ray_rad` of the slope of the ray, which says how far away it is.
    `masked`: a network's mask has it. `yellow`: its excess of yellow over the road's, NaN of a grey image.
    """

    x_m: Floats
    y_m: Floats
    sigma_m: Floats
    weight: Floats
    masked: Bools
    yellow: Floats
    sigma_ray_rad: Floats

    def __len__(self) -> int:
        return len(self.x_m)

    def of(self, chosen: Bools | Ints) -> LinePoints:
        """Some of them."""
        return LinePoints(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def tilted(self, height_m: float, by_rad: float, vertical_per_m: float = 0.0) -> LinePoints:
        """The points if the camera's nose is lower by `by_rad`, on a road of that vertical curvature."""
        x_m, y_m = tilted(self.x_m, self.y_m, height_m, by_rad, vertical_per_m)
        return replace(self, x_m=x_m, y_m=y_m)


def paint_points(view: RoadView) -> LinePoints:
    """The middles of bright ridges on the road and of what the mask has beside them."""
    response = _response(view)
    least, usable = _bar(view, response)
    symbols = _symbols(view, response, usable, least)
    rows, columns, masked = _ridges(view, response, least, usable & ~symbols)
    ridge_y = view.y_m[columns] + _shift_m(view, rows, columns)
    alone_rows, alone_y = _mask_middles(view, usable & ~symbols, rows, columns)
    rows = np.concatenate([rows, alone_rows])
    y_m = np.concatenate([ridge_y, alone_y])
    by_mask = np.concatenate([np.zeros(len(ridge_y), bool), np.ones(len(alone_y), bool)])
    masked = np.concatenate([masked, np.ones(len(alone_y), bool)])
    base = np.where(by_mask, SIGMA_MASK_M, SIGMA_RIDGE_M)
    share = np.where(by_mask, 2.0, PIXEL_SHARE)
    yellow = np.full(len(rows), np.nan)
    if view.excess is not None and len(rows):
        road = view.road[::2, ::3]
        level = float(np.median(view.excess[::2, ::3][road])) if road.any() else 0.0
        column = np.clip(np.searchsorted(view.y_m, y_m), 0, len(view.y_m) - 1)
        yellow = view.excess[rows, column].astype(np.float64) - level
    return LinePoints(
        view.x_m[rows],
        y_m,
        np.hypot(base, share * view.sigma_y_m[rows]),
        np.minimum(view.row_m[rows], MAX_ROW_M) * np.where(masked, 1.0, UNSEEN_WEIGHT),
        masked,
        yellow,
        share * view.pixel_rad,
    )


def _response(view: RoadView) -> Floats32:
    """(R, C) of the step filter, in grey levels over the brighter side."""
    smooth = cv2.blur(view.grey, (3, 1))
    t = round(SIDE_M / LATTICE_M)
    padded = cv2.copyMakeBorder(smooth, 0, 0, t, t, cv2.BORDER_REPLICATE)
    right, left = padded[:, : -2 * t], padded[:, 2 * t :]
    return np.asarray(smooth - np.maximum(left, right), np.float32)  # half of Nieto's


def _bar(view: RoadView, response: Floats32) -> tuple[float, Bools]:
    """The least response of a ridge, and where one may be: on the road and at its border."""
    reach = 2 * round(ROAD_REACH_M / LATTICE_M) + 1
    on_road = cv2.dilate(_without_scraps(view).view(np.uint8), np.ones((1, reach), np.uint8)) > 0
    usable = on_road & ~view.hidden & ~view.outside
    bare = response[::2, ::3][usable[::2, ::3]]  # a sixth shows the spread as well
    if not len(bare):
        return MIN_CONTRAST, usable
    # A bare road's response is negative, its spread that of the texture
    middle = float(np.median(bare))
    spread = 1.4826 * float(np.median(np.abs(bare - middle)))
    return max(MIN_CONTRAST, NOISE_FACTOR * spread + min(middle, 0.0)), usable


def _without_scraps(view: RoadView) -> Bools:
    """(R, C) the road's mask without what is small and joined to no road: grass and gravel that a network takes for it.

    What vehicles cover joins the road on both sides of them.
    """
    joined = (view.road | view.paint | view.hidden).view(np.uint8)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=4)
    area = boxes[:, cv2.CC_STAT_AREA]
    area[0] = 0
    large: Bools = area > SCRAP_SHARE * area.max()
    return view.road & large[labels]


def _symbols(view: RoadView, response: Floats32, usable: Bools, least: float) -> Bools:
    """(R, C) arrows and letters: short connected paint, as bright as the brightest, that is wider than a line."""
    out = np.zeros(usable.shape, bool)
    strong = response[usable & (response > least)]
    if not len(strong):
        return out
    contrast = max(least, SYMBOL_SHARE * float(np.quantile(strong, 0.9)))
    band = np.ones((1, round(BAND_M / LATTICE_M) | 1), np.uint8)
    crack = np.ones((1, round(CRACK_M / LATTICE_M) | 1), np.uint8)  # between two of them asphalt is a bright band
    asphalt = cv2.morphologyEx(cv2.morphologyEx(view.grey, cv2.MORPH_CLOSE, crack), cv2.MORPH_OPEN, band)
    bright = usable & (view.grey - asphalt > contrast)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright.view(np.uint8), connectivity=8)
    row, first, past = _runs(bright)
    width, label = (past - first) * LATTICE_M, labels[row, first]
    beyond_blur = np.asarray(width - 2.0 * view.sigma_y_m[row], np.float64)
    widest = np.zeros(count)
    np.maximum.at(widest, np.asarray(label, np.int64), beyond_blur)
    mean = np.bincount(label, width, count) / np.maximum(np.bincount(label, minlength=count), 1)
    found = (widest > SYMBOL_M) | ((widest > HEAD_M) & (widest > HEAD_RATIO * mean))
    found[0] = False
    top = boxes[:, cv2.CC_STAT_TOP]
    last = top + boxes[:, cv2.CC_STAT_HEIGHT] - 1
    found &= view.x_m[last] - view.x_m[top] < SYMBOL_LENGTH_M
    out = cv2.dilate(found[labels].view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return out


def _runs(mask: Bools) -> tuple[Ints, Ints, Ints]:
    """Row, first column and the column past the last of each run of a mask (R, C)."""
    padded = np.zeros((mask.shape[0], mask.shape[1] + 2), np.int8)
    padded[:, 1:-1] = mask
    change = np.diff(padded, axis=1)
    row, first = (change > 0).nonzero()
    _, past = (change < 0).nonzero()
    return row, first, past


def _ridges(view: RoadView, response: Floats32, least: float, usable: Bools) -> tuple[Ints, Ints, Bools]:
    """Rows and columns of the ridges' crests on the road, and whether the mask has paint there."""
    apart = 2 * round(APART_M / LATTICE_M) + 1
    crest = cv2.blur(response, (3, 1))
    peaks = usable & (response > least) & (crest >= cv2.dilate(crest, np.ones((1, apart), np.uint8)))
    near_paint = cv2.dilate(view.paint.view(np.uint8), np.ones((1, 2 * round(MASK_REACH_M / LATTICE_M) + 1), np.uint8))
    # A weaker ridge counts where a network sees paint
    weak = usable & (near_paint > 0) & (response > 0.5 * least)
    peaks |= weak & (crest >= cv2.dilate(crest, np.ones((1, apart), np.uint8)))
    peaks &= (near_paint > 0) | (view.sigma_y_m[:, None] <= RESOLVED_M)
    rows, columns = peaks.nonzero()
    return rows, columns, near_paint[rows, columns] > 0


def _shift_m(view: RoadView, rows: Ints, columns: Ints) -> Floats:
    """From a crest's column to the middle of the bright band around it."""
    reach = round(SIDE_M / LATTICE_M)
    steps = np.arange(-reach, reach + 1)
    at = np.clip(columns[:, None] + steps, 0, len(view.y_m) - 1)
    values = view.grey[rows[:, None], at]
    floor = np.maximum(values[:, :1], values[:, -1:])
    share = np.maximum(values - floor, 0.0)
    out: Floats = (share * steps).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-6) * LATTICE_M
    return out


def double_share(view: RoadView, points: LinePoints) -> float | None:
    """The share of a line's points that two stripes side by side make, with road on either hand.

    None where the image does not resolve them. Kerbs and gravel beside a line at the road's edge look like a stripe.
    """
    rows = np.clip(np.searchsorted(view.x_m, points.x_m), 0, len(view.x_m) - 1)
    rows, y_m = rows[fine := view.sigma_y_m[rows] < DOUBLE_PIXEL_M], points.y_m[fine]
    if len(rows) < MIN_DOUBLE:
        return None
    every = 1 + len(rows) // MAX_DOUBLE
    rows, y_m = rows[::every], y_m[::every]
    reach = round(2.0 * SIDE_M / LATTICE_M)
    middle = np.round((y_m - view.y_m[0]) / LATTICE_M).astype(np.int64)
    at = np.clip(middle[:, None] + np.arange(-reach, reach + 1), 0, len(view.y_m) - 1)
    grey = view.grey[rows[:, None], at]
    above = grey - np.sort(grey, axis=1)[:, reach // 2, None]  # over the asphalt
    double, between = np.zeros(len(rows), bool), above[:, 1:-1]
    for apart in range(2, round(DOUBLE_M / LATTICE_M) + 1):
        weaker = np.minimum(above[:, :-apart], above[:, apart:])
        stripes = (weaker > MIN_CONTRAST) & (weaker > STRIPE_SHARE * above.max(axis=1, keepdims=True))
        double |= (stripes & (between < GAP_SHARE * weaker)).any(axis=1)
        between = np.minimum(between[:, :-1], above[:, apart:-1])
    beyond = round((DOUBLE_M + SIDE_M) / LATTICE_M)
    either = np.clip(middle[:, None] + [-beyond, beyond], 0, len(view.y_m) - 1)
    return float((double & view.road[rows[:, None], either].all(axis=1)).mean())


def _mask_middles(view: RoadView, usable: Bools, rows: Ints, columns: Ints) -> tuple[Ints, Floats]:
    """Rows and y of the middles of the mask's bands that have no ridge."""
    row, first, past = _runs(view.paint)
    wide = (past - first) * LATTICE_M
    ridge = np.zeros((len(view.x_m), len(view.y_m) + 1), np.int64)
    ridge[rows, columns + 1] = 1
    ridge = ridge.cumsum(axis=1)
    reach = round(MASK_REACH_M / LATTICE_M)
    low, high = np.maximum(first - reach, 0), np.minimum(past + reach, len(view.y_m))
    bare = (ridge[row, high] - ridge[row, low] == 0) & (wide < WIDEST_M) & usable[row, (first + past) // 2]
    at = 0.5 * (first + past - 1)[bare]
    out: Floats = view.y_m[0] + at * LATTICE_M
    return row[bare], out


def edge_points(view: RoadView, middle_m: Floats) -> tuple[LinePoints, LinePoints]:
    """Left and right border of the road that holds `middle_m` (R,), the way ahead; not where a vehicle covers it."""
    gap = round(GAP_M / LATTICE_M) | 1
    closed = cv2.morphologyEx((view.road | view.paint).view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, gap), np.uint8))
    free = (closed > 0) & ~view.outside
    start = np.clip(np.searchsorted(view.y_m, middle_m), 0, len(view.y_m) - 1)
    count = len(view.y_m)
    index = np.arange(count, dtype=np.int32)
    out = []
    on = free[np.arange(len(start)), start]
    for side in (1, -1):
        stops = ~free & ((index > start[:, None]) if side > 0 else (index < start[:, None]))
        ordered = stops if side > 0 else stops[:, ::-1]
        first = ordered.argmax(axis=1)  # lattice steps to the first that is no road
        first = first if side > 0 else count - 1 - first
        at = np.where(stops.any(axis=1), np.abs(first - start), count)
        column = start + side * at
        inside = on & (column >= 0) & (column < count) & (at < count)
        past = np.clip(column, 0, count - 1)
        rows = np.arange(len(start))
        seen = inside & ~view.outside[rows, past] & ~_beside(view.hidden, rows, past, side)
        kept = np.flatnonzero(seen)
        y_m = view.y_m[past[kept]] - 0.5 * side * LATTICE_M
        sigma = np.hypot(SIGMA_EDGE_M, EDGE_PIXELS * view.sigma_y_m[kept])
        nothing = np.full(len(kept), np.nan)
        out.append(
            LinePoints(
                view.x_m[kept],
                y_m,
                sigma,
                np.minimum(view.row_m[kept], MAX_ROW_M),
                np.ones(len(kept), bool),
                nothing,
                np.full(len(kept), EDGE_PIXELS * view.pixel_rad),
            )
        )
    return out[0], out[1]


def _beside(hidden: Bools, rows: Ints, columns: Ints, side: int) -> Bools:
    """Whether a vehicle stands within half a metre beyond."""
    reach = round(0.5 / LATTICE_M)
    steps = np.clip(columns[:, None] + side * np.arange(reach), 0, hidden.shape[1] - 1)
    out: Bools = hidden[rows[:, None], steps].any(axis=1)
    return out
