"""Arguments that several commands have in common."""

from __future__ import annotations

import argparse
from pathlib import Path

RECORDING = "FILE.mcap"


def add_pipeline(parser: argparse.ArgumentParser) -> None:
    """The pipeline of a drive: networks, camera, stride, results, any key."""
    parser.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="[ROLE=]PATH|NAME",
        help="an ONNX network for a role (detector, segmenter, depth, multitask), or a model's name; may be repeated; "
        "without both a detector and a segmenter the shipped network fills in, unless `none` is named",
    )
    parser.add_argument("--camera", metavar="FILE", help="a camera file (TOML) instead of the recording's calibration")
    parser.add_argument("--stride", type=int, metavar="N", help="every N-th frame of a recording")
    parser.add_argument("--output", metavar="DIR", help="where results go")
    add_settings(parser, "a key of docs/configuration.md, e.g. perceive.deadline_ms=25")


def add_other_odometry(parser: argparse.ArgumentParser, metavar: str) -> None:
    """A trajectory in place of our own odometry."""
    text = "another odometry in place of the images': TUM lines or KITTI rows, in metres"
    text += "; DIR: NAME.txt of each sequence" * ("DIR" in metavar)
    parser.add_argument("--odometry", dest="other_odometry", metavar=metavar, help=text)


def add_detections(parser: argparse.ArgumentParser) -> None:
    """Boxes of another detector in place of a network's."""
    text = "another detector's boxes over a recording: MOT challenge text, KITTI tracking text, or COCO results"
    parser.add_argument("--detections", dest="other_detections", metavar="FILE", help=text)


def add_speeds(parser: argparse.ArgumentParser) -> None:
    """The car's own speed, of one drive or of several."""
    parser.add_argument("--speed", metavar="FILE|DIR", help="the car's own speed; DIR: NAME.txt of each sequence")


def add_topics(parser: argparse.ArgumentParser, *more: str) -> None:
    """Of a ROS bag; `more` are what else may be read from it: speed, truth."""
    parser.add_argument("--topic", metavar="TOPIC", help="of a ROS bag's images, where it has several")
    parser.add_argument("--camera-info-topic", metavar="TOPIC", help="of a ROS bag's camera")
    if "speed" in more:
        text = "the car's own speed in a ROS bag: TwistStamped, TwistWithCovarianceStamped or Odometry"
        parser.add_argument("--speed-topic", metavar="TOPIC", help=text)
    if "truth" in more:
        text = "true poses in a ROS bag: nav_msgs/Odometry or sensor_msgs/NavSatFix"
        parser.add_argument("--truth-topic", metavar="TOPIC", help=text)


def add_final_results(parser: argparse.ArgumentParser) -> None:
    """What is written when a drive is over."""
    text = "also write the final trajectories, by the RTS smoother: tracks/ID.final.tum.txt, ego.final.*"
    parser.add_argument("--smooth", action="store_true", default=None, help=text)
    text = "draw the frames with the estimated boxes beside the bird's-eye view, when the drive is over"
    parser.add_argument("--video", metavar="FILE.mp4", help=text)


def add_map(parser: argparse.ArgumentParser) -> None:
    """The map of places that a drive is localised in."""
    which = parser.add_mutually_exclusive_group()
    text = "a map of places: the drive is localised in it and makes it longer, or begins it; OUTPUT/map.tum.txt"
    which.add_argument("--map", metavar="FILE", help=text)
    which.add_argument("--map-only", metavar="FILE", help="localised in this map, which stays as it is")
    which.add_argument("--no-map", action="store_true", help="whatever the configuration says: for small computers")
    text = (
        "GNSS fixes: a file (CSV, NMEA, GPX), topic:/NAME of a ROS bag, or a receiver /dev/TTY[@BAUD]; "
        "the drive's way, and the map, on Earth: ego.geojson, ego.gpx, ego.kml"
    )
    parser.add_argument("--gnss", metavar="FILE", help=text)


def add_vehicle(parser: argparse.ArgumentParser) -> None:
    """Which vehicle on the bus."""
    parser.add_argument("--vehicle", metavar="NAME", default="car")
    parser.add_argument("--runtime-dir", metavar="DIR", type=Path, help="as runtime.runtime_dir of the run")


def add_fleet(parser: argparse.ArgumentParser) -> None:
    """All vehicles of a fleet in place of one."""
    text = "all vehicles at the router that this file names in [fleet]"
    parser.add_argument("--all", type=Path, metavar="CONFIG.toml", help=text)


def add_config(parser: argparse.ArgumentParser) -> None:
    """A configuration file."""
    parser.add_argument("--config", type=Path, metavar="CONFIG.toml", help="differences from the defaults")


def add_settings(parser: argparse.ArgumentParser, text: str = "a key of docs/configuration.md") -> None:
    """Single keys of the configuration, and for developers the constants beside them."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=text)
    text = "for developers: any field of the typed configuration, e.g. slam.graph.ego_nodes=8"
    parser.add_argument("--constant", action="append", default=[], metavar="KEY=VALUE", help=text)


def add_tracking_root(parser: argparse.ArgumentParser) -> None:
    """A KITTI tracking folder and its sequences."""
    parser.add_argument("root", type=Path, metavar="ROOT", help="KITTI tracking: calib, label_02, oxts, ...")
    parser.add_argument("--sequences", metavar="N,N", help="e.g. 0002,0003; default: all at hand")


def add_lens(parser: argparse.ArgumentParser) -> None:
    """What is known of the lens of a film that says nothing of its camera."""
    text = "how wide the camera sees, across, where nothing tells its lens"
    parser.add_argument("--fov", type=float, metavar="DEG", help=text)
    parser.add_argument("--kind", choices=("dashcam", "phone"), default="dashcam", help="which, where --fov is unknown")
