"""`birdslam evaluate odometry`: compares the method with true poses, and with LiDAR."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, cast

from birdslam.bench.ego.car_ahead import CarAheadReport
from birdslam.bench.ego.trajectory_errors import OdometryReport
from birdslam.runtime.cli.arguments import add_config, add_other_odometry, add_pipeline, add_speeds, add_topics
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.evaluation.odometry import evaluate_odometry
from birdslam.runtime.options import configuration_of
from birdslam.runtime.supervision.run import WITHOUT_MODELS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds sequences, the compared frames and the pipeline."""
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE_DIR", help="KITTI directory or URI of a source")
    add_config(parser)
    text = "frames that are compared; all frames are processed"
    parser.add_argument("--frames", default=":", metavar="FIRST:END", help=text)
    add_speeds(parser)
    add_other_odometry(parser, "FILE|DIR")
    add_topics(parser, "speed", "truth")
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Prints a table of trajectory errors, and the error of the distance to the car ahead where there is LiDAR."""
    configuration = configuration_of(options)
    compared = _frames(options.frames)
    if not configuration.models.in_use():
        print(WITHOUT_MODELS)
    reports = evaluate_odometry(configuration, options.sequences, compared)
    print(f"results in {configuration.output}")
    print(_table(reports))
    for report in reports:
        if report.car_ahead is not None and report.car_ahead.error_median_rel is not None:
            print(f"{report.sequence}: {_ahead(report.car_ahead)}")
    return 0


def _ahead(ahead: CarAheadReport) -> str:
    return (
        f"{ahead.frames} frames with a car ahead, distance error: median {ahead.error_median_rel:.1%}, "
        f"90 % within {ahead.error_p90_rel:.1%}, bias {ahead.bias_median_rel:+.1%}"
    )


def _frames(text: str) -> slice:
    """Parses FIRST:END; either may be missing."""
    first, colon, end = text.partition(":")
    if not colon or not all(part.isdecimal() for part in (first, end) if part):
        raise ConfigurationError(f"--frames {text}: expected FIRST:END, such as 14: or 14:120")
    return slice(int(first) if first else None, int(end) if end else None)


def _table(reports: Sequence[OdometryReport]) -> str:
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
        ("frame NEES", "motion.frame.mean", 2),
        ("median", "motion.frame.median", 2),
        ("10 m NEES", "motion.stretch.mean", 2),
        ("median", "motion.stretch.median", 2),
    )
    lines = [f"{'sequence':16}" + "".join(f"{title:>12}" for title, _, _ in columns)]
    for report in reports:
        values = [(_field(report, name), digits) for _, name, digits in columns]
        cells = "".join(f"{'-' if value is None else format(value, f'.{digits}f'):>12}" for value, digits in values)
        lines.append(f"{report.sequence:16}{cells}")
    return "\n".join(lines)


def _field(report: Any, name: str) -> float | None:
    """Returns a field or a nested field of a report, as in `motion.frame.mean`; None if it is missing."""
    for part in name.split("."):
        report = None if report is None else getattr(report, part)
    return cast("float | None", report)
