"""Which tracks of standing vehicles are reported to drive, and how soon those of driving ones are.

A track is one of our ids on one label, by the boxes' overlap. Whether it stands or drives is judged by its labels half
a second before and after. It is reported to drive where an estimate says so with a speed that shows in a picture.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from birdslam.bench.tracking.metrics import match_vehicles
from birdslam.bench.tracking.reported import DRIVES_MPS, HALF_SPAN, REPORTED_DRIVING_MPS, STANDS_MPS
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence
from birdslam.types import Estimate, Measurements, Moves, VehicleEstimate

MIN_SIGHTS = 5  # of a known speed: a track of fewer is not judged
SOON_S = 1.0

Sight = tuple[int, float, VehicleEstimate]  # frame, true speed over the ground in m/s, and what was estimated


class FalseMover(msgspec.Struct, frozen=True, kw_only=True):
    """A standing vehicle at the first sight at which it was reported to drive."""

    vehicle: int
    label: int
    frame: int
    x_m: float  # ahead of the ego
    y_m: float
    reported_mps: float
    sights: int  # at which it was reported so


class MoversRow(msgspec.Struct, frozen=True, kw_only=True):
    """Tracks of one sequence. `soon`: reported to drive within SOON_S of the first sight of it driving."""

    sequence: str
    odometry: str
    standing: int
    false: tuple[FalseMover, ...]
    driving: int
    reported: int
    soon: int


def movers_row(
    sequence: TrackingSequence, log: Iterable[Measurements], estimates: Iterable[Estimate], odometry: str
) -> MoversRow:
    """Of a log and the estimates after each of its records."""
    speeds = label_speeds_mps(sequence)
    sights: dict[tuple[int, int], list[Sight]] = defaultdict(list)
    for record, estimate in zip(log, estimates, strict=True):
        by_id = {vehicle.vehicle: vehicle for vehicle in estimate.vehicles}
        edges = {edge.vehicle: edge for edge in record.cv if edge.vehicle in by_id}
        boxes = np.array([edge.box_px for edge in edges.values()]).reshape(-1, 4)
        pairs = match_vehicles(sequence.labels_of(record.frame_id), list(edges), boxes)
        for label, vehicle in pairs.items():
            if (label, record.frame_id) in speeds:
                seen = record.frame_id, speeds[label, record.frame_id], by_id[vehicle]
                sights[vehicle, label].append(seen)
    standing = {key: seen for key, seen in sights.items() if len(seen) >= MIN_SIGHTS and stands(seen)}
    found = [_false_mover(sequence, *key, seen) for key, seen in standing.items()]
    delays = [delay_s(seen, KITTI_RATE_HZ) for seen in sights.values() if len(seen) >= MIN_SIGHTS]
    driving = [delay for delay in delays if delay is not None]
    return MoversRow(
        sequence=sequence.name,
        odometry=odometry,
        standing=len(standing),
        false=tuple(one for one in found if one is not None),
        driving=len(driving),
        reported=sum(math.isfinite(delay) for delay in driving),
        soon=sum(delay <= SOON_S for delay in driving),
    )


def movers_of_draws(rows: Sequence[MoversRow]) -> MoversRow:
    """The tracks of all draws of one sequence together."""
    counts = {name: sum(getattr(row, name) for row in rows) for name in ("standing", "driving", "reported", "soon")}
    return msgspec.structs.replace(rows[0], false=tuple(one for row in rows for one in row.false), **counts)


def label_speeds_mps(sequence: TrackingSequence) -> dict[tuple[int, int], float]:
    """Over the ground, by (label, frame); labels jitter by centimetres, so that it is over HALF_SPAN both ways."""
    places = {
        (label.track, label.frame): sequence.vehicle_truth(label, 0)
        for label in sequence.labels
        if label.kind in VEHICLE_KINDS
    }
    out = {}
    for track, frame in places:
        before, after = places.get((track, frame - HALF_SPAN)), places.get((track, frame + HALF_SPAN))
        if before is not None and after is not None:
            way_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
            out[track, frame] = way_m * KITTI_RATE_HZ / (2 * HALF_SPAN)
    return out


def is_reported_driving(vehicle: VehicleEstimate) -> bool:
    return vehicle.moves is Moves.DRIVING and math.hypot(*vehicle.velocity_mps) > REPORTED_DRIVING_MPS


def stands(seen: Sequence[Sight]) -> bool:
    """Whether the vehicle of a track's sights stands in all of them."""
    return all(speed < STANDS_MPS for _, speed, _ in seen)


def _false_mover(sequence: TrackingSequence, vehicle: int, label: int, seen: Sequence[Sight]) -> FalseMover | None:
    reported = [(frame, estimate) for frame, _, estimate in seen if is_reported_driving(estimate)]
    if not reported:
        return None
    frame, estimate = reported[0]
    (truth,) = [one for one in sequence.labels_of(frame) if one.track == label]
    at = sequence.vehicle_truth(truth, frame)
    return FalseMover(
        vehicle=vehicle,
        label=label,
        frame=frame,
        x_m=at.x_m,
        y_m=at.y_m,
        reported_mps=math.hypot(*estimate.velocity_mps),
        sights=len(reported),
    )


def delay_s(seen: Sequence[Sight], rate_hz: float) -> float | None:
    """From the first sight of it driving until it is reported so, inf: never; None: it never drove for as long."""
    drives = [frame for frame, speed, _ in seen if speed > DRIVES_MPS]
    if len(drives) < SOON_S * rate_hz:
        return None
    reported = [frame for frame, _, estimate in seen if frame >= drives[0] and is_reported_driving(estimate)]
    return (reported[0] - drives[0]) / rate_hz if reported else math.inf
