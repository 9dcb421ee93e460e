"""Lines after an update as records: predicted to the current ego, with kind, colour and probability of existence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import across_sigma_m, basis, transform_curves
from birdslam.lanes.line_filter import MAX_DISTANCE_M, MAX_SLOPE, Tilt
from birdslam.lanes.paint import MIN_YELLOW
from birdslam.types import LaneLine, LineColour, LineKind

PAINT, LEFT_EDGE, RIGHT_EDGE = 0, 1, 2  # classes of lines; points correct only lines of their class
EVIDENCE_M = 6.0  # paint that gives an existence of 1 - 1 / e
MAX_RANGE_M = 60.0  # max. prediction range of a line
MAX_SIGMA_M = 0.6  # max. lateral 1-sigma within the prediction range
SIGMA_HEIGHT_REL = 0.02  # of the camera's height (mapping.StaticMapConfig)
SIGMA_OFFSET_M = 0.025  # of the middle of the paint
MIN_SOLID_RATIO, MAX_DASHED_RATIO = 0.8, 0.6  # painted share of a line: minimum of a solid one, maximum of a dashed one
MIN_PAINTED_RATIO = 0.2  # of a dashed line; arrows and noise have less
MIN_DOUBLE_RATIO, MIN_RESOLVED = (
    0.5,
    3.0,
)  # min. share of rows with two stripes, and min. number of images: kerbs may show two

AHEAD_M = np.arange(5.0, MAX_RANGE_M + 1.0, 5.0)
AHEAD = basis(AHEAD_M)


class Track(msgspec.Struct):
    """Properties of a line other than its curve."""

    kind: int  # class of its points
    line: int = -1  # id, -1 until confirmed
    score: float = 0.0
    evidence_m: float = 0.0
    seen_from_m: float = 0.0  # in the filter's ego frame
    seen_to_m: float = 0.0
    painted: float = 0.0  # painted share, a running mean
    looks: float = 0.0  # weight of that mean
    yellow: float = 0.0
    coloured: float = 0.0
    double: float = 0.0  # share of rows with two stripes, a running mean
    resolved: float = 0.0


@dataclass(frozen=True)
class TrackedLines:
    """The lines after an update: tracks, curves (n, 4) and covariances (n, 4, 4) in the ego at `T_world_seen`."""

    T_world_seen: SE2
    tracks: tuple[Track, ...]
    curves: Floats
    covs: Floats
    tilt: Tilt  # of the road in their image against its ground
    height_m: float  # of its camera
    sigma_roll_rad: float  # of its ground
    road_from_m: float  # distance at which the road straight ahead enters the view
    vertical: VerticalCurvature | None = None  # of the road, from all images so far

    def at(self, T_world_ego: SE2) -> tuple[LaneLine, ...]:
        """The lines in the ego's frame at `T_world_ego`, transform_curves by the ego's motion, from left to right."""
        if not self.tracks:
            return ()
        step = self.T_world_seen.between(T_world_ego)
        curves, J = transform_curves(self.curves, step)
        covs = J @ self.covs @ J.transpose(0, 2, 1) + _systematic_covariance(curves, self.height_m, self.sigma_roll_rad)
        known = across_sigma_m(AHEAD[:, None], covs) < MAX_SIGMA_M  # (distances, lines)
        sure = known.any(axis=0) & np.isfinite(covs).all(axis=(1, 2))
        sure &= (np.abs(curves[:, 0]) <= MAX_DISTANCE_M) & (np.abs(curves[:, 1]) <= MAX_SLOPE)
        to_m = np.max(np.where(known, AHEAD_M[:, None], 0.0), axis=0)
        numbers = zip(self.tracks, curves.tolist(), covs.reshape(-1, 16).tolist(), to_m.tolist(), strict=True)
        out = [
            LaneLine(
                line=track.line,
                offset_m=a,
                slope=h,
                curvature_per_m=c,
                curvature_rate_per_m2=d,
                cov=tuple(cov),
                seen_from_m=track.seen_from_m - step.x_m,
                seen_to_m=track.seen_to_m - step.x_m,
                to_m=farthest_m,
                kind=_kind(track),
                colour=_colour(track),
                existence=existence_of(track),
            )
            for is_sure, (track, (a, h, c, d), cov, farthest_m) in zip(sure.tolist(), numbers, strict=True)
            if is_sure
        ]
        return tuple(sorted(out, key=lambda line: -line.y_m(8.0)))


def _systematic_covariance(curves: Floats, height_m: float, sigma_roll_rad: float) -> Floats:
    """(n, 4, 4) covariance of the camera's height, which scales a curve, and of its roll: common to all images.

    A roll shifts a point of the road at y by the height and y^2 over it (Eq. 1), most for outer lines.
    """
    a, h, c, d = curves.T
    by_height = np.stack([a, np.zeros(len(a)), -c, -2.0 * d], axis=1)
    by_roll = np.stack([a * a, 2.0 * a * h, 2.0 * (h * h + a * c), 6.0 * h * c + 2.0 * a * d], axis=1) / height_m
    by_roll[:, 0] += height_m
    out: Floats = SIGMA_HEIGHT_REL**2 * by_height[:, :, None] * by_height[:, None]
    out += sigma_roll_rad**2 * by_roll[:, :, None] * by_roll[:, None]
    out[:, 0, 0] += SIGMA_OFFSET_M**2
    return out


def existence_of(track: Track) -> float:
    """The probability that it is a line: from its paint and the painted share of the visible road."""
    existence = 1.0 - math.exp(-track.evidence_m / EVIDENCE_M)
    if track.kind != PAINT or not track.looks:
        return existence
    return existence * min(1.0, track.painted / MIN_PAINTED_RATIO)


def _kind(track: Track) -> LineKind:
    if track.kind != PAINT:
        return LineKind.EDGE
    if track.double > MIN_DOUBLE_RATIO and track.resolved >= MIN_RESOLVED:
        return LineKind.DOUBLE
    if track.looks < 1.0:
        return LineKind.UNKNOWN
    return (
        LineKind.SOLID
        if track.painted > MIN_SOLID_RATIO
        else LineKind.DASHED
        if track.painted < MAX_DASHED_RATIO
        else LineKind.UNKNOWN
    )


def _colour(track: Track) -> LineColour:
    if track.kind != PAINT or not track.coloured:
        return LineColour.UNKNOWN
    return LineColour.YELLOW if track.yellow > MIN_YELLOW else LineColour.WHITE
