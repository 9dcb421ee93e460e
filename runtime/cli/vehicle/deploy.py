"""`birdslam deploy`: writes a directory that installs the service."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.deployment import write_deployment


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the directory."""
    parser.add_argument("directory", type=Path, metavar="DIR", help="a new directory")


def run(options: argparse.Namespace) -> int:
    """Writes the directory and prints the script to run."""
    deploy = write_deployment(options.directory)
    print(f"run as root: {deploy / 'install.sh'}; see {deploy / 'README.md'}")
    return 0
