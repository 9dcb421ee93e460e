"""The command line of `birdslam replay`, `view` and `top`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

RECORDING = "FILE.mcap"


def add_commands(commands: Any) -> None:
    """Adds the three to the subparsers of `birdslam`."""
    replay = commands.add_parser(
        "replay", help="the back end alone on a recording: does it give the same, bit for bit?"
    )
    replay.add_argument("recording", type=Path, metavar=RECORDING)
    replay.add_argument(
        *("--set",),
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="with another back end (slam.graph.*, slam.weights.*): nothing is compared, results are written",
    )
    replay.add_argument("--output", type=Path, metavar="DIR", help="where results go; with it they are always written")
    replay.set_defaults(command="replay")

    view = commands.add_parser(
        "view", help="show a recording, or what goes on now, in rerun (pip install birdslam[view])"
    )
    view.add_argument("what", metavar=f"{RECORDING}|live")
    view.add_argument("--save", type=Path, metavar="FILE.rrd", help="write it down for rerun instead of showing it")
    _add_vehicle(view)
    view.add_argument("--seconds", type=float, metavar="S", help="of live: end after so long")
    view.set_defaults(command="view")

    top = commands.add_parser("top", help="a live table of the nodes: rates, ages, budgets, restarts")
    _add_vehicle(top)
    top.add_argument("--once", action="store_true", help="one table, and end; 1 where no node is there")
    top.set_defaults(command="top")


def _add_vehicle(parser: Any) -> None:
    parser.add_argument("--vehicle", metavar="NAME", default="car")
    parser.add_argument("--runtime-dir", metavar="DIR", type=Path, help="as runtime.runtime_dir of the run")
