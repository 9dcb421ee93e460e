"""Searches an image for parallel lines with a common shape, without a prediction.

A Hough transform: each point votes for the offset at the ego of a line with given heading and curvature and, if the
camera's pitch is unknown, pitch. The shape with the most concentrated histogram (largest sum of squares) wins: with a
wrong pitch parallel lines diverge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import tilted
from birdslam.lanes.paint import LinePoints
from birdslam.lanes.road_view import HALF_WIDTH_M

BIN_M = 0.1
MAX_SEARCH_M = 35.0  # errors of pitch and hills bend lines beyond
HEADINGS = np.arange(-0.40, 0.4001, 0.0125)
CURVATURES = np.array([0.0, 0.001, 0.002, 0.004, 0.008, 0.014, 0.022])
CURVATURES = np.concatenate([-CURVATURES[:0:-1], CURVATURES])
PITCH_STEPS = 9  # from -2 to 2 sigma
SIGMA_HEADING_RAD = 0.15  # prior of the road's heading against the car
SIGMA_CURVATURE = 0.008
HEADING_OFFSETS = np.arange(-0.10, 0.1001, 0.01)  # heading of one line against the others: lanes widen, narrow and part
SIGMA_HEADING_OFFSET = 0.06
MAX_POINT_DISTANCE_M = 0.3  # max. distance of a line's points
PRIOR_COST_RATIO = 0.05  # votes that one squared sigma of the prior costs


@dataclass(frozen=True)
class Shape:
    """The common shape of parallel lines, and the tilt that makes them parallel."""

    heading: float
    curvature_per_m: float
    tilt_rad: float  # correction of the assumed pitch


@dataclass(frozen=True)
class Peak:
    """A line's offset at the ego, its heading, and its evidence in metres of road."""

    offset_m: float
    heading: float
    evidence_m: float


def find_shape(points: LinePoints, height_m: float, sigma_tilt_rad: float) -> Shape | None:
    """Returns the shape with the most votes, None for too few points. `sigma_tilt_rad` 0: the pitch is known."""
    near = points.of((points.x_m < MAX_SEARCH_M) & (points.weight > 0.0))
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
        score *= np.exp(-PRIOR_COST_RATIO * total)
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


def find_lines(points: LinePoints, curve: Floats, min_m: float, spacing_m: float, max_lines: int) -> list[Peak]:
    """Returns lines nearly parallel to the curve with at least `min_m` of evidence, strongest first.

    A sequential Hough transform: the points of a found line do not vote again.
    """
    headings = curve[1] + HEADING_OFFSETS
    prior = np.exp(-0.5 * (HEADING_OFFSETS / SIGMA_HEADING_OFFSET) ** 2)
    x, free = points.x_m, points.x_m < MAX_SEARCH_M
    straight = points.y_m - x * x * (curve[2] / 2.0 + x * curve[3] / 6.0)
    weight = points.weight / np.hypot(1.0, points.sigma_m / BIN_M)
    bins = round(2.0 * HALF_WIDTH_M / BIN_M)
    found: list[Peak] = []
    while len(found) < max_lines and np.any(free):
        offsets = straight[free] - np.outer(headings, x[free])
        votes = _histograms(offsets, weight[free], bins) * prior[:, None]
        k, column = np.unravel_index(int(np.argmax(votes)), votes.shape)
        offset = (float(column) + 0.5) * BIN_M - HALF_WIDTH_M
        gap = np.abs(straight - headings[k] * x - offset)
        own = free & (gap < MAX_POINT_DISTANCE_M)
        evidence = float(points.weight[own].sum())
        if evidence < min_m:
            break
        free &= gap >= spacing_m
        found.append(Peak(offset, float(headings[k]), evidence))
    return found
