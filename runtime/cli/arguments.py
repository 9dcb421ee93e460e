"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path

RECORDING = "FILE.mcap"


def add_pipeline(parser: argparse.ArgumentParser) -> None:
    """Adds networks, camera, stride, output folder and settings."""
    parser.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="[ROLE=]PATH|NAME",
        help="ONNX network for a role (detector, segmenter, depth, multitask), or name of a model; repeatable; "
        "the shipped network takes the roles that are missing, unless `none` is given",
    )
    parser.add_argument(
        "--camera", metavar="FILE", help="camera file (TOML), replaces the calibration of the recording"
    )
    parser.add_argument("--stride", type=int, metavar="N", help="read every N-th frame of a recording")
    parser.add_argument("--output", metavar="DIR", help="folder of the results")
    add_settings(parser, "set a key of docs/configuration.md, e.g. perceive.deadline_ms=25")


def add_other_odometry(parser: argparse.ArgumentParser, metavar: str) -> None:
    """Adds an external trajectory that replaces the visual odometry."""
    text = "external trajectory that replaces the visual odometry: TUM lines or KITTI rows, in metres"
    text += "; DIR: NAME.txt for each sequence" * ("DIR" in metavar)
    parser.add_argument("--odometry", dest="other_odometry", metavar=metavar, help=text)


def add_detections(parser: argparse.ArgumentParser) -> None:
    """Adds a file of boxes that replaces the detector."""
    text = "boxes of another detector: MOT challenge text, KITTI tracking text, or COCO results"
    parser.add_argument("--detections", dest="other_detections", metavar="FILE", help=text)


def add_speeds(parser: argparse.ArgumentParser) -> None:
    """Adds the speed of the vehicle, for one drive or several."""
    parser.add_argument("--speed", metavar="FILE|DIR", help="speed of the vehicle; DIR: NAME.txt for each sequence")


def add_topics(parser: argparse.ArgumentParser, *more: str) -> None:
    """Adds the topics of a ROS bag; `more` names optional ones: speed, truth."""
    parser.add_argument("--topic", metavar="TOPIC", help="image topic of a ROS bag that has several")
    parser.add_argument("--camera-info-topic", metavar="TOPIC", help="CameraInfo topic of a ROS bag")
    if "speed" in more:
        text = "speed topic of a ROS bag: TwistStamped, TwistWithCovarianceStamped or Odometry"
        parser.add_argument("--speed-topic", metavar="TOPIC", help=text)
    if "truth" in more:
        text = "ground truth topic of a ROS bag: nav_msgs/Odometry or sensor_msgs/NavSatFix"
        parser.add_argument("--truth-topic", metavar="TOPIC", help=text)


def add_final_results(parser: argparse.ArgumentParser) -> None:
    """Adds what is written after a drive."""
    text = "also write smoothed trajectories (RTS smoother): tracks/ID.final.tum.txt, ego.final.*"
    parser.add_argument("--smooth", action="store_true", default=None, help=text)
    text = "write a video of the frames with boxes beside the bird's-eye view, after the drive"
    parser.add_argument("--video", metavar="FILE.mp4", help=text)


def add_map(parser: argparse.ArgumentParser) -> None:
    """Adds the map in which a drive is localized, and GNSS."""
    which = parser.add_mutually_exclusive_group()
    text = "localize the drive in this map and extend it; a missing file is created; OUTPUT/map.tum.txt"
    which.add_argument("--map", metavar="FILE", help=text)
    which.add_argument("--map-only", metavar="FILE", help="localize the drive in this map, do not change it")
    which.add_argument("--no-map", action="store_true", help="use no map, whatever the configuration names")
    text = (
        "GNSS fixes: a file (CSV, NMEA, GPX), film (inside it), topic:/NAME of a ROS bag, or a receiver "
        "/dev/TTY[@BAUD]; "
        "georeferences trajectory and map: ego.geojson, ego.gpx, ego.kml"
    )
    parser.add_argument("--gnss", metavar="FILE", help=text)
    text = "time from the first fix of the file to the first frame; default: by the clocks, or by the drive's shape"
    parser.add_argument("--gnss-offset", type=float, metavar="S", help=text)


def add_vehicle(parser: argparse.ArgumentParser) -> None:
    """Adds the name of the vehicle on the bus."""
    parser.add_argument("--vehicle", metavar="NAME", default="car")
    parser.add_argument("--runtime-dir", metavar="DIR", type=Path, help="runtime.runtime_dir of the run")


def add_fleet(parser: argparse.ArgumentParser) -> None:
    """Adds the choice of all vehicles of a fleet."""
    text = "show all vehicles of the router that this file names in [fleet]"
    parser.add_argument("--all", type=Path, metavar="CONFIG.toml", help=text)


def add_config(parser: argparse.ArgumentParser) -> None:
    """Adds a configuration file."""
    text = "configuration file: differences from the defaults"
    parser.add_argument("--config", type=Path, metavar="CONFIG.toml", help=text)


def add_settings(parser: argparse.ArgumentParser, text: str = "set a key of docs/configuration.md") -> None:
    """Adds single fields of the configuration."""
    parser.add_argument("--set", "--constant", action="append", default=[], metavar="KEY=VALUE", help=text)


def add_tracking_root(parser: argparse.ArgumentParser) -> None:
    """Adds a KITTI tracking folder and its sequences."""
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder of KITTI tracking: calib, label_02, oxts, ...")
    parser.add_argument("--sequences", metavar="N,N", help="e.g. 0002,0003; default: all that exist")


def add_lens(parser: argparse.ArgumentParser) -> None:
    """Adds the field of view of a film without a camera file."""
    text = "horizontal field of view, for a film whose metadata do not have it"
    parser.add_argument("--fov", type=float, metavar="DEG", help=text)
    text = "1-sigma of the focal length by --fov, including the effect of distortion (default: 10, and distortion)"
    parser.add_argument("--fov-sigma", type=float, metavar="PERCENT", help=text)
    text = (
        "width of the drive's lanes between the middles of their lines, or size of the vehicle that is in view for "
        "most frames, car=LxWxH; sets the scale of a film without --height"
    )
    parser.add_argument("--known-length", metavar="lane=M", help=text)
    parser.add_argument("--kind", choices=("dashcam", "phone"), default="dashcam", help="if --fov is unknown")
