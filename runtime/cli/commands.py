"""The commands of `birdslam`, one row each; parser, help and dispatch read this table.

A command is a module that adds its arguments to a parser and has a function that takes the parsed options and gives the
exit status. It is loaded only when its command is asked for, so that `--help` is quick and a vehicle's processes hold
no more than they use. This module is light: it is imported before numpy.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version

from birdslam.runtime.schemes import all_schemes
from birdslam.sources.schemes import written


@dataclass(frozen=True)
class Command:
    """A command: its words, its help, the function that adds its arguments, and the function that runs it."""

    words: str
    help: str
    module: str  # in birdslam.runtime.cli
    call: str = "run"
    arguments: str = "add_arguments"  # "": it has none

    def load(self, parser: argparse.ArgumentParser) -> None:
        """Imports the command and gives the parser its arguments; `call` of the parsed options is the command."""
        module = import_module(f"birdslam.runtime.cli.{self.module}")
        if self.arguments:
            getattr(module, self.arguments)(parser)
        parser.set_defaults(call=getattr(module, self.call), command=self.words)


GROUPS = {
    "models": "the networks at hand: list them, check one against its manifest, install",
    "demo-drive": "the drive that ships with birdslam (--source demo)",
    "evaluate": "compare with ground truth",
    "map": "maps of places that drives are localised in (birdslam run --map)",
}
COMMANDS = (
    Command("run", "capture, perceive and optimize a source, live", "vehicle.run"),
    Command("replay", "the back end alone on a recording: does it give the same, bit for bit?", "drives.replay"),
    Command("export", "a recording in the formats of others: a ROS 2 bag (pip install birdslam[ros])", "drives.export"),
    Command("report", "a drive as one HTML page to look at, offline (pip install birdslam[report])", "drives.report"),
    Command("view", "show a recording, or what goes on now, in rerun (pip install birdslam[view])", "drives.view"),
    Command("top", "a live table of the nodes: rates, ages, budgets, restarts", "vehicle.top"),
    Command("listen", "print live estimates, as a planner gets them, until the source ends", "vehicle.listen"),
    Command("uplink", "publish a vehicle's estimates at the router of its fleet (table [fleet]), beside its run",
            "vehicle.fleet", "run_uplink", "add_uplink_arguments"),
    Command("router", "the router of a fleet (table [router]): each vehicle writes its own keys alone, listeners read",
            "vehicle.fleet", "run_router", "add_router_arguments"),
    Command("ros", "say as a node of ROS 2 what a vehicle's BirdSLAM says, at a router of rmw_zenoh, without ROS",
            "vehicle.ros"),
    Command("doctor", "check this machine: cores, permissions, memory, camera, models, clock", "vehicle.doctor"),
    Command("deploy",
            "write what installs the service on a vehicle computer: DIR/deploy/install.sh, units, configuration",
            "vehicle.deploy"),
    Command("interface", "print what a vehicle publishes and how to listen: docs/planner.md",
            "pages", "print_interface", ""),
    Command("configuration", "print every key with its default: docs/configuration.md",
            "pages", "print_configuration", ""),
    Command("sources", "print where frames can come from: docs/sources.md", "pages", "print_sources", ""),
    Command("batch",
            "many drives, each through the whole pipeline offline, and one report of all; goes on where it was stopped",
            "drives.batch"),
    Command("calibrate",
            "a camera file from a drive: intrinsics read or measured, pitch and roll estimated, the height checked",
            "drives.calibrate"),
    Command("models list", "shipped, installed, and in the catalogue", "models", "list_models", "add_directory"),
    Command("models check", "compare a manifest with its network's real inputs and outputs, with one test run",
            "models", "check", "add_check_arguments"),
    Command("models add", "install networks, each with its manifest; `birdslam run --model NAME` finds them",
            "models", "add", "add_install_arguments"),
    Command("demo-drive make", "render it anew in the built-in world, with its truth; needs the extra `train`",
            "drives.demo_drive"),
    Command("map info", "what a map holds", "maps", "info", "add_map_argument"),
    Command("map merge", "one map of two that share streets", "maps", "merge", "add_merge_arguments"),
    Command("map trim", "a part of a map", "maps", "trim", "add_trim_arguments"),
    Command("map picture", "a map from above, as PNG", "maps", "picture", "add_picture_arguments"),
    Command("map export", "a map's graph as g2o, its keyframes as TUM lines, its ways on Earth",
            "maps", "export", "add_export_arguments"),
    Command("evaluate odometry", "ego trajectories against KITTI poses, in one process, repeatable",
            "evaluate.odometry"),
    Command("evaluate car-ahead", "distance to the car ahead against LiDAR; odometry's report too",
            "evaluate.odometry", "run_car_ahead"),
    Command("evaluate tracking", "vehicles and ego on KITTI tracking: the paper's Tables 1-5", "evaluate.tracking"),
    Command("evaluate ablation", "the paper's Tables 3-5 alone: constraints, landmark weights and thresholds, lanes",
            "evaluate.tracking", "run", "add_ablation_arguments"),
    Command("evaluate localisation",
            "where the front end puts the labelled cars of KITTI tracking, by range, from a detector's boxes",
            "evaluate.localisation"),
    Command("evaluate lanes", "a picture of what a frame's lanes are made of; with --truth, lanes against it",
            "evaluate.lanes"),
)  # fmt: skip


def sources_note() -> str:
    """Where frames can come from, for the foot of a help."""
    return f"Sources: {written(all_schemes())}."


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options that the arguments give; `call` among them is the function that takes them.

    Ends the process as argparse does: after help and version, and where an argument is wrong.
    """
    parser = argparse.ArgumentParser(
        prog="birdslam", description="Monocular multibody SLAM in bird's-eye view.", epilog=sources_note()
    )
    parser.add_argument("--version", action="version", version=f"birdslam {version('birdslam')}")
    groups = {"": parser.add_subparsers(required=True, metavar="COMMAND")}
    for command in COMMANDS:
        group, _, name = command.words.rpartition(" ")
        if group not in groups:
            parent = groups[""].add_parser(group, help=GROUPS[group], description=GROUPS[group])
            groups[group] = parent.add_subparsers(required=True, metavar="WHAT")
        own = groups[group].add_parser(name, help=command.help, description=command.help)
        words = command.words.split()
        if [*arguments[: len(words)]] == words:
            command.load(own)
    return parser.parse_args(arguments)
