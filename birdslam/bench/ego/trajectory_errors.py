"""ATE, RPE and scale of a trajectory against ground truth. RPE and the aligned ATE are computed by evo.

Poses are (N, 4, 4) `T_first_i` in camera-0 axes. Nothing is aligned but the first pose, except where a name says se3 or
sim3. KITTI's own poses are interpolated over the first dozen frames of a sequence (a constant twist: in 00 the heading
is off by about a degree there), so that an alignment to the first pose turns the whole way by what they lack.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.bench.ego.car_ahead import CarAhead, CarAheadReport
from birdslam.bench.ego.motion_consistency import MotionConsistency, Motions
from birdslam.geometry.arrays import Bools, Floats
from birdslam.outputs.drive_files import Recorder, claim_directory, write_json
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import Transform, as_poses, inverse, read_kitti
from birdslam.types import Estimate, MapUpdate, Measurements

SEGMENTS_M = (10.0, 20.0, 30.0, 40.0, 50.0)  # KITTI's benchmark has 100 to 800 m, longer than a clip


class OdometryReport(msgspec.Struct, frozen=True, kw_only=True):
    """One sequence against its ground truth; the errors are None where there is no truth."""

    sequence: str
    frames: int
    path_m: float | None = None  # of the truth
    ate_m: float | None = None  # root mean square of the positions' errors in 3-D, first pose aligned, no scale
    ate_sim3_m: float | None = None  # the same after the best similarity (Umeyama 1991); None without evo, as RPE
    scale_error: float | None = None  # estimated path over true path, less 1
    rpe_t_m: float | None = None  # root mean square over steps of one frame
    rpe_r_deg: float | None = None
    ate_pct: float | None = None  # ate_m in percent of path_m
    ate_se3_m: float | None = None  # after the best rigid motion, no scale: a truth whose first pose is off shows here
    path_estimated_m: float = 0.0
    statuses: dict[str, int] = {}  # how many frames carried each status
    speed_sources: dict[str, int] = {}  # on how many frames the metres rested on each source
    car_ahead: CarAheadReport | None = None  # where the recording has LiDAR
    motion: MotionConsistency | None = None  # NEES of 10 m; None if only some frames are compared
    segment_t_pct: float | None = None  # mean error of segments of SEGMENTS_M, each aligned at its first pose


def rms(errors: Floats) -> float:
    """Root mean square of (N,) errors; 0 of none."""
    return float(np.sqrt(np.mean(np.square(errors)))) if errors.size else 0.0


def path_length_m(poses: Transform) -> float:
    """Length of the way through (N, 4, 4) poses."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def from_first(poses: Transform) -> Transform:
    """The poses as seen from the first one: its alignment to the identity."""
    return inverse(poses[0]) @ poses


def in_camera0(poses: Transform, T_cam0_cam: Transform) -> Transform:
    """`T_first_i` of a camera, as camera 0 of the same car moves: the lever arm between the two is taken out."""
    out: Transform = T_cam0_cam @ poses @ inverse(T_cam0_cam)
    return out


def ate_m(truth: Transform, estimated: Transform) -> float:
    """Absolute trajectory error: root mean square distance of positions, both from their first pose."""
    return rms(np.linalg.norm(from_first(estimated)[:, :3, 3] - from_first(truth)[:, :3, 3], axis=1))


def scale_error(truth: Transform, estimated: Transform) -> float | None:
    """Estimated path length over the true one, less 1; None where the truth stands still."""
    path_m = path_length_m(truth)
    return path_length_m(estimated) / path_m - 1.0 if path_m > 0.0 else None


def has_evo() -> bool:
    """Whether evo is installed (extra `evaluate`), which computes RPE and aligned ATE."""
    return find_spec("evo") is not None


def evo_errors(truth: Transform, estimated: Transform) -> dict[str, float]:
    """Returns `rpe_t_m`, `rpe_r_deg`, `ate_se3_m` and `ate_sim3_m` by evo.

    RPE is over steps of one frame. Fields that are not defined are left out: all of fewer than three poses, aligned
    ATE of an estimate that does not move.
    """
    from evo.core import metrics  # of the extra `evaluate`
    from evo.core.geometry import GeometryException
    from evo.core.trajectory import PosePath3D

    def rmse(metric: Any, path: Any) -> float:
        metric.process_data((reference, path))
        return float(metric.get_statistic(metrics.StatisticsType.rmse))

    if len(truth) < 3:
        return {}
    reference, path = (PosePath3D(poses_se3=list(poses)) for poses in (truth, estimated))
    relations = {"rpe_t_m": metrics.PoseRelation.translation_part, "rpe_r_deg": metrics.PoseRelation.rotation_angle_deg}
    out = {name: rmse(metrics.RPE(relation, 1, metrics.Unit.frames), path) for name, relation in relations.items()}
    for name, with_scale in (("ate_se3_m", False), ("ate_sim3_m", True)):
        with suppress(GeometryException):
            path = PosePath3D(poses_se3=list(estimated))
            path.align(reference, correct_scale=with_scale)
            out[name] = rmse(metrics.APE(metrics.PoseRelation.translation_part), path)
    return out


def segment_error_pct(truth: Transform, estimated: Transform) -> float | None:
    """KITTI's odometry metric (Geiger et al. 2012) over segments of SEGMENTS_M of the true path from each frame.

    Returns the mean error of their end points in percent of their length; None if the truth is shorter than all.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    pairs = [
        (first, last, length)
        for length in SEGMENTS_M
        for first, last in enumerate(np.searchsorted(way, way + length).tolist())
        if last < len(way)
    ]
    if not pairs:
        return None
    first, last, length = (np.array(column) for column in zip(*pairs, strict=True))
    goal, own = (inverse(poses[first]) @ poses[last] for poses in (truth, estimated))
    error = inverse(own) @ goal
    return 100.0 * float(np.mean(np.linalg.norm(error[:, :3, 3], axis=1) / length))


def compare(
    sequence: str,
    truth: Transform | None,
    estimated: Transform,
    statuses: dict[str, int],
    compared: slice = slice(None),
) -> OdometryReport:
    """The report of one sequence; where not all are `compared`, of those, the first of them aligned.

    Raises ValueError where the two don't have the same number of poses; a run may end with the last that is compared.
    """
    if truth is not None and len(estimated) not in (len(truth), compared.stop):
        raise ValueError(f"sequence {sequence}: {len(estimated)} poses estimated for {len(truth)} frames")
    if compared != slice(None):
        estimated = from_first(estimated[compared])
        truth = None if truth is None else from_first(truth[compared])
    path_estimated_m = path_length_m(estimated)
    if truth is None:
        return OdometryReport(
            sequence=sequence, frames=len(estimated), path_estimated_m=path_estimated_m, statuses=statuses
        )
    path_m, error_m = path_length_m(truth), ate_m(truth, estimated)
    report = OdometryReport(
        sequence=sequence,
        frames=len(estimated),
        path_m=path_m,
        ate_m=error_m,
        scale_error=scale_error(truth, estimated),
        ate_pct=100.0 * error_m / path_m if path_m > 0.0 else None,
        path_estimated_m=path_estimated_m,
        statuses=statuses,
        segment_t_pct=segment_error_pct(truth, estimated),
    )
    return msgspec.structs.replace(report, **evo_errors(truth, estimated)) if has_evo() else report


def _check_known(name: str, truth: Floats, compared: slice) -> None:
    """Raises DatasetError where the truth of a frame to be compared is not known (nan)."""
    known: Bools = np.atleast_1d(np.isfinite(truth).all(axis=(1, 2)))
    if not known[compared].all():
        first, last = np.flatnonzero(known)[[0, -1]].tolist()
        raise DatasetError(
            f"{name}: the truth is known of {known.sum()} of {len(known)} frames, from {first} to {last}: compare "
            f"those (--frames {first}:{last + 1})"
        )


def evaluate_recordings(
    recordings: Iterable[Recording],
    run: Callable[[Recording], Iterable[Measurements | Estimate | MapUpdate]],
    directory: Path,
    summary: Mapping[str, Any] | None = None,
    compared: slice = slice(None),
) -> list[OdometryReport]:
    """Run the pipeline over each recording, keep its results in `directory/NAME`, and compare them with the truth.

    `run` gives one Estimate a frame; before it the frame's Measurements, where motions or the car ahead are to be held
    to the recording's truth or LiDAR, and after it what the map gained. `summary` goes into each summary.json. Of what
    was run, the frames `compared` are held to the truth, aligned at the first of them. Writes
    `directory/report.json`, a list of OdometryReport. Raises ValueError before the first run where two recordings share
    a name, a truth file is torn or the directory can't be written to, and after a run that did not give one estimate a
    frame.
    """
    recordings = list(recordings)
    twice = [name for name, count in Counter(recording.name for recording in recordings).items() if count > 1]
    if twice:
        raise ValueError(f"two recordings of the name {', '.join(twice)}: their results would overwrite each other")
    truths = [recording.truth_poses() for recording in recordings]
    for recording, truth in zip(recordings, truths, strict=True):
        if truth is not None:
            _check_known(recording.name, truth, compared)
    claim_directory(directory)
    report = []
    for recording, truth in zip(recordings, truths, strict=True):
        mount, ahead = recording.camera.ground, CarAhead.of(recording)
        motions = Motions(mount)
        with Recorder(directory / recording.name, recording.camera) as recorder:
            for record in run(recording):
                if isinstance(record, MapUpdate):
                    recorder.add_map(record)
                elif isinstance(record, Estimate):
                    recorder.add(record)
                    if ahead:
                        ahead.add_estimate(record)
                else:
                    motions.add(record)
                    if ahead:
                        ahead.add_measurements(record)
            recorder.finish({"sequence": recording.name, **(summary or {})})
        rows = as_poses(read_kitti(directory / recording.name / "ego.kitti.txt"))
        estimated = in_camera0(rows, recording.T_cam0_cam())
        goal = None if truth is None else as_poses(truth)
        if goal is not None and compared == slice(None):
            goal = from_first(goal)
        row = compare(recording.name, goal, estimated, dict(sorted(recorder.statuses.items())), compared)
        row = msgspec.structs.replace(row, speed_sources=dict(sorted(recorder.speed_sources.items())))
        if goal is not None and compared == slice(None):
            T_cam0_cam = recording.T_cam0_cam()
            of_camera = inverse(T_cam0_cam) @ goal @ T_cam0_cam
            row = msgspec.structs.replace(row, motion=motions.report(of_camera))
        report.append(msgspec.structs.replace(row, car_ahead=ahead.report()) if ahead else row)
        write_json(directory / "report.json", report)  # after each: a long evaluation keeps what it has
    return report
