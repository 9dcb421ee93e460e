"""`birdslam calibrate`: writes a camera file from a drive."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from birdslam.runtime.calibration.drive import calibrate_drive
from birdslam.runtime.calibration.given import Given, known_length_of
from birdslam.runtime.calibration.report import write_camera_file
from birdslam.runtime.cli.arguments import add_config, add_lens, add_settings, add_topics
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.options import configuration_of
from birdslam.runtime.schemes import recorded_schemes
from birdslam.sources.schemes import written


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the drive and known parameters of the camera."""
    parser.add_argument("source", metavar="SOURCE", help=f"a KITTI directory, or {written(recorded_schemes())}")
    parser.add_argument("--output", required=True, metavar="CAMERA.toml", help="the camera file to write")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--camera", metavar="FILE", help="older camera file, for intrinsics and height")
    lens.add_argument("--intrinsics", type=Path, metavar="FILE", help="calibration of another project")
    lens.add_argument("--chessboard", type=Path, metavar="DIR", help="images of a chessboard")
    parser.add_argument("--board", default="9x6", metavar="COLSxROWS", help="inner corners of the board (default 9x6)")
    parser.add_argument("--square-mm", type=float, default=25.0, metavar="MM", help="side of a square (default 25)")
    parser.add_argument("--height", type=float, metavar="M", help="measured height of the camera above the road")
    add_lens(parser)
    text = "lines of time in s, speed in m/s"
    parser.add_argument("--speed", dest="known_speed", type=Path, metavar="FILE", help=text)
    add_topics(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="networks (vehicles, road)")
    parser.add_argument("--stride", type=int, metavar="N", help="read every N-th frame")
    add_config(parser)
    add_settings(parser)


def run(options: argparse.Namespace) -> int:
    """Writes the camera file and prints the evidence for each parameter."""
    board = re.fullmatch(r"(\d+)x(\d+)", options.board)
    if board is None:
        raise ConfigurationError(f"--board {options.board}: expected COLSxROWS, such as 9x6")
    given = Given(
        camera=None if options.camera is None else Path(options.camera),
        intrinsics=options.intrinsics,
        chessboard=options.chessboard,
        board=(int(board[1]), int(board[2])),
        square_m=options.square_mm / 1000.0,
        height_m=options.height,
        fov_deg=options.fov,
        fov_sigma_percent=options.fov_sigma,
        kind=options.kind,
        speed=options.known_speed,
        size=known_length_of(options.known_length),
    )
    found = calibrate_drive(configuration_of(options), options.source, given, options.stride or 1)
    write_camera_file(Path(options.output), found.camera, found.report)
    print("\n".join(found.report))
    print(f"camera file: {options.output}")
    return 0
