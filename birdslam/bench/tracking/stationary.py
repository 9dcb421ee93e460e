"""Whether stationary vehicles stay where they are: the estimate of the pose graph against labelled stationary vehicles.

A stationary vehicle has one position in world. Its reported position changes as its depth is learned; the drift from
first to last sight must agree with the covariance at first sight. Positions are relative to those of the labels, so
that errors of the true ego poses cancel.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.bench.tracking.localisation import INSIDE_2_SIGMA
from birdslam.bench.tracking.metrics import match_vehicles
from birdslam.geometry.arrays import Floats
from birdslam.graph.pose_graph import PoseGraph
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence
from birdslam.types import Measurements, Moves

MAX_SPREAD_M = 1.5  # of the labelled positions of a stationary vehicle about their median: errors of labels and poses
MAX_NET_M = 1.0  # from the first of them to the last
MIN_SPAN_S, MIN_FRAMES = 1.0, 5  # of the labels, and of a track


@dataclass(frozen=True)
class StationaryTrack:
    """One track of a labelled stationary vehicle; `mahalanobis2` is of the drift, by the covariance at first sight."""

    drift_m: float
    path_m: float  # length of the path of the reported position
    mahalanobis2: float
    is_false_mover: bool  # reported as moving in any frame


class StationaryRow(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of all tracks of stationary vehicles."""

    tracks: int
    drift_median_m: float
    path_median_m: float
    inside_2_sigma: float
    false_movers: int


def stationary_tracks(
    sequence: TrackingSequence, measurements: Iterable[Measurements], config: SlamConfig
) -> list[StationaryTrack]:
    """The tracks of stationary vehicles, as the pose graph estimates them from `measurements`."""
    stationary, graph = _stationary_labels(sequence), PoseGraph(config.graph, config.weights)
    seen: dict[tuple[int, int], list[tuple[Floats, Floats, Moves]]] = {}
    for m in measurements:
        estimated = {v.vehicle: v for v in graph.optimise(m).vehicles}
        labels = {label.track: label for label in sequence.labels_of(m.frame_id)}
        boxes_px = np.array([edge.box_px for edge in m.cv]).reshape(-1, 4)
        pairs = match_vehicles([*labels.values()], [edge.vehicle for edge in m.cv], boxes_px)
        for track, vehicle in pairs.items():
            if track in stationary and (found := estimated.get(vehicle)) is not None:
                truth, pose = sequence.vehicle_truth(labels[track], 0), found.T_world_vehicle
                R = pose.rotation()
                error = np.array([pose.x_m - truth.x_m, pose.y_m - truth.y_m])
                cov = R @ np.reshape(found.cov, (3, 3))[:2, :2] @ R.T
                seen.setdefault((track, vehicle), []).append((error, cov, found.moves))
    return [_track(frames) for frames in seen.values() if len(frames) >= MIN_FRAMES]


def _track(frames: Sequence[tuple[Floats, Floats, Moves]]) -> StationaryTrack:
    errors, drift = np.array([error for error, *_ in frames]), frames[-1][0] - frames[0][0]
    return StationaryTrack(
        drift_m=float(np.hypot(*drift)),
        path_m=float(np.linalg.norm(np.diff(errors, axis=0), axis=1).sum()),
        mahalanobis2=float(drift @ np.linalg.solve(frames[0][1], drift)),
        is_false_mover=any(moves is Moves.DRIVING for *_, moves in frames),
    )


def _stationary_labels(sequence: TrackingSequence) -> set[int]:
    """Ids of the labelled vehicles that do not move."""
    places: dict[int, list[tuple[float, float, float]]] = {}
    for label in sequence.labels:
        if label.kind in VEHICLE_KINDS:
            truth = sequence.vehicle_truth(label, 0)
            places.setdefault(label.track, []).append((label.frame / 10.0, truth.x_m, truth.y_m))
    out = set()
    for track, rows in places.items():
        t_s, at = np.array(rows)[:, 0], np.array(rows)[:, 1:]
        spread = np.linalg.norm(at - np.median(at, axis=0), axis=1).max()
        net = np.linalg.norm(np.median(at[-MIN_FRAMES:], axis=0) - np.median(at[:MIN_FRAMES], axis=0))
        if spread < MAX_SPREAD_M and net < MAX_NET_M and t_s[-1] - t_s[0] >= MIN_SPAN_S:
            out.add(track)
    return out


def summarise_stationary(tracks: Sequence[StationaryTrack]) -> StationaryRow | None:
    """None without tracks."""
    if not tracks:
        return None
    return StationaryRow(
        tracks=len(tracks),
        drift_median_m=float(np.median([t.drift_m for t in tracks])),
        path_median_m=float(np.median([t.path_m for t in tracks])),
        inside_2_sigma=float(np.mean([t.mahalanobis2 <= INSIDE_2_SIGMA for t in tracks])),
        false_movers=sum(t.is_false_mover for t in tracks),
    )
