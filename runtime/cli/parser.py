"""The command line of `birdslam`, one function for each command.

Light: main.py imports it before numpy, whose libraries read the environment when they are loaded. What a command does
stands in dispatch.py.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version
from pathlib import Path

from birdslam.runtime.cli.arguments import (
    Commands,
    add_config,
    add_fleet,
    add_other_odometry,
    add_pipeline,
    add_settings,
    add_topics,
    add_vehicle,
)
from birdslam.runtime.cli.evaluate_parser import add_evaluations

USAGE_NOTE = "Sources: demo, kitti:DIR, video:FILE, rosbag:PATH, mcap:FILE, v4l2:/dev/videoN, rtsp://HOST/PATH."
RECORDING = "FILE.mcap"


def build_parser() -> argparse.ArgumentParser:
    """All commands; each sets `command`, the name by which dispatch.py knows it."""
    parser = argparse.ArgumentParser(
        prog="birdslam", description="Monocular multibody SLAM in bird's-eye view.", epilog=USAGE_NOTE
    )
    parser.add_argument("--version", action="version", version=f"birdslam {version('birdslam')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add_command in (
        _run,
        _replay,
        _export,
        _view,
        _top,
        _listen,
        _uplink,
        _router,
        _doctor,
        _deploy,
        _interface,
        _configuration,
        _batch,
        _calibrate,
        _models,
        _demo_drive,
    ):
        add_command(commands)
    add_evaluations(commands)
    return parser


# --- a drive, live and recorded ---


def _run(commands: Commands) -> None:
    run = commands.add_parser("run", help="capture, perceive and optimize a source, live", epilog=USAGE_NOTE)
    run.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    run.add_argument("--source", metavar="URI", help="where frames come from")
    run.add_argument("--rate", metavar="HZ|max", help='frames a second, or "max": every frame, as fast as can be')
    run.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    run.add_argument("--record", metavar=RECORDING, help="write the drive down; a directory: a new file in it")
    run.add_argument("--record-images", action="store_true", default=None, help="with its frames, as JPEG")
    _add_final_results(run)
    run.add_argument("--speed", metavar="FILE", help="the car's own speed over a recording: time in s, speed in m/s")
    add_other_odometry(run, "FILE")
    add_topics(run, "speed")
    add_pipeline(run)
    run.set_defaults(command="run")


def _replay(commands: Commands) -> None:
    replay = commands.add_parser(
        "replay", help="the back end alone on a recording: does it give the same, bit for bit?"
    )
    replay.add_argument("recording", type=Path, metavar=RECORDING)
    text = "with another back end (slam.graph.*, slam.weights.*): nothing is compared, results are written"
    add_settings(replay, text)
    replay.add_argument("--output", type=Path, metavar="DIR", help="where results go; with it they are always written")
    _add_final_results(replay)
    replay.add_argument("--g2o", type=Path, metavar="FILE.g2o", help="write the graph's edges for other solvers, alone")
    replay.set_defaults(command="replay")


def _add_final_results(parser: argparse.ArgumentParser) -> None:
    text = "also write the final trajectories, by the RTS smoother: tracks/ID.final.tum.txt, ego.final.*"
    parser.add_argument("--smooth", action="store_true", default=None, help=text)
    text = "draw the frames with the estimated boxes beside the bird's-eye view, when the drive is over"
    parser.add_argument("--video", metavar="FILE.mp4", help=text)


def _export(commands: Commands) -> None:
    text = "a recording in the formats of others: a ROS 2 bag (pip install birdslam[ros])"
    export = commands.add_parser("export", help=text, description=text)
    export.add_argument("recording", type=Path, metavar=RECORDING)
    export.add_argument("--ros2", type=Path, required=True, metavar="DIR", help="the bag to write: a new directory")
    export.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="of the bag (mcap)")
    export.set_defaults(command="export")


def _view(commands: Commands) -> None:
    view = commands.add_parser(
        "view", help="show a recording, or what goes on now, in rerun (pip install birdslam[view])"
    )
    view.add_argument("what", metavar=f"{RECORDING}|live")
    view.add_argument("--save", type=Path, metavar="FILE.rrd", help="write it down for rerun instead of showing it")
    add_vehicle(view)
    view.add_argument("--seconds", type=float, metavar="S", help="of live: end after so long")
    view.set_defaults(command="view")


def _top(commands: Commands) -> None:
    top = commands.add_parser("top", help="a live table of the nodes: rates, ages, budgets, restarts")
    add_vehicle(top)
    add_fleet(top)
    top.add_argument("--once", action="store_true", help="one table, and end; 1 where no node is there")
    top.set_defaults(command="top")


def _listen(commands: Commands) -> None:
    listen = commands.add_parser("listen", help="print live estimates, as a planner gets them, until the source ends")
    add_vehicle(listen)
    add_fleet(listen)
    listen.add_argument("--json", action="store_true", help="one JSON object a line")
    listen.add_argument("--count", metavar="N", type=int, help="end after N estimates")
    listen.add_argument("--timeout", metavar="S", type=float, help="end, with status 1, when none comes for so long")
    listen.set_defaults(command="listen")


def _uplink(commands: Commands) -> None:
    text = "say a vehicle's estimates at the router of its fleet (table [fleet]), beside its run"
    uplink = commands.add_parser("uplink", help=text, description=text)
    uplink.add_argument("config", type=Path, metavar="CONFIG.toml", help="of the vehicle")
    uplink.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    uplink.add_argument("--runtime-dir", metavar="DIR", help="as runtime.runtime_dir of the run")
    uplink.set_defaults(command="uplink")


def _router(commands: Commands) -> None:
    text = "the router of a fleet (table [router]): each vehicle writes its own keys alone, listeners read"
    router = commands.add_parser("router", help=text, description=text)
    router.add_argument("config", type=Path, metavar="CONFIG.toml")
    router.set_defaults(command="router")


# --- the machine, the camera, the networks ---


def _doctor(commands: Commands) -> None:
    doctor = commands.add_parser("doctor", help="check this machine: cores, permissions, memory, camera, models, clock")
    doctor.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="of the run to come")
    doctor.add_argument("--source", metavar="URI", help="where frames will come from")
    doctor.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    doctor.add_argument("--measure", action="store_true", help="and what its settings cost, in some six seconds")
    add_pipeline(doctor)
    doctor.set_defaults(command="doctor")


def _deploy(commands: Commands) -> None:
    text = "write what installs the service on a vehicle computer: DIR/deploy/install.sh, units, configuration"
    deploy = commands.add_parser("deploy", help=text, description=text)
    deploy.add_argument("directory", type=Path, metavar="DIR", help="a new directory")
    deploy.set_defaults(command="deploy")


def _interface(commands: Commands) -> None:
    interface = commands.add_parser("interface", help="print what a vehicle says and how to listen: docs/interface.md")
    interface.set_defaults(command="interface")


def _configuration(commands: Commands) -> None:
    keys = commands.add_parser("configuration", help="print every key with its default: docs/configuration.md")
    keys.set_defaults(command="configuration")


def _batch(commands: Commands) -> None:
    text = "many drives, each through the whole pipeline offline, and one report of all; goes on where it was stopped"
    parser = commands.add_parser("batch", help=text, description=text)
    text = "a source, a KITTI directory, a bag, a recording, a video; a directory with such; a text file of them"
    parser.add_argument("drives", nargs="+", metavar="DRIVE", help=text)
    parser.add_argument("--jobs", type=int, metavar="N", help="drives at once (as many as fit this computer)")
    text = "ray: on a cluster (pip install birdslam[ray]); the output folder is on storage that all nodes share"
    parser.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    text = "of the Ray cluster (auto: the one of this computer)"
    parser.add_argument("--address", default="auto", metavar="HOST:PORT", help=text)
    text = "every drive with each of these settings; may be repeated: every combination"
    parser.add_argument("--sweep", action="append", default=[], metavar="KEY=V1,V2", help=text)
    add_config(parser)
    add_topics(parser, "speed", "truth")
    add_pipeline(parser)
    parser.set_defaults(command="batch")


def _calibrate(commands: Commands) -> None:
    text = "a camera file from a drive: intrinsics read or measured, pitch and roll estimated, the height checked"
    parser = commands.add_parser("calibrate", help=text, description=text)
    parser.add_argument("source", metavar="SOURCE", help="a KITTI directory, or kitti:DIR, video:FILE, rosbag:PATH")
    parser.add_argument("--output", required=True, metavar="CAMERA.toml", help="the camera file to write")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--camera", metavar="FILE", help="an older camera file: its intrinsics and height")
    lens.add_argument("--intrinsics", type=Path, metavar="FILE", help="KITTI's calib.txt, or ROS or OpenCV YAML")
    lens.add_argument("--chessboard", type=Path, metavar="DIR", help="images of a chessboard")
    parser.add_argument("--board", default="9x6", metavar="COLSxROWS", help="its inner corners (default 9x6)")
    parser.add_argument("--square-mm", type=float, default=25.0, metavar="MM", help="a square's side (default 25)")
    parser.add_argument("--height", type=float, metavar="M", help="the camera's height over the road, as measured")
    text = "lines of time in s, speed in m/s"
    parser.add_argument("--speed", dest="known_speed", type=Path, metavar="FILE", help=text)
    add_topics(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="networks: vehicles and road")
    parser.add_argument("--stride", type=int, metavar="N", help="every N-th frame")
    add_config(parser)
    add_settings(parser)
    parser.set_defaults(command="calibrate")


def _models(commands: Commands) -> None:
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


def _demo_drive(commands: Commands) -> None:
    text = "the drive that ships with birdslam (--source demo)"
    drive = commands.add_parser("demo-drive", help=text, description=text).add_subparsers(required=True, metavar="WHAT")
    text = "render it anew in the built-in world, with its truth; needs the extra `train`"
    make = drive.add_parser("make", help=text, description=text)
    make.add_argument("--output", type=Path, required=True, metavar="DIR", help="for drive.npz and camera.toml")
    make.add_argument("--frames", type=int, metavar="N", help="end after N frames")
    make.add_argument("--quality", type=int, default=32, metavar="1-100", help="of its WebP images (32)")
    make.set_defaults(command="demo-drive make")
