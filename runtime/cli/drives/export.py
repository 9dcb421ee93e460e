"""`birdslam export`: a recording in the formats of others."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import RECORDING
from birdslam.runtime.progress import file_progress
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.recording.ros_export import write_bag


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The recording and the bag."""
    parser.add_argument("recording", type=Path, metavar=RECORDING)
    parser.add_argument("--ros2", type=Path, required=True, metavar="DIR", help="the bag to write: a new directory")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="of the bag (mcap)")


def run(options: argparse.Namespace) -> int:
    """Writes the bag; says how much the recording held."""
    with file_progress("export", options.recording) as progress:
        recording = Recording(options.recording, progress.reach)
        frames = write_bag(recording, options.ros2, options.storage)
    print(f"{frames} frames of {options.recording} as a ROS 2 bag: {options.ros2}")
    if not recording.complete:
        print(f"{options.recording} was cut off: this is what it holds")
    return 0
