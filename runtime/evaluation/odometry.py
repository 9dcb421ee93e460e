"""`birdslam evaluate odometry` and `evaluate car-ahead`: the whole method in one process, held to poses and LiDAR."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from birdslam.bench.ego.trajectory_errors import OdometryReport, evaluate_recordings
from birdslam.runtime.batch.offline import Drive, pipeline
from birdslam.runtime.configuration import FILE_SCHEMES, ConfigurationError
from birdslam.runtime.options import configuration_of, speeds_of
from birdslam.runtime.progress import Progress
from birdslam.runtime.supervision.run import WITHOUT_MODELS
from birdslam.sources.odometry_file import check_odometry
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import Recording
from birdslam.sources.speed_file import of_sequence, with_speeds
from birdslam.types import Estimate, MapUpdate, Measurements


def _uri(text: str) -> str:
    return text if text.partition(":")[0] in FILE_SCHEMES else f"kitti:{text}"


def evaluate_odometry(options: argparse.Namespace) -> int:
    """`birdslam evaluate odometry`: trajectories against the truth; writes report.json and prints a table."""
    print(_odometry_table(_evaluate(options)))
    return 0


def evaluate_car_ahead(options: argparse.Namespace) -> int:
    """`birdslam evaluate car-ahead`: the distance to the car ahead against the recording's LiDAR."""
    for report in _evaluate(options):
        ahead = report.car_ahead
        if ahead is None:
            raise ConfigurationError(f"{report.sequence}: has no LiDAR (lidar_cam0 beside its images) to compare with")
        if ahead.error_median_rel is None or ahead.error_p90_rel is None or ahead.bias_median_rel is None:
            print(f"{report.sequence}: no car ahead in {report.frames} frames")
        else:
            print(
                f"{report.sequence}: {ahead.frames} frames with a car ahead, error of its distance: "
                f"median {ahead.error_median_rel:.1%}, 90 % within {ahead.error_p90_rel:.1%}, "
                f"bias {ahead.bias_median_rel:+.1%}"
            )
    return 0


def _evaluate(options: argparse.Namespace) -> list[OdometryReport]:
    configuration = configuration_of(options)
    source = configuration.source
    if source.frames is not None or source.loop:
        raise ConfigurationError("source.frames, source.loop: evaluate takes whole recordings, once")
    recordings = [
        open_recording(_uri(text), configuration.camera, source.stride, topics=source.topics)
        for text in options.sequences
    ]
    twice = [name for name, n in Counter(recording.name for recording in recordings).items() if n > 1]
    if twice:
        raise ConfigurationError(f"two sequences are named {twice[0]}: their results would overwrite each other")
    if source.speed:
        for recording in recordings:
            with_speeds(recording, of_sequence(speeds_of(configuration, len(recordings)), recording.name))
    if source.odometry:
        for recording in recordings:
            check_odometry(recording, of_sequence(Path(source.odometry).expanduser(), recording.name), source.stride)
    if not configuration.models.in_use():
        print(WITHOUT_MODELS)
    with pipeline(configuration) as drive:
        reports = evaluate_recordings(
            recordings,
            _with_progress(drive),
            Path(configuration.output),
            compared=_compared(options.frames, recordings),
        )
    print(f"results in {configuration.output}")
    return reports


def _with_progress(drive: Drive) -> Drive:
    def shown_drive(recording: Recording) -> Iterator[Measurements | Estimate | MapUpdate]:
        with Progress(recording.name, len(recording) or None) as progress:
            for record in drive(recording):
                yield record
                progress.advance(isinstance(record, Estimate))

    return shown_drive


def _compared(text: str, recordings: list[Recording]) -> slice:
    """The frames FIRST:END (either may be missing) that are held to the truth; at least two of each recording."""
    first, colon, end = text.partition(":")
    numbers = [part for part in (first, end) if part]
    if not colon or not all(part.isdecimal() for part in numbers):
        raise ConfigurationError(f"--frames {text}: expected FIRST:END, such as 14: or 14:120")
    frames = slice(int(first) if first else None, int(end) if end else None)
    for recording in recordings:
        if len(range(*frames.indices(len(recording)))) < 2:
            raise ConfigurationError(
                f"--frames {text}: fewer than two of the {len(recording)} frames of {recording.name}"
            )
    return frames


def _odometry_table(reports: list[OdometryReport]) -> str:
    columns = (
        ("frames", "frames", 0),
        ("path m", "path_m", 1),
        ("ATE m", "ate_m", 3),
        ("ATE %", "ate_pct", 2),
        ("ATE se3 m", "ate_se3_m", 3),
        ("ATE sim3 m", "ate_sim3_m", 3),
        ("scale error", "scale_error", 4),
        ("RPE m", "rpe_t_m", 4),
        ("RPE deg", "rpe_r_deg", 4),
        ("segments %", "segment_t_pct", 2),
        ("standing m", "standing_drift_m", 3),
        ("NEES", "ego.nees", 2),
        ("inside 95 %", "ego.inside_95", 2),
        ("motion NEES", "motion.frames.nees", 2),
        ("its median", "motion.frames.nees_median", 2),
        ("measured", "motion.frames.nees_measured", 2),
        ("10 m NEES", "motion.stretches.nees", 2),
        ("its median", "motion.stretches.nees_median", 2),
        ("measured", "motion.stretches.nees_measured", 2),
    )
    lines = [f"{'sequence':16}" + "".join(f"{title:>12}" for title, _, _ in columns)]
    for report in reports:
        values = [(_field(report, name), digits) for _, name, digits in columns]
        cells = "".join(f"{'-' if value is None else format(value, f'.{digits}f'):>12}" for value, digits in values)
        lines.append(f"{report.sequence:16}{cells}")
    return "\n".join(lines)


def _field(report: Any, name: str) -> float | None:
    """A field of a report, or of a report in it: `ego.nees`; None where that is not there."""
    for part in name.split("."):
        report = None if report is None else getattr(report, part)
    return cast("float | None", report)
