"""Lines of one image without a past: a road's lines are parallel, so that one shape serves all of them.

Each point votes for the offset at which a line of a given heading and curvature through it passes the ego, for many
headings and curvatures, and, where the camera's pitch is unknown, for many pitches. The shape whose votes are the most
concentrated is the road's (its histogram has the largest sum of squares): with a wrong pitch parallel lines fan out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import tilted
from birdslam.lanes.paint import LinePoints
from birdslam.lanes.road_view import HALF_WIDTH_M

BIN_M = 0.1
SEARCHED_M = 35.0  # a pitch or a hill bends lines beyond
HEADINGS = np.arange(-0.40, 0.4001, 0.0125)
CURVATURES = np.array([0.0, 0.001, 0.002, 0.004, 0.008, 0.014, 0.022])
CURVATURES = np.concatenate([-CURVATURES[:0:-1], CURVATURES])
PITCH_STEPS = 9  # from -2 to 2 sigma
SIGMA_HEADING_RAD = 0.15  # prior, of the road against the car
SIGMA_CURVATURE = 0.008
TURNS = np.arange(-0.10, 0.1001, 0.01)  # of one line against the others: lanes widen, narrow and part
SIGMA_TURN = 0.06
TAKEN_M = 0.3  # from a line: its points
PRIOR_SHARE = 0.05  # what a prior's sigma, squared, costs of the votes


@dataclass(frozen=True)
class Shape:
    """What parallel lines have in common, with the tilt that makes them parallel."""

    heading: float
    curvature_per_m: float
    tilt_rad: float  # to be added to the pitch that was assumed


@dataclass(frozen=True)
class Peak:
    """A line's offset at the ego, its heading, and its evidence in metres of road."""

    offset_m: float
    heading: float
    evidence_m: float


def find_shape(points: LinePoints, height_m: float, sigma_tilt_rad: float) -> Shape | None:
    """The shape that most points agree on; None where there are too few. `sigma_tilt_rad` 0: the pitch is known."""
    near = points.of((points.x_m < SEARCHED_M) & (points.weight > 0.0))
    if len(near) < 8:
        return None
    tilts = np.zeros(1) if sigma_tilt_rad == 0.0 else np.linspace(-2.0, 2.0, PITCH_STEPS) * sigma_tilt_rad
    best: tuple[float, Shape] | None = None
    weight = near.weight / np.hypot(1.0, near.sigma_m / BIN_M)
    bins = round(2.0 * HALF_WIDTH_M / BIN_M)
    heading, curvature = (grid.ravel() for grid in np.meshgrid(HEADINGS, CURVATURES))
    cost = (heading / SIGMA_HEADING_RAD) ** 2 + (curvature / SIGMA_CURVATURE) ** 2
    for tilt in tilts:
        x, y = tilted(near.x_m, near.y_m, height_m, float(tilt))
        offsets = y - np.outer(heading, x) - np.outer(curvature, 0.5 * x * x)  # (shapes, points)
        votes = _histograms(offsets, weight, bins)
        score = np.sqrt((votes**2).sum(axis=1))
        total = cost + (0.0 if tilt == 0.0 else (tilt / sigma_tilt_rad) ** 2)
        score *= np.exp(-PRIOR_SHARE * total)
        k = int(np.argmax(score))
        if best is None or score[k] > best[0]:
            best = float(score[k]), Shape(float(heading[k]), float(curvature[k]), float(tilt))
    return None if best is None else best[1]


def _histograms(offsets: Floats, weight: Floats, bins: int) -> Floats:
    """(S, bins) of offsets (S, N), smoothed over three bins."""
    shapes = len(offsets)
    cells = np.floor((offsets + HALF_WIDTH_M) / BIN_M).astype(np.int64)
    inside = (cells >= 0) & (cells < bins)
    flat = np.where(inside, cells, bins) + (bins + 1) * np.arange(shapes)[:, None]
    counted = np.bincount(flat.ravel(), np.broadcast_to(weight, offsets.shape).ravel(), shapes * (bins + 1))
    votes = counted.reshape(shapes, bins + 1)[:, :bins]
    smooth = 0.5 * votes
    smooth[:, 1:] += 0.25 * votes[:, :-1]
    smooth[:, :-1] += 0.25 * votes[:, 1:]
    return np.asarray(smooth, np.float64)


def find_lines(points: LinePoints, curve: Floats, least_m: float, apart_m: float, most: int) -> list[Peak]:
    """Lines of the curve's bend, nearly parallel to it, with at least `least_m` of evidence; the strongest first.

    One after the other: the points of a line do not vote again (a sequential Hough transform).
    """
    headings = curve[1] + TURNS
    trust = np.exp(-0.5 * (TURNS / SIGMA_TURN) ** 2)
    x, free = points.x_m, points.x_m < SEARCHED_M
    straight = points.y_m - x * x * (curve[2] / 2.0 + x * curve[3] / 6.0)
    weight = points.weight / np.hypot(1.0, points.sigma_m / BIN_M)
    bins = round(2.0 * HALF_WIDTH_M / BIN_M)
    found: list[Peak] = []
    while len(found) < most and np.any(free):
        offsets = straight[free] - np.outer(headings, x[free])
        votes = _histograms(offsets, weight[free], bins) * trust[:, None]
        k, column = np.unravel_index(int(np.argmax(votes)), votes.shape)
        offset = (float(column) + 0.5) * BIN_M - HALF_WIDTH_M
        gap = np.abs(straight - headings[k] * x - offset)
        own = free & (gap < TAKEN_M)
        evidence = float(points.weight[own].sum())
        if evidence < least_m:
            break
        free &= gap >= apart_m
        found.append(Peak(offset, float(headings[k]), evidence))
    return found
