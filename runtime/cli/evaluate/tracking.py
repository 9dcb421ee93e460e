"""`birdslam evaluate tracking` and `evaluate ablation`: the tables of the paper on KITTI tracking."""

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
    """Adds sequences, methods, odometry and boxes."""
    text = "print tracking metrics of each class, in metres and in the image, instead of the tables of the paper"
    parser.add_argument("--classes", action="store_true", help=text)
    parser.add_argument("--methods", default=",".join(METHODS), metavar="NAME,NAME", help=", ".join(METHODS))
    add_ablation_arguments(parser)


def add_ablation_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the same arguments except the methods of Tables 1 and 2."""
    add_tracking_root(parser)
    parser.add_argument("--frames", default="all", metavar="all|paper|A:B", help="paper: as many frames as the paper")
    parser.add_argument(
        "--odometry", default="", metavar="images|simulate|truth|FILE", help="FILE: KITTI rows of camera 0"
    )
    text = "boxes; DIR: files as in det_02_rrc"
    parser.add_argument("--detections", default="", metavar="rrc|network|DIR", help=text)
    add_speeds(parser)
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="seeds of the simulated odometry")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="number of processes")
    add_config(parser)
    text = "networks for --detections network and --odometry images"
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help=text)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="directory of the report")


def run(options: argparse.Namespace) -> int:
    """Writes and prints the report of either command."""
    configuration = configuration_of(options)
    return _classes(options, configuration) if getattr(options, "classes", False) else evaluate(options, configuration)


def _classes(options: argparse.Namespace, configuration: Configuration) -> int:
    """Evaluates tracks by class, with recorded boxes, true ego motion and the tilt error of visual odometry."""
    output = Path(options.output)
    names = sequences_of(options.root, options.sequences)
    claim_directory(output)
    rows = evaluate_classes(options.root, names, options.detections or "rrc", configuration.slam.frontend, True)
    write_json(output / "report.json", rows)
    print(table_of_tracks(rows))
    print(f"results in {output}")
    return 0


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """Writes and prints the tables of the paper."""
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
    remaining = f", {to_go} remaining" if to_go else ""
    print(
        f"sequence {outcome.sequence}: {len(outcome.frames)} frames, odometry: {outcome.odometry}, done "
        f"({number} of {of}{remaining})",
        file=sys.stderr,
        flush=True,
    )
