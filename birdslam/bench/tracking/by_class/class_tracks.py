"""Tracks of pedestrians and cyclists against labels, in bird's-eye view.

The similarity of a track and a label falls from 1 at the position of the label to 0.5 at 2 m, so that CLEAR MOT and
IDF1 match within 2 m (as nuScenes does) and HOTA averages over all thresholds. Tracks are those in sight. KITTI's rules
apply: heavily occluded or truncated labels are not asked for; DontCare regions, neighbouring classes and unmatched
tracks lower than 25 px are neutral.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from birdslam.bench.tracking.metrics import MIN_HEIGHT_PX, BoxFrame, assign, hota, identities, mostly_inside
from birdslam.geometry.arrays import Floats
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import DONT_CARE, Label
from birdslam.types import IN_SIGHT_NS, FollowedPerson, Measurements

KINDS = {"pedestrian": ("Pedestrian",), "cyclist": ("Cyclist",)}  # of the labels
NEUTRAL = {
    "pedestrian": ("Person", "Person_sitting", "Cyclist"),
    "cyclist": ("Pedestrian", "Person", "Person_sitting"),
}
HALF_AT_M = 2.0  # distance with a similarity of 0.5


class TracksRow(msgspec.Struct, frozen=True, kw_only=True):
    """A row of report.json: the quality of the tracks of a class."""

    kind: str
    sequence: str
    labels: int  # bodies times frames
    hota: float
    idf1: float
    mota: float
    switches: int


def class_tracks(sequence: TrackingSequence, measurements: Iterable[Measurements], kind: str) -> list[BoxFrame]:
    """Compares the tracks of a class with the labels, frame by frame."""
    return [
        _frame(
            sequence,
            sequence.labels_of(m.frame_id),
            [p for p in m.people if p.label == kind and p.age_ns <= IN_SIGHT_NS],
            kind,
        )
        for m in measurements
    ]


def _frame(sequence: TrackingSequence, here: Sequence[Label], tracks: Sequence[FollowedPerson], kind: str) -> BoxFrame:
    near = [label for label in here if label.kind in (*KINDS[kind], *NEUTRAL[kind])]
    similarity = _similarity(sequence, near, tracks)
    asked = np.array([n.kind in KINDS[kind] and n.occluded <= 2 and n.truncated <= 0 for n in near], dtype=np.bool_)
    matched = {int(j): bool(asked[i]) for i, j in zip(*assign(similarity), strict=True)}
    regions = np.array([label.box_px for label in here if label.kind == DONT_CARE]).reshape(-1, 4)
    boxes = np.array([p.box_px for p in tracks]).reshape(-1, 4)
    counts = [
        matched[j] if j in matched else box[3] - box[1] > MIN_HEIGHT_PX and not mostly_inside(box, regions)
        for j, box in enumerate(boxes)
    ]
    kept = np.array(counts, dtype=np.bool_)
    labels = np.array([n.track for n, a in zip(near, asked, strict=True) if a], dtype=np.int64)
    ids = np.array([p.person for p in tracks], dtype=np.int64)
    return BoxFrame(labels, ids[kept], similarity[asked][:, kept])


def _similarity(sequence: TrackingSequence, labels: Sequence[Label], tracks: Sequence[FollowedPerson]) -> Floats:
    truth = [sequence.vehicle_truth(label, label.frame) for label in labels]
    places = np.array([[t.x_m, t.y_m] for t in truth]).reshape(-1, 2)
    at = np.array([(p.x_m, p.y_m) for p in tracks]).reshape(-1, 2)
    away = np.linalg.norm(places[:, None] - at[None], axis=-1)
    return np.asarray(np.maximum(0.0, 1.0 - away / (2.0 * HALF_AT_M)))


def tracks_row(name: str, kind: str, sequences: Sequence[Sequence[BoxFrame]]) -> TracksRow:
    """Evaluates the frames of several sequences together; no id is in two of them."""
    frames = [
        replace(f, labels=f.labels + (k << 32), tracks=f.tracks + (k << 32))
        for k, of in enumerate(sequences)
        for f in of
    ]
    clear = identities(frames)
    return TracksRow(
        kind=kind,
        sequence=name,
        labels=sum(len(f.labels) for f in frames),
        hota=hota(frames) or 0.0,
        idf1=clear.idf1,
        mota=clear.mota,
        switches=clear.switches,
    )
