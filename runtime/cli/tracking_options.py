"""The options of `birdslam evaluate tracking` and `ablation`; imported before numpy."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

METHODS = ("birdslam", "birdslam_live", "paper", "batch_se3", "nair", "namdev", "cubeslam")
SEEDS = 5


def add_commands(evaluate: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Registers both commands with the sub-parsers of `birdslam evaluate`."""
    for command, text in (
        ("tracking", "vehicles and ego on KITTI tracking: the paper's Tables 1-5"),
        ("ablation", "the paper's Tables 3-5 alone: constraints, landmark weights and thresholds, lanes"),
    ):
        parser = evaluate.add_parser(command, help=text, description=text)
        parser.add_argument("root", type=Path, metavar="ROOT", help="KITTI tracking: calib, label_02, oxts, ...")
        parser.add_argument("--sequences", metavar="N,N", help="e.g. 0002,0003; default: all at hand")
        parser.add_argument("--frames", default="all", metavar="all|paper|A:B", help="paper: its first so many frames")
        if command == "tracking":
            parser.add_argument("--methods", default=",".join(METHODS), metavar="NAME,NAME", help=", ".join(METHODS))
        parser.add_argument(
            "--odometry", default="", metavar="images|simulate|truth|FILE", help="FILE: KITTI rows of camera 0"
        )
        parser.add_argument("--detections", default="", metavar="rrc|network|DIR", help="DIR: as det_02_rrc")
        parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of the simulated odometry")
        parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
        parser.add_argument("--config", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
        parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="for network, images")
        parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="any key")
        parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")
        parser.set_defaults(command=f"evaluate {command}")
