"""`birdslam deploy`: a folder that installs the service."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.deployment import write_deployment


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="a new directory")


def run(options: argparse.Namespace) -> int:
    """Writes the folder and names the script to run."""
    deploy = write_deployment(options.directory)
    print(f"as root: {deploy / 'install.sh'}; {deploy / 'README.md'} says more")
    return 0
