"""`birdslam evaluate tracking`: the tables of the paper on KITTI tracking."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from birdslam.bench.tracking.report import Outcome
from birdslam.outputs.drive_files import claim_directory
from birdslam.runtime.cli.arguments import add_config, add_settings, add_tracking_root
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.tracking import jobs_of, run_jobs, write_report
from birdslam.runtime.options import configuration_of

SEEDS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds sequences, frames, seeds and settings."""
    add_tracking_root(parser)
    parser.add_argument("--frames", default="all", metavar="all|paper|A:B", help="paper: as many frames as the paper")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="seeds of the simulated odometry")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="number of processes")
    add_config(parser)
    text = "networks for sequences with images"
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help=text)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="directory of the report")


def run(options: argparse.Namespace) -> int:
    """Writes and prints the tables of the paper."""
    return evaluate(options, configuration_of(options))


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """Does the same with this configuration."""
    if options.seeds < 1:
        raise ConfigurationError(f"--seeds {options.seeds}: needs 1 or more")
    output = Path(options.output)
    jobs = jobs_of(options.root, options.sequences, configuration, output, frames=options.frames, seeds=options.seeds)
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
