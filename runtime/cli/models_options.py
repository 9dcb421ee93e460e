"""The options of `birdslam models`; light, since runtime/cli/main.py imports it before numpy."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers `models list`, `models check` and `models add` with the sub-parsers of `birdslam`."""
    text = "the networks at hand: list them, check one against its manifest, install"
    models = commands.add_parser("models", help=text, description=text).add_subparsers(required=True, metavar="WHAT")
    listing = models.add_parser("list", help="shipped, installed, and in the catalogue")
    listing.set_defaults(command="models list")

    text = "compare a manifest with its network's real inputs and outputs, with one test run"
    check = models.add_parser("check", help=text, description=text)
    check.add_argument("file", metavar="FILE", help="a network (.onnx), its manifest (.toml), or the name of a model")
    check.add_argument("--manifest", default="", metavar="FILE|NAME", help="of the network, where it isn't beside it")
    check.set_defaults(command="models check")

    text = "install networks, each with its manifest; `birdslam run --model NAME` finds them"
    add = models.add_parser("add", help=text, description=text)
    add.add_argument("sources", nargs="+", metavar="NAME|PATH|URL", help="of the catalogue, or an .onnx file")
    add.add_argument("--manifest", default="", metavar="FILE|NAME", help="where it isn't beside the network (.toml)")
    add.add_argument("--sha256", default="", metavar="HEX", help="of the network; needed for a URL unless pinned")
    add.add_argument("--name", default="", metavar="NAME", help="to install it as; default: the file's")
    add.add_argument("--limit-mb", type=float, default=500.0, metavar="MB", help="larger files are refused")
    add.set_defaults(command="models add")
    for parser in (listing, check, add):
        parser.add_argument("--directory", type=Path, metavar="DIR", help="where models are installed (models_dir)")
