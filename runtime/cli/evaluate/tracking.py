"""`birdslam evaluate tracking` and `evaluate ablation`: the paper's tables on KITTI tracking."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from birdslam.bench.tracking.by_class.class_tracks import table_of_tracks
from birdslam.bench.tracking.report import Outcome
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.runtime.cli.arguments import add_config, add_settings, add_speeds, add_tracking_root
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.localisation import evaluate_classes, sequences_of
from birdslam.runtime.evaluation.tracking import METHODS, jobs_of, run_jobs, write_report
from birdslam.runtime.options import configuration_of

SEEDS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sequences, methods, odometry and boxes."""
    text = "how good the tracks of each class are, in metres and in the image, in place of the paper's tables"
    parser.add_argument("--classes", action="store_true", help=text)
    parser.add_argument("--methods", default=",".join(METHODS), metavar="NAME,NAME", help=", ".join(METHODS))
    add_ablation_arguments(parser)


def add_ablation_arguments(parser: argparse.ArgumentParser) -> None:
    """The same without methods: those are of Tables 1 and 2."""
    add_tracking_root(parser)
    parser.add_argument("--frames", default="all", metavar="all|paper|A:B", help="paper: its first so many frames")
    parser.add_argument(
        "--odometry", default="", metavar="images|simulate|truth|FILE", help="FILE: KITTI rows of camera 0"
    )
    parser.add_argument("--detections", default="", metavar="rrc|network|DIR", help="DIR: as det_02_rrc")
    add_speeds(parser)
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of the simulated odometry")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
    add_config(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="for network, images")
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")


def run(options: argparse.Namespace) -> int:
    """Both commands: writes the report and prints it."""
    configuration = configuration_of(options)
    return _classes(options, configuration) if getattr(options, "classes", False) else evaluate(options, configuration)


def _classes(options: argparse.Namespace, configuration: Configuration) -> int:
    """The tracks of each class by recorded boxes, known ego motion and the images' error of the tilt."""
    output = Path(options.output)
    names = sequences_of(options.root, options.sequences)
    claim_directory(output)
    rows = evaluate_classes(options.root, names, options.detections or "rrc", configuration.slam.frontend, True)
    write_json(output / "report.json", rows)
    print(table_of_tracks(rows))
    print(f"results in {output}")
    return 0


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """With a configuration that is there already."""
    if options.seeds < 1:
        raise ConfigurationError(f"--seeds {options.seeds}: needs 1 or more")
    output = Path(options.output)
    jobs = jobs_of(
        options.root,
        options.sequences,
        configuration,
        output,
        methods=options.methods.split(",") if "methods" in options else None,
        frames=options.frames,
        odometry=options.odometry,
        detections=options.detections,
        seeds=options.seeds,
    )
    claim_directory(output)
    print(write_report(jobs, run_jobs(jobs, max(1, options.jobs), _print_done), output))
    print(f"results in {output}")
    return 0


def _print_done(outcome: Outcome, number: int, of: int, to_go: str) -> None:
    print(
        f"sequence {outcome.sequence}: {len(outcome.frames)} frames, odometry: {outcome.odometry}, done "
        f"({number} of {of}{f', {to_go} to go' if to_go else ''})",
        file=sys.stderr,
        flush=True,
    )
