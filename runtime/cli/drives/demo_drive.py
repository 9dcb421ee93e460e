"""`birdslam demo-drive make`: renders the shipped drive again."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.configuration import ConfigurationError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds output, length and image quality."""
    text = "directory of drive.npz and camera.toml"
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help=text)
    parser.add_argument("--frames", type=int, metavar="N", help="end after N frames")
    parser.add_argument("--quality", type=int, default=32, metavar="1-100", help="quality of the WebP images (32)")


def run(options: argparse.Namespace) -> int:
    """Renders the drive and prints its size."""
    try:
        from birdslam.runtime.world.demo_drive import make
    except ModuleNotFoundError as error:
        reason = f"demo-drive make needs a checkout with the extra `train`: {error.name} is missing"
        raise ConfigurationError(reason) from error
    count = make(options.output, options.frames, options.quality)
    size = (options.output / "drive.npz").stat().st_size
    print(f"{count} frames, {size / 1e6:.1f} MB in {options.output}")
    return 0
