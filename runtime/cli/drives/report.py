"""`birdslam report`: writes an HTML page of a drive."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.outputs.report.page import REPORT
from birdslam.runtime.supervision.drive_report import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the results and the page."""
    text = "results of `birdslam run --output` or recording of `--record`"
    parser.add_argument("source", type=Path, metavar="DIR|FILE.mcap", help=text)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help=f"default: {REPORT} beside the results")
    text = "video of `birdslam run --video`, if the results do not name it"
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help=text)


def run(options: argparse.Namespace) -> int:
    """Writes the page and prints its path."""
    beside = options.source if options.source.is_dir() else options.source.parent
    path = options.output or beside / REPORT
    size = write_report(options.source, path, options.video)
    print(f"{path}: {size / 1e6:.1f} MB, opens in any browser, offline")
    return 0
