"""Matching of boxes with labels, HOTA, CLEAR MOT and IDF1 of tracks, and ATE in bird's-eye view.

HOTA follows Luiten et al. (IJCV 2021) with TrackEval's formulas, since motmetrics does not have it; MOTA and IDF1 are
motmetrics'. The paper's ATE is the RMS position error of a body in the global SE(2) frame, without alignment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.bench.ego.trajectory_errors import rms
from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import iou
from birdslam.sources.kitti_tracking import VEHICLE_KINDS
from birdslam.sources.label_projection import Label
from birdslam.sources.recording import DatasetError

MATCH_IOU = 0.5
HOTA_IOU = np.arange(0.05, 0.99, 0.05)
MIN_HEIGHT_PX = 25.0  # KITTI: lower boxes are no false alarms


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


def mostly_inside(box: Floats, regions: Floats) -> bool:
    """Whether more than half of a box (4,) lies in one of the regions (N, 4)."""
    span = np.clip(np.minimum(box[2:], regions[:, 2:]) - np.maximum(box[:2], regions[:, :2]), 0.0, None)
    area = max((box[2] - box[0]) * (box[3] - box[1]), 1e-9)
    return bool((span[:, 0] * span[:, 1] > 0.5 * area).any())


def hota(frames: Sequence[BoxFrame]) -> float | None:
    """Returns HOTA in [0, 1], the mean over the IoU thresholds; None without labels and tracks."""
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
    found = np.zeros(len(HOTA_IOU))
    shared = np.zeros((len(HOTA_IOU), len(labels), len(tracks)))
    for frame, rows, columns in _placed(frames, labels, tracks):
        if not frame.overlap.size:
            continue
        i, j = least_cost(-alignment[np.ix_(rows, columns)] * frame.overlap)
        for level, least in enumerate(HOTA_IOU):
            good = frame.overlap[i, j] >= least - 1e-9
            found[level] += good.sum()
            shared[level][rows[i[good]], columns[j[good]]] += 1
    association = shared / np.maximum(label_count[:, None] + track_count[None] - shared, 1e-9)
    ass = (shared * association).sum(axis=(1, 2)) / np.maximum(found, 1.0)
    det = found / np.maximum(label_count.sum() + track_count.sum() - found, 1.0)
    return float(np.sqrt(det * ass).mean())


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
        raise DatasetError("tracks are evaluated by motmetrics: pip install 'birdslam[evaluate]'") from None
    events = motmetrics.MOTAccumulator(auto_id=True)
    for frame in frames:
        distance = np.where(frame.overlap >= MATCH_IOU - 1e-9, 1.0 - frame.overlap, np.nan)
        events.update(frame.labels.tolist(), frame.tracks.tolist(), distance)
    asked = ["mota", "idf1", "num_switches"]
    found = motmetrics.metrics.create().compute(events, metrics=asked, return_dataframe=False)
    mota, idf1 = (float(found[name]) if np.isfinite(found[name]) else 0.0 for name in asked[:2])
    return Identities(mota, idf1, int(found["num_switches"]))


def _census(frames: Sequence[BoxFrame]) -> tuple[Ints, Ints, Floats, Floats]:
    empty = [np.zeros(0, np.int64)]
    labels, label_count = np.unique(np.concatenate(empty + [f.labels for f in frames]), return_counts=True)
    tracks, track_count = np.unique(np.concatenate(empty + [f.tracks for f in frames]), return_counts=True)
    return labels, tracks, label_count.astype(np.float64), track_count.astype(np.float64)


def _placed(frames: Sequence[BoxFrame], labels: Ints, tracks: Ints) -> list[tuple[BoxFrame, Ints, Ints]]:
    return [(f, np.searchsorted(labels, f.labels), np.searchsorted(tracks, f.tracks)) for f in frames]


@dataclass(frozen=True)
class PathErrors:
    """The error of the path of a body in bird's-eye view."""

    frames: int
    ate_m: float


def path_errors(truth: dict[int, SE2], found: dict[int, SE2]) -> PathErrors | None:
    """Compares the frames that both have; None without any. Both are in world."""
    frames = sorted(truth.keys() & found.keys())
    if not frames:
        return None
    away_m = [math.hypot(found[k].x_m - truth[k].x_m, found[k].y_m - truth[k].y_m) for k in frames]
    return PathErrors(len(frames), rms(np.array(away_m)))
