"""How good tracks are: boxes matched to labels, HOTA and IDF1 in the image, ATE, RPE and motion in bird's-eye view.

HOTA is Luiten et al. (IJCV 2021), IDF1 Ristani et al. (ECCVW 2016), both with TrackEval's formulas and KITTI's rules of
what counts (`count_boxes`); CLEAR MOT is motmetrics'. The paper's ATE is the root mean square of a body's position
errors in the global SE(2) frame, nothing aligned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.bench.ego.trajectory_errors import rms
from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.planar import between
from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti_tracking import VEHICLE_KINDS
from birdslam.sources.label_projection import Label
from birdslam.sources.recording import DatasetError
from birdslam.vehicles.placement.localisation import iou

MATCH_IOU = 0.5
HOTA_IOU = np.arange(0.05, 0.99, 0.05)
MIN_HEIGHT_PX = 25.0  # KITTI: lower boxes are no false alarms
COUNTED_KIND = "Car"


@dataclass(frozen=True)
class BoxFrame:
    """One frame's labelled and tracked boxes: ids (G,) and (T,), and their IoU (G, T)."""

    labels: Ints
    tracks: Ints
    overlap: Floats


def least_cost(cost: Floats) -> tuple[Ints, Ints]:
    """Rows and columns of the pairs of least total cost."""
    from scipy.optimize import linear_sum_assignment  # only here: the supervisor of a drive would hold its 9 MB

    rows, columns = linear_sum_assignment(cost)
    return rows, columns


def assign(overlap: Floats, least: float = MATCH_IOU) -> tuple[Ints, Ints]:
    """Rows and columns of the pairs of greatest total overlap, each at least `least`."""
    rows, columns = least_cost(-np.where(overlap >= least, overlap, 0.0))
    keep = overlap[rows, columns] >= least
    return rows[keep].astype(np.int64), columns[keep].astype(np.int64)


def match_vehicles(labels: Sequence[Label], tracks: Sequence[int], boxes_px: Floats) -> dict[int, int]:
    """Label's id -> track's id of one frame, by image overlap."""
    vehicles = [label for label in labels if label.kind in VEHICLE_KINDS]
    if not vehicles or not tracks:
        return {}
    rows, columns = assign(iou(np.array([label.box_px for label in vehicles]), boxes_px))
    return {vehicles[i].track: tracks[j] for i, j in zip(rows, columns, strict=True)}


def count_boxes(labels: Sequence[Label], tracks: Sequence[int], boxes_px: Floats) -> BoxFrame:
    """What counts of a frame by KITTI's rules for cars.

    Tracks on vans and trucks, those in a DontCare region and unmatched ones lower than 25 px are left out; labels that
    are heavily occluded or truncated are not asked for.
    """
    boxes_px = np.reshape(boxes_px, (-1, 4))
    vehicles = [label for label in labels if label.kind in VEHICLE_KINDS]
    overlap = iou(np.array([label.box_px for label in vehicles]).reshape(-1, 4), boxes_px)
    asked = np.array(
        [v.kind == COUNTED_KIND and v.occluded <= 2 and v.truncated <= 0 for v in vehicles], dtype=np.bool_
    )
    rows, columns = assign(overlap)
    matched = dict(zip(columns.tolist(), rows.tolist(), strict=True))
    regions = np.array([label.box_px for label in labels if label.kind == "DontCare"]).reshape(-1, 4)
    keep = []
    for j, box in enumerate(boxes_px):
        if j in matched:
            keep.append(bool(asked[matched[j]]))
        else:
            keep.append(box[3] - box[1] > MIN_HEIGHT_PX and not mostly_inside(box, regions))
    ids = np.array(tracks, dtype=np.int64).reshape(-1)
    names = np.array([label.track for label in vehicles], dtype=np.int64).reshape(-1)
    kept = np.array(keep, dtype=np.bool_)
    return BoxFrame(names[asked], ids[kept], overlap[asked][:, kept])


def mostly_inside(box: Floats, regions: Floats) -> bool:
    """Whether more than half of a box (4,) lies in one of the regions (N, 4)."""
    span = np.clip(np.minimum(box[2:], regions[:, 2:]) - np.maximum(box[:2], regions[:, :2]), 0.0, None)
    area = max((box[2] - box[0]) * (box[3] - box[1]), 1e-9)
    return bool((span[:, 0] * span[:, 1] > 0.5 * area).any())


@dataclass(frozen=True)
class Hota:
    """HOTA and its parts in [0, 1], each the mean over the thresholds."""

    hota: float
    det_a: float
    ass_a: float
    loc_a: float


def hota(frames: Sequence[BoxFrame]) -> float | None:
    """Higher order tracking accuracy in [0, 1], the mean over the IoU thresholds; None without labels and tracks."""
    parts = hota_parts(frames)
    return None if parts is None else parts.hota


def hota_parts(frames: Sequence[BoxFrame]) -> Hota | None:
    """HOTA with DetA, AssA and LocA; None without labels and tracks."""
    labels, tracks, label_count, track_count = _census(frames)
    if not label_count.sum() and not track_count.sum():
        return None
    # Pairs that overlap often over the whole sequence are preferred in every frame (TrackEval's global alignment)
    potential = np.zeros((len(labels), len(tracks)))
    for frame, rows, columns in _placed(frames, labels, tracks):
        total = frame.overlap.sum(axis=0)[None] + frame.overlap.sum(axis=1)[:, None] - frame.overlap
        share = np.divide(frame.overlap, total, out=np.zeros_like(frame.overlap), where=total > 1e-9)
        potential[np.ix_(rows, columns)] += share
    alignment = potential / np.maximum(label_count[:, None] + track_count[None] - potential, 1e-9)
    found, closeness = np.zeros(len(HOTA_IOU)), np.zeros(len(HOTA_IOU))
    shared = np.zeros((len(HOTA_IOU), len(labels), len(tracks)))
    for frame, rows, columns in _placed(frames, labels, tracks):
        if not frame.overlap.size:
            continue
        i, j = least_cost(-alignment[np.ix_(rows, columns)] * frame.overlap)
        for level, least in enumerate(HOTA_IOU):
            good = frame.overlap[i, j] >= least - 1e-9
            found[level] += good.sum()
            closeness[level] += frame.overlap[i[good], j[good]].sum()
            shared[level][rows[i[good]], columns[j[good]]] += 1
    association = shared / np.maximum(label_count[:, None] + track_count[None] - shared, 1e-9)
    ass = (shared * association).sum(axis=(1, 2)) / np.maximum(found, 1.0)
    det = found / np.maximum(label_count.sum() + track_count.sum() - found, 1.0)
    loc = np.maximum(1e-10, closeness) / np.maximum(1e-10, found)  # 1 where nothing was found, as TrackEval has it
    return Hota(float(np.sqrt(det * ass).mean()), float(det.mean()), float(ass.mean()), float(loc.mean()))


@dataclass(frozen=True)
class Identities:
    """CLEAR MOT (Bernardin and Stiefelhagen 2008) and IDF1 at MATCH_IOU."""

    mota: float
    idf1: float
    switches: int


def identities(frames: Sequence[BoxFrame]) -> Identities:
    """By motmetrics: a pair is possible where it overlaps by MATCH_IOU, who was matched before stays so where it can.

    Without labels MOTA and IDF1 are 0. Raises DatasetError where motmetrics is not installed.
    """
    try:
        import motmetrics  # with pandas: the extra `evaluate`
    except ImportError:
        raise DatasetError("tracks are judged by motmetrics: pip install 'birdslam[evaluate]'") from None
    events = motmetrics.MOTAccumulator(auto_id=True)
    for frame in frames:
        distance = np.where(frame.overlap >= MATCH_IOU - 1e-9, 1.0 - frame.overlap, np.nan)
        events.update(frame.labels.tolist(), frame.tracks.tolist(), distance)
    asked = ["mota", "idf1", "num_switches"]
    found = motmetrics.metrics.create().compute(events, metrics=asked, return_dataframe=False)
    mota, idf1 = (float(found[name]) if np.isfinite(found[name]) else 0.0 for name in asked[:2])
    return Identities(mota, idf1, int(found["num_switches"]))


def idf1(frames: Sequence[BoxFrame]) -> float | None:
    """F1 of identities in [0, 1]: each label has one track for the whole sequence; None without labels and tracks."""
    labels, tracks, label_count, track_count = _census(frames)
    total = label_count.sum() + track_count.sum()
    if not total:
        return None
    shared = np.zeros((len(labels), len(tracks)))
    for frame, rows, columns in _placed(frames, labels, tracks):
        shared[np.ix_(rows, columns)] += frame.overlap >= MATCH_IOU
    rows, columns = least_cost(-shared)
    return float(2.0 * shared[rows, columns].sum() / total)


def _census(frames: Sequence[BoxFrame]) -> tuple[Ints, Ints, Floats, Floats]:
    empty = [np.zeros(0, np.int64)]
    labels, label_count = np.unique(np.concatenate(empty + [f.labels for f in frames]), return_counts=True)
    tracks, track_count = np.unique(np.concatenate(empty + [f.tracks for f in frames]), return_counts=True)
    return labels, tracks, label_count.astype(np.float64), track_count.astype(np.float64)


def _placed(frames: Sequence[BoxFrame], labels: Ints, tracks: Ints) -> list[tuple[BoxFrame, Ints, Ints]]:
    return [(f, np.searchsorted(labels, f.labels), np.searchsorted(tracks, f.tracks)) for f in frames]


@dataclass(frozen=True)
class PathErrors:
    """One body's errors in bird's-eye view; the relative ones are over frames that follow each other."""

    frames: int
    ate_m: float
    rpe_t_m: float | None
    rpe_r_deg: float | None
    motion_error_m: float | None  # of its displacement in world from one frame to the next


def path_errors(truth: dict[int, SE2], found: dict[int, SE2]) -> PathErrors | None:
    """Over the frames that both have; None where there is none. Both are in world."""
    frames = sorted(truth.keys() & found.keys())
    if not frames:
        return None
    goal, seen = (np.array([[p[f].x_m, p[f].y_m, p[f].yaw_rad] for f in frames]) for p in (truth, found))
    steps = np.flatnonzero(np.diff(frames) == 1)
    error = between(between(goal[steps], goal[steps + 1]), between(seen[steps], seen[steps + 1]))
    moved = (seen[steps + 1] - seen[steps]) - (goal[steps + 1] - goal[steps])
    any_step = len(steps) > 0
    return PathErrors(
        frames=len(frames),
        ate_m=rms(np.hypot(*(seen - goal)[:, :2].T)),
        rpe_t_m=rms(np.hypot(error[:, 0], error[:, 1])) if any_step else None,
        rpe_r_deg=float(np.rad2deg(rms(error[:, 2]))) if any_step else None,
        motion_error_m=rms(np.hypot(moved[:, 0], moved[:, 1])) if any_step else None,
    )
