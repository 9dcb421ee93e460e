"""The options of `birdslam evaluate localisation`; light, since runtime/cli/main.py imports it before numpy."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_command(evaluate: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers the command with the sub-parsers of `birdslam evaluate`."""
    text = "where the front end puts the labelled cars of KITTI tracking, by range, from a detector's boxes"
    parser = evaluate.add_parser("localisation", help=text, description=text)
    parser.add_argument("root", type=Path, metavar="ROOT", help="KITTI tracking: calib, label_02, oxts, ...")
    parser.add_argument("--sequences", metavar="N,N", help="e.g. 0002,0003; default: all at hand")
    parser.add_argument("--detections", default="rrc", metavar="rrc|DIR", help="DIR: as det_02_rrc")
    parser.add_argument("--mode", choices=("default", "paper"), default="default", help="paper: Eq. 1 on level ground")
    parser.add_argument("--config", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any key")
    parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")
    parser.set_defaults(command="evaluate localisation", model=[])
