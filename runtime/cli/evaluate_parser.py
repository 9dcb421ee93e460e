"""The commands that compare with ground truth: `birdslam evaluate WHAT`. As light as parser.py."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from birdslam.runtime.cli.arguments import (
    Commands,
    add_config,
    add_other_odometry,
    add_pipeline,
    add_settings,
    add_speeds,
    add_topics,
)
from birdslam.runtime.evaluation.methods import METHODS

SEEDS = 5


def add_evaluations(commands: Commands) -> None:
    """Adds `evaluate` with all that can be compared."""
    evaluate = commands.add_parser("evaluate", help="compare with ground truth").add_subparsers(
        required=True, metavar="WHAT"
    )
    for add_evaluation in (_odometry, _tracking, _localisation, _lanes):
        add_evaluation(evaluate)


def _odometry(evaluate: Commands) -> None:
    odometry = evaluate.add_parser("odometry", help="ego trajectories against KITTI poses, in one process, repeatable")
    ahead = evaluate.add_parser("car-ahead", help="distance to the car ahead against LiDAR; odometry's report too")
    for command, parser in (("evaluate odometry", odometry), ("evaluate car-ahead", ahead)):
        parser.add_argument("sequences", nargs="+", metavar="SEQUENCE_DIR", help="a KITTI directory, or a source's URI")
        add_config(parser)
        parser.add_argument("--frames", default=":", metavar="FIRST:END", help="compare these alone; all are driven")
        add_speeds(parser)
        add_other_odometry(parser, "FILE|DIR")
        add_topics(parser, "speed", "truth")
        add_pipeline(parser)
        parser.set_defaults(command=command)


def _tracking(evaluate: Commands) -> None:
    for command, text in (
        ("tracking", "vehicles and ego on KITTI tracking: the paper's Tables 1-5"),
        ("ablation", "the paper's Tables 3-5 alone: constraints, landmark weights and thresholds, lanes"),
    ):
        parser = evaluate.add_parser(command, help=text, description=text)
        _add_tracking_root(parser)
        parser.add_argument("--frames", default="all", metavar="all|paper|A:B", help="paper: its first so many frames")
        if command == "tracking":
            parser.add_argument("--methods", default=",".join(METHODS), metavar="NAME,NAME", help=", ".join(METHODS))
        parser.add_argument(
            "--odometry", default="", metavar="images|simulate|truth|FILE", help="FILE: KITTI rows of camera 0"
        )
        parser.add_argument("--detections", default="", metavar="rrc|network|DIR", help="DIR: as det_02_rrc")
        add_speeds(parser)
        parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="of the simulated odometry")
        parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes")
        add_config(parser)
        parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="for network, images")
        add_settings(parser)
        parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")
        parser.set_defaults(command=f"evaluate {command}")


def _lanes(evaluate: Commands) -> None:
    text = "a picture of what a frame's lanes are made of: road and lane cells, seen and completed"
    parser = evaluate.add_parser("lanes", help=text, description=text)
    parser.add_argument("drive", metavar="DRIVE", help="a KITTI directory, or a source's URI")
    parser.add_argument("--frame", type=int, metavar="N", help="which one; default: the last")
    add_config(parser)
    add_pipeline(parser)
    parser.set_defaults(command="evaluate lanes")


def _localisation(evaluate: Commands) -> None:
    text = "where the front end puts the labelled cars of KITTI tracking, by range, from a detector's boxes"
    parser = evaluate.add_parser("localisation", help=text, description=text)
    _add_tracking_root(parser)
    parser.add_argument("--detections", default="rrc", metavar="rrc|DIR", help="DIR: as det_02_rrc")
    parser.add_argument("--mode", choices=("default", "paper"), default="default", help="paper: Eq. 1 on level ground")
    text = "how each sequence fares by a constant that the others chose of these values; may be repeated"
    parser.add_argument("--leave-one-out", action="append", default=[], metavar="KEY=V1,V2", help=text)
    add_config(parser)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")
    parser.set_defaults(command="evaluate localisation", model=[])


def _add_tracking_root(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", type=Path, metavar="ROOT", help="KITTI tracking: calib, label_02, oxts, ...")
    parser.add_argument("--sequences", metavar="N,N", help="e.g. 0002,0003; default: all at hand")
