"""`birdslam export`: exports a drive or a recording to another format."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.batch.drive_export import FORMATS, export_drive
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.progress import file_progress
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.recording.ros_export import write_bag


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the drive, the format and the output."""
    text = "results of `birdslam run --output`, or for --ros2 a recording of --record"
    parser.add_argument("drive", type=Path, metavar="DIR|FILE.mcap", help=text)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--ros2", type=Path, metavar="DIR", help="write a ROS 2 bag, a new directory")
    text = "colmap, nerfstudio: images, camera poses and points in metres; tum, kitti: camera poses; geojson: on Earth"
    what.add_argument("--format", choices=FORMATS, help=text)
    parser.add_argument("--output", type=Path, metavar="PATH", help="the new file or directory of --format")
    parser.add_argument("--images", default="", metavar="SOURCE", help="source of the images, if it has moved")
    parser.add_argument("--every-m", type=float, default=0.5, metavar="M", help="distance between images (default 0.5)")
    parser.add_argument(
        "--storage", choices=("mcap", "sqlite3"), default="mcap", help="storage of the ROS 2 bag (mcap)"
    )


def run(options: argparse.Namespace) -> int:
    """Writes the drive and prints what was written."""
    if options.format is not None:
        if options.output is None:
            raise ConfigurationError(f"--format {options.format}: name the file or directory to write with --output")
        if not options.every_m >= 0.0:
            raise ConfigurationError(f"--every-m {options.every_m:g}: expected 0 or more metres")
        print("\n".join(export_drive(options.drive, options.format, options.output, options.images, options.every_m)))
        return 0
    with file_progress("export", options.drive) as progress:
        recording = Recording(options.drive, progress.reach)
        frames = write_bag(recording, options.ros2, options.storage)
    print(f"{frames} frames of {options.drive} as a ROS 2 bag: {options.ros2}")
    if not recording.complete:
        print(f"{options.drive} is incomplete; the bag has its readable part")
    return 0
