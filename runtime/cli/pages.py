"""`birdslam interface`, `birdslam configuration` and `birdslam sources`: pages of docs/ that are made from the code."""

from __future__ import annotations

import argparse

from birdslam.runtime.pages import configuration, interface, sources


def print_interface(options: argparse.Namespace) -> int:
    """Keys, records and statuses: docs/planner.md."""
    print(interface.page(), end="")
    return 0


def print_configuration(options: argparse.Namespace) -> int:
    """Every key with its default: docs/configuration.md."""
    print(configuration.page(), end="")
    return 0


def print_sources(options: argparse.Namespace) -> int:
    """Where frames can come from: docs/sources.md."""
    print(sources.page(), end="")
    return 0
