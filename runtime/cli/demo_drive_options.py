"""The options of `birdslam demo-drive`; light, since runtime/cli/main.py imports it before numpy."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers `demo-drive make` with the sub-parsers of `birdslam`."""
    text = "the drive that ships with birdslam (--source demo)"
    drive = commands.add_parser("demo-drive", help=text, description=text).add_subparsers(required=True, metavar="WHAT")
    text = "render it anew in the built-in world, with its truth; needs the extra `train`"
    make = drive.add_parser("make", help=text, description=text)
    make.add_argument("--output", type=Path, required=True, metavar="DIR", help="for drive.npz and camera.toml")
    make.add_argument("--frames", type=int, metavar="N", help="end after N frames")
    make.add_argument("--quality", type=int, default=32, metavar="1-100", help="of its WebP images (32)")
    make.set_defaults(command="demo-drive make")
