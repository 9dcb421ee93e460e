"""`birdslam evaluate lanes`: a picture of what the lanes of one frame are made of."""

from __future__ import annotations

import argparse

from birdslam.runtime.cli.arguments import add_config, add_pipeline
from birdslam.runtime.evaluation.lanes import draw_frame_lanes
from birdslam.runtime.options import configuration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The drive, the frame, and the pipeline."""
    parser.add_argument("drive", metavar="DRIVE", help="a KITTI directory, or a source's URI")
    parser.add_argument("--frame", type=int, metavar="N", help="which one; default: the last")
    add_config(parser)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Draws it and names the file."""
    print(draw_frame_lanes(configuration_of(options), options.drive, options.frame))
    return 0
