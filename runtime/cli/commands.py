"""The table of the commands of `birdslam`, one row each, for parser, help and dispatch.

A command is a module with a function that adds arguments to a parser and a function that takes the parsed options and
returns the exit status. The module is imported only when it runs, so that `--help` is fast. This module must not import
numpy.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from birdslam.runtime.schemes import all_schemes
from birdslam.sources.schemes import scheme_of, written

COMPLETING = "_ARGCOMPLETE"  # argcomplete's variable of the environment


@dataclass(frozen=True)
class Command:
    """A command: its words, its help text, and the functions that add its arguments and run it."""

    words: str
    help: str
    module: str  # in birdslam.runtime.cli
    call: str = "run"
    arguments: str = "add_arguments"  # "": no arguments

    def load(self, parser: argparse.ArgumentParser) -> None:
        """Imports the command and adds its arguments; `call` of the parsed options runs it."""
        module = import_module(f"birdslam.runtime.cli.{self.module}")
        if self.arguments:
            getattr(module, self.arguments)(parser)
        parser.set_defaults(call=getattr(module, self.call), command=self.words)


GROUPS = {
    "models": "list, check and install networks",
    "demo-drive": "the drive that ships with birdslam (--source demo)",
    "evaluate": "compare estimates with ground truth",
    "map": "inspect, merge and export maps (birdslam run --map)",
}
COMMANDS = (
    Command("run", "run capture, perceive and optimize on a source", "vehicle.run"),
    Command("replay", "run the back end on a recording and compare it bit for bit", "drives.replay"),
    Command("export", "export a drive for COLMAP, nerfstudio, TUM, KITTI, GeoJSON; a recording for ROS 2",
            "drives.export"),
    Command("report", "write one HTML page of a drive (pip install birdslam[report])", "drives.report"),
    Command("view", "show a recording or a running vehicle in rerun (pip install birdslam[view])", "drives.view"),
    Command("top", "show a live table of the nodes: rates, ages, budgets, restarts", "vehicle.top"),
    Command("listen", "print live estimates as a planner receives them", "vehicle.listen"),
    Command("uplink", "forward a vehicle's estimates to the router of its fleet (table [fleet])",
            "vehicle.fleet", "run_uplink", "add_uplink_arguments"),
    Command("router", "run the router of a fleet (table [router])",
            "vehicle.fleet", "run_router", "add_router_arguments"),
    Command("ros", "publish a vehicle's estimates as a ROS 2 node through a router of rmw_zenoh, without ROS",
            "vehicle.ros"),
    Command("doctor", "check this machine: cores, permissions, memory, camera, models, clock", "vehicle.doctor"),
    Command("deploy",
            "write the installer of the service: DIR/deploy/install.sh, units, configuration",
            "vehicle.deploy"),
    Command("interface", "print the records that a vehicle publishes",
            "pages", "print_interface", ""),
    Command("configuration", "print every configuration key with its default",
            "pages", "print_configuration", ""),
    Command("sources", "print the sources that frames can come from", "pages", "print_sources", ""),
    Command("batch",
            "run many drives offline and write one report; resumes after an interruption",
            "drives.batch"),
    Command("calibrate",
            "estimate a camera file from a drive: intrinsics, pitch, roll; checks the height",
            "drives.calibrate"),
    Command("completion", "print the completion of a shell: bash, zsh, fish (pip install birdslam[completion])",
            "completion"),
    Command("models list", "list shipped, installed and known networks", "models", "list_models", "add_directory"),
    Command("models check", "compare a manifest with its network's inputs and outputs, by one test run",
            "models", "check", "add_check_arguments"),
    Command("models add", "install networks with their manifests, for `birdslam run --model NAME`",
            "models", "add", "add_install_arguments"),
    Command("demo-drive make", "render the drive again with its ground truth (extra `train`)",
            "drives.demo_drive"),
    Command("map info", "print the contents of a map", "maps", "info", "add_map_argument"),
    Command("map merge", "merge two maps that share streets", "maps", "merge", "add_merge_arguments"),
    Command("map trim", "cut a part out of a map", "maps", "trim", "add_trim_arguments"),
    Command("map picture", "draw a map from above as PNG", "maps", "picture", "add_picture_arguments"),
    Command("map export", "export a map: graph as g2o, keyframes as TUM, trajectories as GeoJSON",
            "maps", "export", "add_export_arguments"),
    Command("evaluate odometry", "compare ego trajectories with true poses, the distance to the car ahead with LiDAR",
            "evaluate.odometry"),
    Command("evaluate tracking", "print the paper's Tables 1 to 5 on KITTI tracking", "evaluate.tracking"),
    Command("evaluate localisation",
            "compare positions of road users with the labels of KITTI tracking, by range",
            "evaluate.localisation"),
    Command("evaluate lanes", "draw the lanes of a frame; with --truth, compare lanes with ground truth",
            "evaluate.lanes"),
)  # fmt: skip


def sources_note() -> str:
    """The sources of frames, for the end of a help text."""
    return f"Sources: {written(all_schemes())}."


def _is_source(text: str) -> bool:
    """Whether the first argument is no command but the source of `birdslam run`."""
    if text.startswith("-") or any(text == command.words.split()[0] for command in COMMANDS):
        return False
    return scheme_of(text, all_schemes()) is not None or "." in text or Path(text).expanduser().exists()


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parses the arguments; `call` of the result is the function that takes it.

    Exits as argparse does: after help and version, and for a wrong argument.
    """
    parser = argparse.ArgumentParser(
        prog="birdslam", description="Monocular multibody SLAM in bird's-eye view.", epilog=sources_note()
    )
    parser.add_argument("--version", action="version", version=f"birdslam {version('birdslam')}")
    if COMPLETING in os.environ:  # the shell asks for the words that can follow
        arguments = os.environ["COMP_LINE"].split()[1:]
    elif arguments and _is_source(arguments[0]):
        arguments = ["run", *arguments]
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
    if COMPLETING in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    return parser.parse_args(arguments)
