"""The command `birdslam`. What a user can mend is one line on standard error and exit status 2, never a traceback."""

from __future__ import annotations

import argparse
import os
import sys
from importlib.metadata import version
from pathlib import Path

from birdslam.runtime.cli import (
    calibrate_options,
    demo_drive_options,
    localisation_options,
    models_options,
    recording_options,
    tracking_options,
)
from birdslam.runtime.environment import CLOSED_PIPE_STATUS, ENVIRONMENT, INTERRUPTED_STATUS

USAGE_NOTE = "Sources: demo, kitti:DIR, video:FILE, mcap:FILE, v4l2:/dev/videoN, rtsp://HOST/PATH."


def main(arguments: list[str] | None = None) -> int:
    """Entry point; gives the exit status."""
    options = _parser().parse_args(arguments)
    os.environ.update(ENVIRONMENT)
    try:
        from birdslam.runtime.cli import (
            commands,  # only now: numpy's libraries read the environment when they are loaded
        )

        return commands.execute(options)
    except KeyboardInterrupt:
        return INTERRUPTED_STATUS
    except BrokenPipeError:  # `| head` has seen enough; Python would complain once more when it flushes
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLOSED_PIPE_STATUS


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="birdslam", description="Monocular multibody SLAM in bird's-eye view.", epilog=USAGE_NOTE
    )
    parser.add_argument("--version", action="version", version=f"birdslam {version('birdslam')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="capture, perceive and optimize a source, live", epilog=USAGE_NOTE)
    run.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    run.add_argument("--source", metavar="URI", help="where frames come from")
    run.add_argument("--rate", metavar="HZ|max", help='frames a second, or "max": every frame, as fast as can be')
    run.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    run.add_argument("--record", metavar="FILE.mcap", help="write the drive down; a directory: a new file in it")
    run.add_argument("--record-images", action="store_true", default=None, help="with its frames, as JPEG")
    _add_pipeline_options(run)
    run.set_defaults(command="run")

    recording_options.add_commands(commands)

    listen = commands.add_parser("listen", help="print live estimates, as a planner gets them, until the source ends")
    listen.add_argument("--vehicle", metavar="NAME", default="car")
    listen.add_argument("--runtime-dir", metavar="DIR", type=Path, help="as runtime.runtime_dir of the run")
    listen.add_argument("--json", action="store_true", help="one JSON object a line")
    listen.add_argument("--count", metavar="N", type=int, help="end after N estimates")
    listen.add_argument("--timeout", metavar="S", type=float, help="end, with status 1, when none comes for so long")
    listen.set_defaults(command="listen")

    doctor = commands.add_parser("doctor", help="check this machine: cores, permissions, memory, camera, models, clock")
    doctor.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="of the run to come")
    doctor.add_argument("--source", metavar="URI", help="where frames will come from")
    doctor.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    _add_pipeline_options(doctor)
    doctor.set_defaults(command="doctor")

    interface = commands.add_parser("interface", help="print what a vehicle says and how to listen: docs/interface.md")
    interface.set_defaults(command="interface")
    keys = commands.add_parser("configuration", help="print every key with its default: docs/configuration.md")
    keys.set_defaults(command="configuration")

    calibrate_options.add_command(commands)
    models_options.add_commands(commands)
    demo_drive_options.add_commands(commands)

    evaluate = commands.add_parser("evaluate", help="compare with ground truth").add_subparsers(
        required=True, metavar="WHAT"
    )
    odometry = evaluate.add_parser("odometry", help="ego trajectories against KITTI poses, in one process, repeatable")
    ahead = evaluate.add_parser("car-ahead", help="distance to the car ahead against LiDAR; odometry's report too")
    for command, what in (("evaluate odometry", odometry), ("evaluate car-ahead", ahead)):
        what.add_argument("sequences", nargs="+", metavar="SEQUENCE_DIR", help="a KITTI directory, or a source's URI")
        what.add_argument("--config", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
        what.add_argument("--frames", default=":", metavar="FIRST:END", help="compare these alone; all are driven")
        _add_pipeline_options(what)
        what.set_defaults(command=command)
    tracking_options.add_commands(evaluate)
    localisation_options.add_command(evaluate)
    return parser


def _add_pipeline_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="[ROLE=]PATH|NAME",
        help="an ONNX network for a role (detector, segmenter, depth, multitask), or a model's name; may be repeated; "
        "without both a detector and a segmenter the shipped network fills in, unless `none` is named",
    )
    parser.add_argument("--camera", metavar="FILE", help="a camera file (TOML) instead of the recording's calibration")
    parser.add_argument("--stride", type=int, metavar="N", help="every N-th frame of a recording")
    parser.add_argument("--output", metavar="DIR", help="where results go")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="any key, e.g. perceive.deadline_ms=25"
    )


if __name__ == "__main__":
    sys.exit(main())
