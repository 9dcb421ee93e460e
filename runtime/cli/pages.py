"""`birdslam interface`, `birdslam configuration` and `birdslam sources`: pages of docs/ generated from the code."""

from __future__ import annotations

import argparse

from birdslam.runtime.pages import configuration, interface, sources


def print_interface(options: argparse.Namespace) -> int:
    """Prints keys, records and statuses for docs/planner.md."""
    print(interface.page(), end="")
    return 0


def print_configuration(options: argparse.Namespace) -> int:
    """Prints every key with its default for docs/configuration.md."""
    print(configuration.page(), end="")
    return 0


def print_sources(options: argparse.Namespace) -> int:
    """Prints the sources of frames for docs/sources.md."""
    print(sources.page(), end="")
    return 0
