"""Command lines of benchmarks: what many of them have in common."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path


def benchmark_parser(name: str, label: str, output: str = "JSON") -> argparse.ArgumentParser:
    """A parser with `--output`, whose help is `output`; without it where that is empty."""
    parser = argparse.ArgumentParser(prog=f"python -m perf {name}", description=label)
    if output:
        parser.add_argument("--output", type=Path, help=output)
    return parser


def add_data(parser: argparse.ArgumentParser) -> None:
    """Where recordings and labels lie."""
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BIRDSLAM_DATA", "../shared/data")))


def add_networks(parser: argparse.ArgumentParser) -> None:
    """Which networks look at a drive; none unless they are asked for."""
    parser.add_argument("--networks", action="store_true", help="with the configured networks")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="with this network")


def numbers(text: str) -> Sequence[int]:
    """A list of the command line: "1,2,3"."""
    return tuple(int(part) for part in text.split(","))
