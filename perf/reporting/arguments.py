"""Common command-line options of the benchmarks."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path


def benchmark_parser(name: str, label: str, output: str = "JSON") -> argparse.ArgumentParser:
    """A parser with `--output` and its help text `output`; without the option if that is empty."""
    parser = argparse.ArgumentParser(prog=f"python -m perf {name}", description=label)
    if output:
        parser.add_argument("--output", type=Path, help=output)
    return parser


def add_data(parser: argparse.ArgumentParser) -> None:
    """Adds the option for the folder of recordings and labels."""
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BIRDSLAM_DATA", "../shared/data")))


def add_networks(parser: argparse.ArgumentParser) -> None:
    """Adds the options for networks; the default is none."""
    parser.add_argument("--networks", action="store_true", help="run the configured networks")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="run this network")


def numbers(text: str) -> Sequence[int]:
    """Parses a list such as "1,2,3"."""
    return tuple(int(part) for part in text.split(","))
