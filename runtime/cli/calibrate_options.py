"""The options of `birdslam calibrate`; light, since runtime/cli/main.py imports it before numpy."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_command(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the command with the sub-parsers of `birdslam`."""
    text = "a camera file from a drive: intrinsics read or measured, pitch and roll estimated, the height checked"
    parser = commands.add_parser("calibrate", help=text, description=text)
    parser.add_argument("source", metavar="SOURCE", help="a KITTI directory, or kitti:DIR, video:FILE")
    parser.add_argument("--output", required=True, metavar="CAMERA.toml", help="the camera file to write")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--camera", metavar="FILE", help="an older camera file: its intrinsics and height")
    lens.add_argument("--intrinsics", type=Path, metavar="FILE", help="KITTI's calib.txt, or ROS or OpenCV YAML")
    lens.add_argument("--chessboard", type=Path, metavar="DIR", help="images of a chessboard")
    parser.add_argument("--board", default="9x6", metavar="COLSxROWS", help="its inner corners (default 9x6)")
    parser.add_argument("--square-mm", type=float, default=25.0, metavar="MM", help="a square's side (default 25)")
    parser.add_argument("--height", type=float, metavar="M", help="the camera's height over the road, as measured")
    parser.add_argument("--speed", type=Path, metavar="FILE", help="lines of time in s, speed in m/s")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="networks: vehicles and road")
    parser.add_argument("--stride", type=int, metavar="N", help="every N-th frame")
    parser.add_argument("--config", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any key")
    parser.set_defaults(command="calibrate")
