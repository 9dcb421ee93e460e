"""Lines after an update, as records: moved to where the ego is since, with what they are and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import basis, moved
from birdslam.lanes.line_filter import FARTHEST_M, STEEPEST
from birdslam.types import LaneLine, LineColour, LineKind

PAINT, LEFT_EDGE, RIGHT_EDGE = 0, 1, 2  # classes of lines: each is seen by points of its own
EVIDENCE_M = 6.0  # metres of paint that make a line three to two
TO_M = 60.0  # to which a line is predicted at the most
WORST_SIGMA_M = 0.6  # to which range a line is predicted
SIGMA_HEIGHT_REL = 0.02  # of the camera's height, as of landmarks (mapping.StaticMapConfig)
SIGMA_OFFSET_M = 0.025  # of the paint's middle
SOLID, DASHED = 0.8, 0.6  # share of a line that is painted
LEAST_PAINTED = 0.2  # of a dashed line; less of it is an arrow, or a scrap
DOUBLE, LEAST_RESOLVED = 0.5, 3.0  # share of two stripes of a double line, over so many images: kerbs may show two
YELLOW = 25.0  # excess of yellow over the road's

AHEAD_M = np.arange(5.0, TO_M + 1.0, 5.0)
AHEAD = basis(AHEAD_M)


class Track(msgspec.Struct):
    """What is known of a line beside its curve."""

    kind: int  # class of its points
    line: int = -1  # its id, once it is sure
    score: float = 0.0
    evidence_m: float = 0.0
    seen_from_m: float = 0.0  # in the filter's ego frame
    seen_to_m: float = 0.0
    painted: float = 0.0  # share, a running mean
    looks: float = 0.0  # weight of that mean
    yellow: float = 0.0
    coloured: float = 0.0
    double: float = 0.0  # share of what the image resolves that two stripes make, a running mean
    resolved: float = 0.0


@dataclass(frozen=True)
class TrackedLines:
    """The lines after an update: tracks, curves (n, 4) and covariances (4, 4) in the ego at `T_world_seen`."""

    T_world_seen: SE2
    tracks: tuple[Track, ...]
    curves: Floats
    covs: tuple[Floats, ...]
    tilt_rad: float  # of their image against its pitch
    height_m: float  # of its camera
    sigma_roll_rad: float  # of its ground
    road_from_m: float  # where the road straight ahead begins to be in its view

    def at(self, T_world_ego: SE2) -> tuple[LaneLine, ...]:
        """The lines in the ego's frame at `T_world_ego`, moved by the ego's motion, from left to right."""
        step, out = self.T_world_seen.between(T_world_ego), []
        for track, seen, seen_cov in zip(self.tracks, self.curves, self.covs, strict=True):
            curve, J = moved(seen, step)
            cov = J @ seen_cov @ J.T + _systematic(curve, self.height_m, self.sigma_roll_rad)
            sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", AHEAD, cov, AHEAD), 0.0))
            known = AHEAD_M[sigma < WORST_SIGMA_M]
            if not len(known) or not np.isfinite(cov).all() or abs(curve[0]) > FARTHEST_M or abs(curve[1]) > STEEPEST:
                continue
            line = LaneLine(
                line=track.line,
                offset_m=float(curve[0]),
                slope=float(curve[1]),
                curvature_per_m=float(curve[2]),
                curvature_rate_per_m2=float(curve[3]),
                cov=tuple(cov.ravel().tolist()),
                seen_from_m=track.seen_from_m - step.x_m,
                seen_to_m=track.seen_to_m - step.x_m,
                to_m=float(known[-1]),
                kind=_kind(track),
                colour=_colour(track),
                existence=existence_of(track),
            )
            out.append(line)
        return tuple(sorted(out, key=lambda line: -line.y_m(8.0)))


def _systematic(curve: Floats, height_m: float, sigma_roll_rad: float) -> Floats:
    """(4, 4) what no number of images lessens: errors of the camera's height, which scales a curve, and of its roll.

    A roll moves a point of the road at y sideways by the height and y^2 over it (Eq. 1): outer lines most.
    """
    a, h, c, d = curve.tolist()
    by_height = np.array([a, 0.0, -c, -2.0 * d])
    by_roll = np.array([a * a, 2.0 * a * h, 2.0 * (h * h + a * c), 6.0 * h * c + 2.0 * a * d]) / height_m
    by_roll[0] += height_m
    out: Floats = SIGMA_HEIGHT_REL**2 * np.outer(by_height, by_height) + sigma_roll_rad**2 * np.outer(by_roll, by_roll)
    out[0, 0] += SIGMA_OFFSET_M**2
    return out


def existence_of(track: Track) -> float:
    """The probability that it is a line: by its paint, and by how little of the road in view has none."""
    existence = 1.0 - math.exp(-track.evidence_m / EVIDENCE_M)
    if track.kind != PAINT or not track.looks:
        return existence
    return existence * min(1.0, track.painted / LEAST_PAINTED)


def _kind(track: Track) -> LineKind:
    if track.kind != PAINT:
        return LineKind.EDGE
    if track.double > DOUBLE and track.resolved >= LEAST_RESOLVED:
        return LineKind.DOUBLE
    if track.looks < 1.0:
        return LineKind.UNKNOWN
    return LineKind.SOLID if track.painted > SOLID else LineKind.DASHED if track.painted < DASHED else LineKind.UNKNOWN


def _colour(track: Track) -> LineColour:
    if track.kind != PAINT or not track.coloured:
        return LineColour.UNKNOWN
    return LineColour.YELLOW if track.yellow > YELLOW else LineColour.WHITE
