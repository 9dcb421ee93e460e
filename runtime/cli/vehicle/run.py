"""`birdslam run`: the three processes on a source."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import add_final_results, add_other_odometry, add_pipeline, add_topics
from birdslam.runtime.cli.commands import sources_note
from birdslam.runtime.options import configuration_of
from birdslam.runtime.supervision.run import run as run_processes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Source, rate, recording and results, and the pipeline."""
    parser.epilog = sources_note()
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    parser.add_argument("--source", metavar="URI", help="where frames come from")
    parser.add_argument("--rate", metavar="HZ|max", help='frames a second, or "max": every frame, as fast as can be')
    parser.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    parser.add_argument("--record", metavar="FILE.mcap", help="record the drive; a directory: a new file in it")
    parser.add_argument("--record-images", action="store_true", default=None, help="with its frames, as JPEG")
    add_final_results(parser)
    parser.add_argument("--speed", metavar="FILE", help="the car's own speed over a recording: time in s, speed in m/s")
    add_other_odometry(parser, "FILE")
    add_topics(parser, "speed")
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Runs until the source ends; gives the exit status."""
    return run_processes(configuration_of(options))
