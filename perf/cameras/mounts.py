"""A camera file whose pitch or roll is wrong: how soon that is found and reported, and what becomes of the lengths.

    python -m perf mounts [SEQUENCE ...] [--output FILE.json] [--data DIR] [--networks] [--model ROLE=PATH ...]

Each sequence with the file's pitch, then its roll, off by each of `--off` degrees. A row: the error of the length over
the first `--way` metres, what is left of the error of the file by then (against the run with the file as it is, since
KITTI's files are off themselves, by up to 1.5 degrees), and after how many metres `calibration_drift` was reported.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import msgspec
import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import SEQUENCES, Drive, Task, add_drive_options, networks_of, read, uri_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.recording import DatasetError
from birdslam.types import Status

label = "camera files whose pitch or roll is wrong: found and reported within how many metres"

OFF_DEG = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
WAY_M = 20.0


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("mounts", label)
    add_drive_options(parser)
    parser.add_argument(
        "--off", type=float, nargs="+", default=OFF_DEG, metavar="DEG", help="of the file, 0 among them"
    )
    parser.add_argument("--way", type=float, default=WAY_M, metavar="M", help="by which the error is to be found")
    parser.add_argument("--images", type=int, default=100, help="of each sequence")
    options = parser.parse_args(arguments)
    configuration = networks_of(options)
    cv2.setNumThreads(1)
    try:
        with Ledger(options.output, label, way_m=options.way, networks=configuration is not None) as ledger:
            for sequence in options.sequences or SEQUENCES:
                name, drive = read(Task(uri_of(sequence, options.data), "", False, 1, 1, 0, configuration))
                right = follow(drive, drive.camera, options.images, options.way)
                for axis in ("pitch", "roll"):
                    for off_deg in options.off:
                        row = judge(drive, axis, off_deg, right, options.images, options.way)
                        ledger.add(f"{name} {axis} {off_deg:+.1f} deg", row_text(row), **row)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error


def with_tilt_off(camera: Camera, axis: str, off_deg: float) -> Camera:
    """The camera with a file that is wrong."""
    name = f"{axis}_rad"
    return msgspec.structs.replace(camera, **{name: getattr(camera, name) + math.radians(off_deg)})


def follow(drive: Drive, camera: Camera, images: int, way_m: float) -> dict[str, Any]:
    """What the odometry made of a drive with this camera file: at `way_m`, and when it reported a drift."""
    odometry = Odometry(camera)
    true_m = own_m = 0.0
    at: tuple[float, Motion] | None = None
    drift_m = None
    for k, image in enumerate(drive.images[:images]):
        motion = odometry.estimate(odometry.track(image), k, drive.t_ns[k], *drive.seen[k])
        if motion is None:
            continue
        if motion.from_frame == k - 1:
            true_m += float(np.linalg.norm(drive.poses[k, :3, 3] - drive.poses[k - 1, :3, 3]))
            own_m += float(np.linalg.norm(motion.t_prev_curr_m))
        if drift_m is None and Status.CALIBRATION_DRIFT in motion.status:
            drift_m = true_m
        if true_m <= way_m or at is None:
            at = own_m / true_m - 1.0 if true_m else 0.0, motion
    assert at is not None, "a drive of fewer than two images"
    scale_error, motion = at
    tilt = math.degrees(motion.ground.pitch_rad), math.degrees(motion.ground.roll_rad)
    net = (
        math.degrees(motion.ground.pitch_rad - camera.pitch_rad),
        math.degrees(motion.ground.roll_rad - camera.roll_rad),
    )
    net_deg = max(net, key=abs)
    return {
        "net_deg": net_deg,
        "scale_error": scale_error,
        "pitch_deg": tilt[0],
        "roll_deg": tilt[1],
        "drift_m": drift_m,
        "way_m": true_m,
    }


def judge(
    drive: Drive, axis: str, off_deg: float, right: dict[str, Any], images: int, way_m: float
) -> dict[str, Any]:  # fmt: skip
    """One wrong file against the right one."""
    wrong = follow(drive, with_tilt_off(drive.camera, axis, off_deg), images, way_m)
    left_deg = {key: wrong[key] - right[key] for key in ("pitch_deg", "roll_deg")}
    return {"axis": axis, "off_deg": off_deg, **wrong, "pitch_left_deg": left_deg["pitch_deg"]} | {
        "roll_left_deg": left_deg["roll_deg"]
    }


def row_text(row: dict[str, Any]) -> str:
    """A row for a person."""
    drift = "never" if row["drift_m"] is None else f"after {row['drift_m']:.1f} m"
    return (
        f"road against the file {row['net_deg']:+.1f} deg  scale {row['scale_error']:+.1%}  "
        f"left of the error: pitch {row['pitch_left_deg']:+.2f} roll "
        f"{row['roll_left_deg']:+.2f} deg  reported {drift} of {row['way_m']:.0f} m"
    )
