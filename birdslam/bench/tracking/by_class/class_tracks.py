"""Tracks of each class against labels, in bird's-eye view and in the image.

In bird's-eye view the similarity of a track and a label falls from 1 at the label's place to 0.5 at 2 m, so that CLEAR
MOT and IDF1 match within 2 m (as nuScenes does) and HOTA averages over all thresholds; in the image it is the IoU of
boxes, matched at 0.5. Tracks are those in sight, as a planner takes them: a lost one goes on for a while, but not for
these metrics. What counts is KITTI's: heavily occluded or truncated labels are not asked for, DontCare regions and
neighbouring classes are neutral, and so are unmatched tracks lower than 25 px.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from birdslam.bench.tracking.metrics import MIN_HEIGHT_PX, BoxFrame, assign, hota_parts, identities, mostly_inside
from birdslam.geometry.arrays import Floats, Ints
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import DONT_CARE, Label
from birdslam.types import IN_SIGHT_NS, Measurements
from birdslam.vehicles.placement.localisation import iou

KINDS = {"car": ("Car",), "pedestrian": ("Pedestrian",), "cyclist": ("Cyclist",)}  # of the labels
NEUTRAL = {
    "car": ("Van", "Truck"),
    "pedestrian": ("Person", "Person_sitting", "Cyclist"),
    "cyclist": ("Pedestrian", "Person", "Person_sitting"),
}
HALF_AT_M = 2.0  # where similarity in bird's-eye view is 0.5
METRES, IMAGE = "metres", "image"


@dataclass(frozen=True)
class Followed:
    """Who is followed in one frame: ids (N,), places in ego (N, 2) and boxes (N, 4)."""

    ids: Ints
    at_m: Floats
    boxes_px: Floats


@dataclass
class ClassTracks:
    """Of one class in one sequence: its frames in both views."""

    kind: str
    sequence: str
    views: dict[str, list[BoxFrame]] = field(default_factory=lambda: {METRES: [], IMAGE: []})


class TracksRow(msgspec.Struct, frozen=True, kw_only=True):
    """A row of report.json: how good the tracks of a class are in a view."""

    kind: str
    view: str  # metres: within 2 m; image: by an IoU of 0.5
    sequence: str
    labels: int  # bodies times frames
    hota: float
    det_a: float
    ass_a: float
    loc_a: float
    idf1: float
    mota: float
    switches: int
    switches_per_minute: float


def followed(measurements: Measurements, kind: str) -> Followed:
    """Those of a class that a frame's record says are in sight."""
    if kind == "car":
        edges = measurements.cv
        ids, at, boxes = (
            [e.vehicle for e in edges],
            [(e.T_ego_vehicle.x_m, e.T_ego_vehicle.y_m) for e in edges],
            [e.box_px for e in edges],
        )
    else:
        people = [p for p in measurements.people if p.label == kind and p.age_ns <= IN_SIGHT_NS]
        ids, at, boxes = [p.person for p in people], [(p.x_m, p.y_m) for p in people], [p.box_px for p in people]
    return Followed(np.array(ids, dtype=np.int64), np.reshape(at, (-1, 2)), np.reshape(boxes, (-1, 4)))


def class_tracks(sequence: TrackingSequence, measurements: Iterable[Measurements], kind: str) -> ClassTracks:
    """What records say of a class in every frame, beside the labels."""
    out = ClassTracks(kind, sequence.name)
    for m in measurements:
        here, tracks = sequence.labels_of(m.frame_id), followed(m, kind)
        for view, similarity in SIMILARITIES.items():
            out.views[view].append(_frame(sequence, here, tracks, kind, similarity))
    return out


def _by_place(sequence: TrackingSequence, labels: Sequence[Label], tracks: Followed) -> Floats:
    truth = [sequence.vehicle_truth(label, label.frame) for label in labels]
    places = np.array([[t.x_m, t.y_m] for t in truth]).reshape(-1, 2)
    away = np.linalg.norm(places[:, None] - tracks.at_m[None], axis=-1)
    return np.asarray(np.maximum(0.0, 1.0 - away / (2.0 * HALF_AT_M)))


def _by_box(_: TrackingSequence, labels: Sequence[Label], tracks: Followed) -> Floats:
    return iou(np.array([label.box_px for label in labels]).reshape(-1, 4), tracks.boxes_px)


SIMILARITIES: dict[str, Callable[[TrackingSequence, Sequence[Label], Followed], Floats]] = {
    METRES: _by_place,
    IMAGE: _by_box,
}


def _frame(
    sequence: TrackingSequence,
    here: Sequence[Label],
    tracks: Followed,
    kind: str,
    similarity_of: Callable[[TrackingSequence, Sequence[Label], Followed], Floats],
) -> BoxFrame:
    """Similarities of labels and tracks; left out is who is followed where a label is that nobody asks for."""
    near = [label for label in here if label.kind in (*KINDS[kind], *NEUTRAL[kind])]
    similarity = similarity_of(sequence, near, tracks)
    asked = np.array([n.kind in KINDS[kind] and n.occluded <= 2 and n.truncated <= 0 for n in near], dtype=np.bool_)
    matched = {int(j): bool(asked[i]) for i, j in zip(*assign(similarity), strict=True)}
    regions = np.array([label.box_px for label in here if label.kind == DONT_CARE]).reshape(-1, 4)
    counts = [
        matched[j] if j in matched else box[3] - box[1] > MIN_HEIGHT_PX and not mostly_inside(box, regions)
        for j, box in enumerate(tracks.boxes_px)
    ]
    kept = np.array(counts, dtype=np.bool_)
    labels = np.array([n.track for n, a in zip(near, asked, strict=True) if a], dtype=np.int64)
    return BoxFrame(labels, tracks.ids[kept], similarity[asked][:, kept])


def tracks_row(name: str, view: str, group: Sequence[ClassTracks]) -> TracksRow:
    """Of several sequences: their frames one after the other, nobody in two of them."""
    frames = [
        replace(f, labels=f.labels + (k << 32), tracks=f.tracks + (k << 32))
        for k, of in enumerate(group)
        for f in of.views[view]
    ]
    parts, clear = hota_parts(frames), identities(frames)
    minutes = len(frames) / KITTI_RATE_HZ / 60.0
    return TracksRow(
        kind=group[0].kind,
        view=view,
        sequence=name,
        labels=sum(len(f.labels) for f in frames),
        hota=0.0 if parts is None else parts.hota,
        det_a=0.0 if parts is None else parts.det_a,
        ass_a=0.0 if parts is None else parts.ass_a,
        loc_a=0.0 if parts is None else parts.loc_a,
        idf1=clear.idf1,
        mota=clear.mota,
        switches=clear.switches,
        switches_per_minute=clear.switches / max(minutes, 1e-9),
    )


def table_of_tracks(rows: Sequence[TracksRow]) -> str:
    """For a person."""
    titles = "".join(f"{title:>9}" for title in ("labels", "HOTA", "DetA", "AssA", "LocA", "IDF1", "MOTA"))
    lines = [f"{'class':12}{'view':8}{'sequence':11}{titles}{'switches':>10}{'a minute':>10}"]
    for row in rows:
        shares = (row.hota, row.det_a, row.ass_a, row.loc_a, row.idf1, row.mota)
        numbers = "".join(f"{share:9.3f}" for share in shares)
        where = f"{row.kind:12}{row.view:8}{row.sequence:11}"
        lines.append(f"{where}{row.labels:9}{numbers}{row.switches:10}{row.switches_per_minute:10.1f}")
    return "\n".join(lines)
