"""Finds the border of a lane that has paint on one side only: curb, gutter or verge, parallel to that paint.

A border is a step in brightness or colour with one sign along the whole lane, which the border of a shadow has not. The
lane ends at the first border from its inside. The log probability of a width sums the step's evidence over that of
steps nearer to the paint, the share of the rows in which the road's mask ends there, and the prior of widths.
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Bools, Floats
from birdslam.lanes.paint import LinePoints, beside_vehicles, border_at
from birdslam.lanes.road_view import LATTICE_M, RoadView
from birdslam.lanes.topology import WIDTH_M, WIDTH_SIGMA_M

NEAR_M, FAR_M = 4.0, 30.0  # range of the rows that vote
WIDTHS_M = np.arange(1.0, 6.5, LATTICE_M)
MIN_WIDTH_M = 2.0  # narrower: a seam or a wheel track within the lane
ANY_WIDTH = 0.02  # prior of any width over that of the usual one
STEP_M = 0.2  # of the road on either side of a step
MAX_STEP_SIGMAS, MIN_GREY = 3.0, 1.0  # limit of one row's vote; least noise in grey levels
MAX_MEAN_SIGMAS = 2.5
STEP_EVIDENCE = 1.5  # log odds per squared mean of the votes
MASK_EVIDENCE, MASK_SIGMA_M = 1.0, 0.2  # log odds of a mask's border along the whole lane
MIN_LOG_ODDS = 0.5  # of a border; below, none is seen
INSIDE_M = 0.32  # steps nearer than this are the same border
MIN_VOTE_SIGMAS = 0.5  # of a row at the border
SIGMA_BORDER_M, SIGMA_BORDER_PX = 0.15, 1.5


def border_points(view: RoadView, bound_m: Floats, stretch: Floats, side: int, mask: LinePoints) -> LinePoints:
    """Points of the border at the left (`side` 1) or right (-1) of a lane with a painted bound on the other side.

    `bound_m` (R,) is the painted bound in the rows of the view, `stretch` (R,) metres of the view per metre of road.
    `mask` has the border of the road's mask on that side; it is returned where no border is seen.
    """
    y_m = bound_m[:, None] + side * WIDTHS_M * stretch[:, None]
    rows = (view.x_m > NEAR_M) & (view.x_m < FAR_M)
    column = np.round((y_m - view.y_m[0]) / LATTICE_M).astype(np.int64)
    at = np.arange(len(view.x_m))[:, None], np.clip(column, 0, len(view.y_m) - 1)
    seen = rows[:, None] & (column == at[1]) & ~view.outside[at] & ~beside_vehicles(view, side)[at]
    planes = [view.grey] if view.excess is None else [view.grey, view.excess]
    votes = [_step_votes(plane[at], seen) for plane in planes]
    weight = view.row_m[:, None] * seen
    means = [(vote * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 0.2 * (FAR_M - NEAR_M)) for vote in votes]
    plane = np.argmax(np.abs(means), axis=0)
    strength = np.minimum(np.max(np.abs(means), axis=0), MAX_MEAN_SIGMAS) ** 2
    inside = np.maximum.accumulate(np.where(WIDTHS_M > MIN_WIDTH_M, strength, 0.0))
    skip = round(INSIDE_M / LATTICE_M)
    score = STEP_EVIDENCE * (strength - np.concatenate([np.zeros(skip), inside[:-skip]]))
    near = (mask.x_m > NEAR_M) & (mask.x_m < FAR_M)
    row = np.searchsorted(view.x_m, mask.x_m[near])
    off_m = side * (mask.y_m[near] - bound_m[row]) / stretch[row]
    on_mask = np.exp(-0.5 * ((off_m[:, None] - WIDTHS_M) / np.maximum(mask.sigma_m[near], MASK_SIGMA_M)[:, None]) ** 2)
    score += MASK_EVIDENCE * np.minimum(mask.weight[near] @ on_mask / (FAR_M - NEAR_M), 1.0)
    score += np.log(np.exp(-0.5 * ((WIDTHS_M - WIDTH_M) / WIDTH_SIGMA_M) ** 2) + ANY_WIDTH)
    best = int(np.argmax(np.where(WIDTHS_M > MIN_WIDTH_M, score, -np.inf)))
    if score[best] < MIN_LOG_ODDS:
        return mask
    vote = votes[plane[best]] * np.sign(means[plane[best]][best])
    window = np.clip(np.arange(best - skip // 2, best + skip // 2 + 1), 0, len(WIDTHS_M) - 1)
    peak = window[np.argmax(vote[:, window], axis=1)]
    index = np.flatnonzero(vote[np.arange(len(vote)), peak] > MIN_VOTE_SIGMAS)
    return border_at(view, index, y_m[index, peak[index]], SIGMA_BORDER_M, SIGMA_BORDER_PX)


def _step_votes(values: Floats, seen: Bools) -> Floats:
    """(R, W) step between the STEP_M outside and the STEP_M inside of each cell, over the noise of the rows."""
    reach = round(STEP_M / LATTICE_M)
    total = np.cumsum(np.pad(np.where(seen, values, 0.0), ((0, 0), (reach + 1, reach))), axis=1)
    count = np.cumsum(np.pad(seen.astype(np.int64), ((0, 0), (reach + 1, reach))), axis=1)
    sums, counts = total[:, reach:] - total[:, :-reach], count[:, reach:] - count[:, :-reach]
    whole = (counts[:, reach:] == reach) & (counts[:, :-reach] == reach)
    step = np.where(whole, (sums[:, reach:] - sums[:, :-reach]) / reach, 0.0)[:, : values.shape[1]]
    noise = 1.4826 * np.median(np.abs(step[whole[:, : values.shape[1]]])) if whole.any() else 1.0
    out: Floats = np.clip(step / max(float(noise), MIN_GREY), -MAX_STEP_SIGMAS, MAX_STEP_SIGMAS)
    return out
