"""The live estimates of labelled cars in the ego's frame: found or not, how far off, moving or not.

Unlike the paper's tables this needs no track to overlap a label in the image: a car is *found* where an estimate stands
within 20 % of its distance ahead and 1.5 m across. Asked for are cars that KITTI would ask for as moderate: 25 px or
more high, hardly occluded, not truncated. Whether one stands or drives is judged by its labels half a second before and
after, since a label jitters by some centimetres from frame to frame.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.bench.figures import median
from birdslam.bench.tracking.localisation import MEASURED_KIND, RANGES_M
from birdslam.bench.tracking.metrics import MIN_HEIGHT_PX, least_cost
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label
from birdslam.types import Estimate, VehicleEstimate

FOUND_AHEAD_REL, FOUND_ACROSS_M = 0.2, 1.5
MAX_OCCLUDED = 1  # KITTI: partly
HALF_SPAN = 5  # frames before and after, over which a label's speed is taken
STANDS_MPS, DRIVES_MPS = 0.5, 2.0  # by its labels; between them neither is asked for
REPORTED_DRIVING_MPS = 1.5  # of an estimate, as in the pictures
NEVER = 1e6  # cost of a pair that may not be


@dataclass(frozen=True)
class Sight:
    """One car that is asked for in one frame: what its label says, and the estimate that stands there, if any."""

    label: int
    x_m: float  # ahead of the ego
    velocity_mps: tuple[float, float] | None  # over the ground in the ego's axes; None at the ends of its labels
    error_m: tuple[float, float] | None = None  # ahead, across; None: not found
    reported_mps: tuple[float, float] | None = None
    reported_sigma_mps: float = 0.0  # 1-sigma of the reported speed


class RangeRow(msgspec.Struct, frozen=True, kw_only=True):
    """Cars asked for at one range, and how many were found; errors of the found ones, bias > 0 is too far."""

    sequence: str
    range: str
    asked: int
    found: int
    depth_error_median_rel: float | None = None
    depth_bias_median_rel: float | None = None
    across_error_median_m: float | None = None


class MotionRow(msgspec.Struct, frozen=True, kw_only=True):
    """Velocities of the found cars, and how many sights of standing (driving) ones were reported as driving (standing).

    `false_movers_sure` and `missed_movers_sure`: those whose speed is over or under the bar by twice its own sigma too.
    Of a vehicle just come into sight the covariance says that nothing is known of its speed yet.
    """

    sequence: str
    asked: int
    velocity_error_median_mps: float | None
    standing: int
    false_movers: int
    false_movers_sure: int
    driving: int
    missed_movers: int
    missed_movers_sure: int


def sights(sequence: TrackingSequence, estimates: Sequence[Estimate]) -> list[Sight]:
    """Every car that counts in the frames of the estimates; an estimate is that of one car at the most."""
    places: dict[int, dict[int, tuple[float, float]]] = defaultdict(dict)  # label -> frame -> x, y in the first world
    for label in sequence.labels:
        if label.kind == MEASURED_KIND:
            truth = sequence.vehicle_truth(label, 0)
            places[label.track][label.frame] = (truth.x_m, truth.y_m)
    egos, out = sequence.ego_truth(0), []
    for estimate in estimates:
        asked = [label for label in sequence.labels_of(estimate.frame_id) if is_asked_for(label)]
        yaw_rad = egos[estimate.frame_id].yaw_rad
        seen = [_sight(sequence, label, places[label.track], yaw_rad) for label in asked]
        out += _matched(sequence, asked, seen, estimate)
    return out


def is_asked_for(label: Label) -> bool:
    """Whether a car is high enough in the image, whole and open to view."""
    high = label.box_px[3] - label.box_px[1] >= MIN_HEIGHT_PX
    return label.kind == MEASURED_KIND and high and label.occluded <= MAX_OCCLUDED and label.truncated <= 0


def _sight(
    sequence: TrackingSequence, label: Label, places: dict[int, tuple[float, float]], ego_yaw_rad: float
) -> Sight:
    before, after = (places.get(label.frame + step) for step in (-HALF_SPAN, HALF_SPAN))
    velocity = None
    if before is not None and after is not None:
        span_s = 2 * HALF_SPAN / KITTI_RATE_HZ
        velocity = _turned((after[0] - before[0]) / span_s, (after[1] - before[1]) / span_s, -ego_yaw_rad)
    return Sight(label.track, sequence.vehicle_truth(label, label.frame).x_m, velocity)


def _matched(
    sequence: TrackingSequence, asked: Sequence[Label], seen: Sequence[Sight], estimate: Estimate
) -> list[Sight]:
    reported = [(v, estimate.T_world_ego.between(v.T_world_vehicle)) for v in estimate.vehicles]
    if not asked or not reported:
        return list(seen)
    truths = [sequence.vehicle_truth(label, label.frame) for label in asked]
    errors = np.array([[(p.x_m - t.x_m, p.y_m - t.y_m) for _, p in reported] for t in truths])
    ahead_m = np.maximum(np.array([[t.x_m] for t in truths]), 1e-3)
    may_be = (np.abs(errors[..., 0]) <= FOUND_AHEAD_REL * ahead_m) & (np.abs(errors[..., 1]) <= FOUND_ACROSS_M)
    distance = np.hypot(errors[..., 0] / (FOUND_AHEAD_REL * ahead_m), errors[..., 1] / FOUND_ACROSS_M)
    out = list(seen)
    for i, j in zip(*least_cost(np.where(may_be, distance, NEVER)), strict=True):
        if may_be[i, j]:
            out[i] = Sight(
                out[i].label,
                out[i].x_m,
                out[i].velocity_mps,
                (float(errors[i, j, 0]), float(errors[i, j, 1])),
                _velocity_in_ego(reported[j][0], estimate),
                _sigma_of_speed(reported[j][0]),
            )
    return out


def _velocity_in_ego(vehicle: VehicleEstimate, estimate: Estimate) -> tuple[float, float]:
    x, y = vehicle.velocity_mps
    return _turned(x, y, -estimate.T_world_ego.yaw_rad)


def _sigma_of_speed(vehicle: VehicleEstimate) -> float:
    """1-sigma along the velocity."""
    (x, y), cov = vehicle.velocity_mps, vehicle.velocity_cov
    speed = max(math.hypot(x, y), 1e-9)
    x, y = x / speed, y / speed
    return math.sqrt(max(x * x * cov[0] + x * y * (cov[1] + cov[2]) + y * y * cov[3], 0.0))


def _turned(x: float, y: float, by_rad: float) -> tuple[float, float]:
    c, s = math.cos(by_rad), math.sin(by_rad)
    return c * x - s * y, s * x + c * y


def range_rows(sequence: str, seen: Sequence[Sight]) -> list[RangeRow]:
    """A row for each range."""
    return [
        _range_row(sequence, f"{near:.0f}-{far:.0f}", [s for s in seen if near <= s.x_m < far])
        for near, far in RANGES_M
    ]


def _range_row(sequence: str, span: str, seen: Sequence[Sight]) -> RangeRow:
    errors = [(s.error_m[0] / s.x_m, s.error_m[1]) for s in seen if s.error_m is not None]
    if not errors:
        return RangeRow(sequence=sequence, range=span, asked=len(seen), found=0)
    along, across = np.array(errors).T
    return RangeRow(
        sequence=sequence,
        range=span,
        asked=len(seen),
        found=len(errors),
        depth_error_median_rel=float(np.median(np.abs(along))),
        depth_bias_median_rel=float(np.median(along)),
        across_error_median_m=float(np.median(np.abs(across))),
    )


def motion_row(sequence: str, seen: Sequence[Sight]) -> MotionRow:
    """Over all found cars whose label's speed is known."""
    known = [(s.velocity_mps, s.reported_mps, s.reported_sigma_mps) for s in seen]
    pairs = [(truth, reported, sigma) for truth, reported, sigma in known if truth is not None and reported is not None]
    errors = [math.dist(truth, reported) for truth, reported, _ in pairs]
    standing = [(math.hypot(*reported), sigma) for truth, reported, sigma in pairs if math.hypot(*truth) < STANDS_MPS]
    driving = [(math.hypot(*reported), sigma) for truth, reported, sigma in pairs if math.hypot(*truth) > DRIVES_MPS]
    return MotionRow(
        sequence=sequence,
        asked=len(pairs),
        velocity_error_median_mps=median(errors),
        standing=len(standing),
        false_movers=sum(speed > REPORTED_DRIVING_MPS for speed, _ in standing),
        false_movers_sure=sum(speed - 2.0 * sigma > REPORTED_DRIVING_MPS for speed, sigma in standing),
        driving=len(driving),
        missed_movers=sum(speed <= REPORTED_DRIVING_MPS for speed, _ in driving),
        missed_movers_sure=sum(speed + 2.0 * sigma <= REPORTED_DRIVING_MPS for speed, sigma in driving),
    )
