"""`birdslam view`: a recording, or what goes on now, in rerun."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import RECORDING, add_vehicle
from birdslam.runtime.recording.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is shown, and where."""
    parser.add_argument("what", metavar=f"{RECORDING}|live")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a file for rerun instead of showing it")
    add_vehicle(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="of live: end after so long")


def run(options: argparse.Namespace) -> int:
    """Shows it; 1 where nothing came from a vehicle."""
    from birdslam.runtime.recording.rerun_view import show_live, show_recording  # rerun is an extra

    if options.what == "live":
        return int(not show_live(options.vehicle, options.runtime_dir, options.save, options.seconds))
    show_recording(Recording(Path(options.what)), options.save)
    return 0
