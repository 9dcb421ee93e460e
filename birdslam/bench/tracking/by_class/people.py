"""How well people are placed and followed on real roads: the front end's people against labelled ones.

Each matched, untruncated person's place is compared with the label's as cars' are (localisation.py): along (depth,
ego's x) and across, with the share of errors inside the ellipses of 68.3 and 95.4 %. Speeds are compared with those of
the labels' places over a second. Tracks are judged in bird's-eye view (class_tracks.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from birdslam.bench.tracking.by_class.class_tracks import KINDS, TracksRow, class_tracks, tracks_row
from birdslam.bench.tracking.localisation import PlaceError, PlacesRow, summarise_ranges
from birdslam.bench.tracking.metrics import BoxFrame, assign
from birdslam.geometry.arrays import Floats
from birdslam.perception import Detections
from birdslam.road_users.placement.localisation import iou
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label, hull_px
from birdslam.types import FollowedPerson, Measurements

PEOPLE = ("pedestrian", "cyclist")
RANGES_M = ((5.0, 15.0), (15.0, 30.0), (30.0, 50.0))
TRUTH_S = 0.5  # a label's speed is its places' of so long before and after
MATCH_IOU = 0.4  # of a box with the label's, in the image
HULL_SIGMA = (0.035, 0.035, 0.035, 0.03)  # of RRC's boxes of people, left, upper, right, lower, of the height
HULL_MEMORY = 0.7  # of a box's error, from frame to frame at 10 Hz


@dataclass
class PeopleResult:
    """Of one sequence."""

    name: str
    kind: str
    tracked: list[BoxFrame]
    errors: list[PlaceError] = field(default_factory=list)


def has_labels(sequence: TrackingSequence, kind: str) -> bool:
    """Whether somebody of the kind is labelled."""
    return any(label.kind in KINDS[kind] for label in sequence.labels)


def boxes_of_hulls(sequence: TrackingSequence, recorded: Sequence[Detections], kind: str) -> list[Detections]:
    """Boxes for whom no detector's were recorded: the outlines of labelled bodies, with noise as real boxes show.

    Errors last from frame to frame (HULL_MEMORY). Recorded boxes of persons on the same body make way.
    """
    rng, errors, out = np.random.default_rng(0), dict[int, Floats](), []
    for frame, found in enumerate(recorded):
        boxes = []
        for label in sequence.labels_of(frame):
            if label.kind not in KINDS[kind] or label.occluded > 2:
                continue
            hull = hull_px(label, sequence.camera, sequence.T_cam0_camera)
            if hull is None:
                continue
            draw = rng.normal(size=4) * HULL_SIGMA
            last = errors.get(label.track)
            error = draw if last is None else HULL_MEMORY * last + math.sqrt(1.0 - HULL_MEMORY**2) * draw
            errors[label.track] = error
            box = hull + error * (hull[3] - hull[1])
            box = np.clip(box, 0.0, [sequence.camera.width_px, sequence.camera.height_px] * 2)
            if (box[2:] - box[:2] >= 4.0).all():
                boxes.append(box)
        hulls = np.array(boxes).reshape(-1, 4)
        keep = [
            i
            for i, label in enumerate(found.labels)
            if label != "person" or not len(hulls) or iou(found.boxes_px[i : i + 1], hulls).max() < MATCH_IOU
        ]
        out.append(
            replace(
                found,
                boxes_px=np.vstack([hulls, found.boxes_px[keep]]),
                scores=np.concatenate([np.full(len(hulls), 0.85), found.scores[keep]]),
                labels=("cyclist",) * len(hulls) + tuple(found.labels[i] for i in keep),
            )
        )
    return out


def judge(sequence: TrackingSequence, measurements: Iterable[Measurements], kind: str) -> PeopleResult:
    """What the records say of the people of a kind, in every frame, against the labels."""
    measurements = list(measurements)
    result = PeopleResult(sequence.name, kind, class_tracks(sequence, measurements, kind))
    places = _true_places(sequence, KINDS[kind])
    for m in measurements:
        here = sequence.labels_of(m.frame_id)
        asked = [label for label in here if label.kind in KINDS[kind]]
        tracks = [p for p in m.people if p.label == kind]
        seen = [p for p in tracks if p.age_ns == 0]
        overlap = iou(
            np.array([a.box_px for a in asked]).reshape(-1, 4), np.array([p.box_px for p in seen]).reshape(-1, 4)
        )
        for i, j in zip(*assign(overlap, MATCH_IOU), strict=True):
            if asked[i].truncated <= 0:
                result.errors.append(_error(sequence, asked[i], seen[j], places))
    return result


def _true_places(sequence: TrackingSequence, kinds: Sequence[str]) -> dict[int, dict[int, Floats]]:
    out: dict[int, dict[int, Floats]] = {}
    for label in sequence.labels:
        if label.kind in kinds:
            truth = sequence.vehicle_truth(label, 0)
            out.setdefault(label.track, {})[label.frame] = np.array([truth.x_m, truth.y_m])
    return out


def _true_velocity(places: dict[int, Floats], frame: int) -> Floats:
    """(2,) m/s in world: the slope of the places of a second around the frame; NaN where there are too few."""
    reach = round(TRUTH_S * 10)
    near = [(f - frame) * 0.1 for f in range(frame - reach, frame + reach + 1) if f in places]
    if len(near) < 4:
        return np.full(2, np.nan)
    at = np.array([places[frame + round(t * 10)] for t in near])
    return np.asarray(np.polyfit(near, at, 1)[0])


def _error(
    sequence: TrackingSequence, label: Label, person: FollowedPerson, places: dict[int, dict[int, Floats]]
) -> PlaceError:
    truth = sequence.vehicle_truth(label, label.frame)
    error = np.array([person.x_m - truth.x_m, person.y_m - truth.y_m])
    R = sequence.ego_truth(0)[label.frame].rotation()
    return PlaceError(
        sequence=sequence.name,
        frame=label.frame,
        label=label.track,
        depth_m=truth.x_m,
        error_m=error,
        mahalanobis2=float(error @ np.linalg.solve(np.reshape(person.cov, (2, 2)), error)),
        velocities_mps=(_true_velocity(places[label.track], label.frame) @ R, np.array([person.vx_mps, person.vy_mps])),
    )


def summarise_people(results: Sequence[PeopleResult]) -> tuple[list[PlacesRow], list[TracksRow]]:
    """Returns rows of positions by range and of tracks, for each sequence and for all."""
    results = [result for result in results if result.errors]
    rows = summarise_ranges([error for result in results for error in result.errors], RANGES_M)
    groups = [(result.name, [result]) for result in results] + [("all", results)]
    return rows, [tracks_row(name, group[0].kind, [r.tracked for r in group]) for name, group in groups if group]
