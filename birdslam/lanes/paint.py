"""Detects points of paint and of the road's edges in each row of a `RoadView`.

Paint is brighter than both sides: the step filter of Nieto et al. 2011, 2 I(y) - I(y-t) - I(y+t) - |I(y-t) - I(y+t)|,
which does not respond to the border of a shadow. The same filter finds yellow paint by its colour. A network's mask
selects the ridges that are lines; the ridge gives the position, since the mask is coarser. Edges are the borders of the
road's mask.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.geometry.bev import tilted
from birdslam.lanes.road_view import LATTICE_M, Grid, RoadView

STEP_FILTER_M = 0.28  # from a line's middle to the asphalt beside it; lines are up to 0.3 m wide
MIN_RIDGE_SPACING_M = 0.3  # between two ridges
MAX_LINE_WIDTH_M = 0.45  # wider paint (plus blur) is an arrow, a letter or a crossing's bar; lines are up to 0.3 m wide
MIN_HEAD_WIDTH_M, MIN_HEAD_RATIO = 0.25, 1.4  # width of an arrow's head, absolute and over its mean
MAX_CRACK_M = 0.2  # darker stripes up to this width are filled before paint is segmented
MAX_SYMBOL_LENGTH_M = 9.0  # longer paint is a line even if it touches a symbol
SYMBOL_CONTRAST_RATIO = 0.5  # of the contrast of the brightest paint: kerbstones are paler
MAX_BAND_M = 1.2  # max. width of paint for the estimate of the asphalt's brightness
MIN_CONTRAST = 6.0  # min. response of a certain ridge in grey levels
MIN_YELLOW = 25.0  # excess of yellow paint over the road's; JPEG and video store colour coarsely
MIN_CONTRAST_SIGMAS = 5.0  # min. response over the spread of the responses of bare road
# Max. pixel size at which a ridge outside the mask counts, so that a line of 0.14 m is two pixels wide: farther away it
# may be a kerbstone, a rail or a joint
MAX_UNMASKED_PIXEL_M = 0.07
MAX_MASK_DISTANCE_M = 0.24  # max. distance between a ridge and a mask's paint
MAX_MASK_WIDTH_M = 0.9  # max. width of a mask's line
SIGMA_RIDGE_M = 0.03  # of a ridge's middle, beside the pixel's share
SIGMA_MASK_M = 0.08  # of a mask's middle
SIGMA_RIDGE_PX, SIGMA_MASK_PX = 0.7, 2.0  # the same in pixels
MAX_ROW_M = 0.4  # max. length of road per row
MIN_STRENGTH = 0.5  # min. response of a ridge over that of a certain one: a line is many weak ridges
UNMASKED_WEIGHT = 0.5  # evidence of a certain ridge outside the mask
MIN_PIECE_RATIO = 0.1  # min. area over the largest piece of the road's mask
ROAD_MARGIN_M = 0.4  # a line at the road's edge lies partly outside the mask
MAX_MASK_GAP_M = 0.25  # gaps of the road's mask that are closed: borders of markings and noise; a kerb is wider
# A double line: max. distance between two stripes, min. brightness of the weaker one, max. brightness between them
MAX_STRIPE_DISTANCE_M, MIN_STRIPE_RATIO, MAX_GAP_RATIO = 0.4, 0.5, 0.6
MAX_DOUBLE_PIXEL_M = 0.025  # max. pixel size that resolves their gap
MIN_DOUBLE_ROWS, MAX_DOUBLE_ROWS = 6, 16  # number of rows
VEHICLE_MARGIN_M = 0.5  # from a vehicle: its shadow and what it covers
SIGMA_EDGE_M = 0.25
SIGMA_EDGE_PX = 3.0  # sigma of a mask's border in pixels: networks have a half or a quarter of the image's resolution


@dataclass(frozen=True)
class LinePoints:
    """N points in ego: `x_m`, `y_m`, evidence `weight` (metres of road, at most the row's).

    1-sigma: `sigma_m` across the road, `sigma_ray_rad` of the slope of the ray, which determines the distance.
    `masked`: inside a network's mask. `yellow`: excess of yellow over the road's, NaN for a grey image.
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
        """Selects points."""
        return LinePoints(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def tilted(self, height_m: float, by_rad: float, vertical_per_m: float = 0.0) -> LinePoints:
        """The points if the camera looks lower by `by_rad` on a road of this vertical curvature."""
        x_m, y_m = tilted(self.x_m, self.y_m, height_m, by_rad, vertical_per_m)
        return replace(self, x_m=x_m, y_m=y_m)


def paint_points(view: RoadView) -> LinePoints:
    """Middles of the bright or yellow ridges on the road, and of the mask's paint without a ridge."""
    usable = _near_road(view)
    response = _response(view.grey)
    min_response = _min_response(response, usable, MIN_CONTRAST)
    strength, plane = response / min_response, np.zeros(response.shape, np.int64)
    if view.excess is not None:  # yellow paint on concrete may be as bright as the road
        by_colour = _response(view.excess)
        by_colour /= _min_response(by_colour, usable, MIN_YELLOW)
        plane = (by_colour > strength).astype(np.int64)
        strength = np.maximum(strength, by_colour)
    clear = usable & ~_symbols(view, response, usable, min_response)
    rows, columns, masked = _ridges(view, strength, clear)
    ridge_y = view.y_m[columns] + _band_offset_m(view, rows, columns, plane[rows, columns])
    strong = np.minimum(strength[rows, columns], 1.0)
    alone_rows, alone_y = _mask_middles(view, clear, rows, columns)
    alone = np.ones(len(alone_rows))
    # The error of a ridge's position is inverse to its contrast
    base = np.concatenate([SIGMA_RIDGE_M / strong, SIGMA_MASK_M * alone])
    share = np.concatenate([SIGMA_RIDGE_PX / strong, SIGMA_MASK_PX * alone])
    unmasked = UNMASKED_WEIGHT * (strong - MIN_STRENGTH) / (1.0 - MIN_STRENGTH)
    evidence = np.concatenate([np.where(masked, 1.0, unmasked), alone])
    rows = np.concatenate([rows, alone_rows])
    y_m = np.concatenate([ridge_y, alone_y])
    masked = np.concatenate([masked, alone > 0.0])
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
        np.minimum(view.row_m[rows], MAX_ROW_M) * evidence,
        masked,
        yellow,
        share * view.pixel_rad,
    )


def _response(values: Grid) -> Floats32:
    """(R, C) response of the step filter, in levels over the brighter side."""
    smooth = cv2.blur(values, (3, 1))
    t = round(STEP_FILTER_M / LATTICE_M)
    padded = cv2.copyMakeBorder(smooth, 0, 0, t, t, cv2.BORDER_REPLICATE)
    right, left = padded[:, : -2 * t], padded[:, 2 * t :]
    return np.asarray(smooth - np.maximum(left, right), np.float32)  # half of Nieto's response


def _near_road(view: RoadView) -> Bools:
    """(R, C) cells on the road and at its border."""
    reach = 2 * round(ROAD_MARGIN_M / LATTICE_M) + 1
    on_road = cv2.dilate(_without_small_pieces(view).view(np.uint8), np.ones((1, reach), np.uint8)) > 0
    return np.asarray(on_road & ~view.hidden & ~view.outside)


def _min_response(response: Floats32, usable: Bools, least: float) -> float:
    """Min. response of a ridge that is certain, at least `least`."""
    bare = response[::2, ::3][usable[::2, ::3]]  # every sixth cell is enough
    if not len(bare):
        return least
    # The response of bare road is negative with the spread of the texture
    middle = float(np.median(bare))
    spread = 1.4826 * float(np.median(np.abs(bare - middle)))
    return max(least, MIN_CONTRAST_SIGMAS * spread + min(middle, 0.0))


def _without_small_pieces(view: RoadView) -> Bools:
    """(R, C) the road's mask without small isolated pieces, such as grass and gravel.

    Cells that vehicles cover connect the pieces.
    """
    joined = (view.road | view.paint | view.hidden).view(np.uint8)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(joined, connectivity=4)
    area = boxes[:, cv2.CC_STAT_AREA]
    area[0] = 0
    large: Bools = area > MIN_PIECE_RATIO * area.max()
    return view.road & large[labels]


def _symbols(view: RoadView, response: Floats32, usable: Bools, min_response: float) -> Bools:
    """(R, C) arrows and letters: short connected paint, as bright as the brightest and wider than a line."""
    out = np.zeros(usable.shape, bool)
    strong = response[usable & (response > min_response)]
    if not len(strong):
        return out
    contrast = max(min_response, SYMBOL_CONTRAST_RATIO * float(np.quantile(strong, 0.9)))
    band = np.ones((1, round(MAX_BAND_M / LATTICE_M) | 1), np.uint8)
    # Asphalt between two cracks looks like a bright band
    crack = np.ones((1, round(MAX_CRACK_M / LATTICE_M) | 1), np.uint8)
    asphalt = cv2.morphologyEx(cv2.morphologyEx(view.grey, cv2.MORPH_CLOSE, crack), cv2.MORPH_OPEN, band)
    bright = usable & (view.grey - asphalt > contrast)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright.view(np.uint8), connectivity=8)
    row, first, past = _runs(bright)
    width, label = (past - first) * LATTICE_M, labels[row, first]
    beyond_blur = np.asarray(width - 2.0 * view.sigma_y_m[row], np.float64)
    widest = np.zeros(count)
    np.maximum.at(widest, np.asarray(label, np.int64), beyond_blur)
    mean = np.bincount(label, width, count) / np.maximum(np.bincount(label, minlength=count), 1)
    found = (widest > MAX_LINE_WIDTH_M) | ((widest > MIN_HEAD_WIDTH_M) & (widest > MIN_HEAD_RATIO * mean))
    found[0] = False
    top = boxes[:, cv2.CC_STAT_TOP]
    last = top + boxes[:, cv2.CC_STAT_HEIGHT] - 1
    found &= view.x_m[last] - view.x_m[top] < MAX_SYMBOL_LENGTH_M
    out = cv2.dilate(found[labels].view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return out


def _runs(mask: Bools) -> tuple[Ints, Ints, Ints]:
    """Row, first column and end column (exclusive) of each run of a mask (R, C)."""
    padded = np.zeros((mask.shape[0], mask.shape[1] + 2), np.int8)
    padded[:, 1:-1] = mask
    change = np.diff(padded, axis=1)
    row, first = (change > 0).nonzero()
    _, past = (change < 0).nonzero()
    return row, first, past


def _ridges(view: RoadView, strength: Floats32, usable: Bools) -> tuple[Ints, Ints, Bools]:
    """Rows and columns of the ridges' maxima on the road, and whether they are near the mask's paint.

    `strength` (R, C) is the response over that of a certain ridge.
    """
    apart = 2 * round(MIN_RIDGE_SPACING_M / LATTICE_M) + 1
    crest = cv2.blur(strength, (3, 1))
    peaks = usable & (strength > MIN_STRENGTH) & (crest >= cv2.dilate(crest, np.ones((1, apart), np.uint8)))
    near_paint = cv2.dilate(
        view.paint.view(np.uint8), np.ones((1, 2 * round(MAX_MASK_DISTANCE_M / LATTICE_M) + 1), np.uint8)
    )
    peaks &= (near_paint > 0) | (view.sigma_y_m[:, None] <= MAX_UNMASKED_PIXEL_M)
    rows, columns = peaks.nonzero()
    return rows, columns, near_paint[rows, columns] > 0


def _band_offset_m(view: RoadView, rows: Ints, columns: Ints, plane: Ints) -> Floats:
    """From the column of a ridge's maximum to the middle of its bright (`plane` 0) or yellow (1) band."""
    reach = round(STEP_FILTER_M / LATTICE_M)
    steps = np.arange(-reach, reach + 1)
    at = np.clip(columns[:, None] + steps, 0, len(view.y_m) - 1)
    values = view.grey[rows[:, None], at]
    if view.excess is not None:
        values = np.where(plane[:, None] > 0, view.excess[rows[:, None], at], values)
    floor = np.maximum(values[:, :1], values[:, -1:])
    share = np.maximum(values - floor, 0.0)
    out: Floats = (share * steps).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-6) * LATTICE_M
    return out


def double_line_share(view: RoadView, points: LinePoints) -> float | None:
    """The share of a line's points with two stripes side by side and road on both sides.

    None if the image does not resolve them. Kerbs and gravel beside a line at the road's edge look like a stripe.
    """
    rows = np.clip(np.searchsorted(view.x_m, points.x_m), 0, len(view.x_m) - 1)
    rows, y_m = rows[fine := view.sigma_y_m[rows] < MAX_DOUBLE_PIXEL_M], points.y_m[fine]
    if len(rows) < MIN_DOUBLE_ROWS:
        return None
    every = 1 + len(rows) // MAX_DOUBLE_ROWS
    rows, y_m = rows[::every], y_m[::every]
    reach = round(2.0 * STEP_FILTER_M / LATTICE_M)
    middle = np.round((y_m - view.y_m[0]) / LATTICE_M).astype(np.int64)
    at = np.clip(middle[:, None] + np.arange(-reach, reach + 1), 0, len(view.y_m) - 1)
    grey = view.grey[rows[:, None], at]
    above = grey - np.sort(grey, axis=1)[:, reach // 2, None]  # over the asphalt
    double, between = np.zeros(len(rows), bool), above[:, 1:-1]
    for apart in range(2, round(MAX_STRIPE_DISTANCE_M / LATTICE_M) + 1):
        weaker = np.minimum(above[:, :-apart], above[:, apart:])
        stripes = (weaker > MIN_CONTRAST) & (weaker > MIN_STRIPE_RATIO * above.max(axis=1, keepdims=True))
        double |= (stripes & (between < MAX_GAP_RATIO * weaker)).any(axis=1)
        between = np.minimum(between[:, :-1], above[:, apart:-1])
    beyond = round((MAX_STRIPE_DISTANCE_M + STEP_FILTER_M) / LATTICE_M)
    either = np.clip(middle[:, None] + [-beyond, beyond], 0, len(view.y_m) - 1)
    return float((double & view.road[rows[:, None], either].all(axis=1)).mean())


def _mask_middles(view: RoadView, usable: Bools, rows: Ints, columns: Ints) -> tuple[Ints, Floats]:
    """Rows and y of the middles of the mask's bands without a ridge."""
    row, first, past = _runs(view.paint)
    wide = (past - first) * LATTICE_M
    ridge = np.zeros((len(view.x_m), len(view.y_m) + 1), np.int64)
    ridge[rows, columns + 1] = 1
    ridge = ridge.cumsum(axis=1)
    reach = round(MAX_MASK_DISTANCE_M / LATTICE_M)
    low, high = np.maximum(first - reach, 0), np.minimum(past + reach, len(view.y_m))
    bare = (ridge[row, high] - ridge[row, low] == 0) & (wide < MAX_MASK_WIDTH_M) & usable[row, (first + past) // 2]
    at = 0.5 * (first + past - 1)[bare]
    out: Floats = view.y_m[0] + at * LATTICE_M
    return row[bare], out


def edge_points(view: RoadView, middle_m: Floats) -> tuple[LinePoints, LinePoints]:
    """Left and right border of the road around `middle_m` (R,); not where a vehicle covers it."""
    gap = round(MAX_MASK_GAP_M / LATTICE_M) | 1
    closed = cv2.morphologyEx((view.road | view.paint).view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, gap), np.uint8))
    free = (closed > 0) & ~view.outside
    count, rows = len(view.y_m), np.arange(len(view.x_m))
    start = np.clip(np.searchsorted(view.y_m, middle_m), 0, count - 1)
    index = np.arange(count, dtype=np.int32)
    out = []
    for side in (1, -1):
        stops = ~free & (side * index > side * start[:, None])
        at = stops.argmax(axis=1) if side > 0 else count - 1 - stops[:, ::-1].argmax(axis=1)
        kept = free[rows, start] & stops.any(axis=1) & ~view.outside[rows, at]
        kept &= ~beside_vehicles(view, side)[rows, at]
        y_m = view.y_m[at] - 0.5 * side * LATTICE_M
        out.append(border_at(view, np.flatnonzero(kept), y_m[kept], SIGMA_EDGE_M, SIGMA_EDGE_PX))
    return out[0], out[1]


def beside_vehicles(view: RoadView, side: int) -> Bools:
    """(R, C) cells that a vehicle covers, or may shade or hide the border of: it begins within VEHICLE_MARGIN_M.

    `side` 1: the vehicle is to the left of the cell, -1: to the right.
    """
    cells = round(VEHICLE_MARGIN_M / LATTICE_M) + 1
    anchor = (cells - 1 if side < 0 else 0, 0)
    hidden = cv2.dilate(view.hidden.view(np.uint8), np.ones((1, cells), np.uint8), anchor=anchor)
    return np.asarray(hidden > 0)


def border_at(view: RoadView, rows: Ints, y_m: Floats, sigma_m: float, sigma_px: float) -> LinePoints:
    """Points of a border at `y_m` in these rows, whose 1-sigma has a part in metres and one in pixels."""
    return LinePoints(
        view.x_m[rows],
        y_m,
        np.hypot(sigma_m, sigma_px * view.sigma_y_m[rows]),
        np.minimum(view.row_m[rows], MAX_ROW_M),
        np.ones(len(rows), bool),
        np.full(len(rows), np.nan),
        np.full(len(rows), sigma_px * view.pixel_rad),
    )
