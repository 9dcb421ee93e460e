"""`birdslam view`: shows a recording or a running vehicle in rerun."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import RECORDING, add_vehicle
from birdslam.runtime.recording.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the recording or the vehicle, and the viewer."""
    parser.add_argument("what", metavar=f"{RECORDING}|live")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a file for rerun instead of showing it")
    text = "serve a page to browsers of this computer only, until Ctrl-C; default port: 9090"
    where.add_argument("--web", type=int, nargs="?", const=9090, metavar="PORT", help=text)
    add_vehicle(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="end a live view after S seconds")


def run(options: argparse.Namespace) -> int:
    """Shows it; returns 1 if no message of a vehicle arrived."""
    recording = None if options.what == "live" else Recording(Path(options.what))  # fails before a page is served
    if options.web is None:
        return _show(options, recording, options.save)
    from birdslam.runtime.recording.rerun_web import WebViewer  # rerun is an extra

    with WebViewer(options.web) as viewer:
        print(f"open {viewer.page}", flush=True)
        status = _show(options, recording, viewer.data)
        if options.seconds is None and not status:
            print("the drive is over; Ctrl-C ends the viewer", flush=True)
            viewer.wait()
    return status


def _show(options: argparse.Namespace, recording: Recording | None, to: Path | str | None) -> int:
    from birdslam.runtime.recording.rerun_view import show_live, show_recording

    if recording is None:
        return int(not show_live(options.vehicle, options.runtime_dir, to, options.seconds))
    show_recording(recording, to)
    return 0
