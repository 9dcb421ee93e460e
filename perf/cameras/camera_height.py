"""The camera's height by the size of the cars that are seen: how sure it is, on drives whose height is known.

    python -m perf camera_height [--model ROLE=PATH ...] [--output FILE.json] [--data DIR]

KITTI's tracking sequences with their recorded boxes (RRC); the height is 1.65 m, and the estimate begins at 1.35 m. The
tracker follows the boxes, by the true motion; the tilt is that of the direction of travel, as `birdslam calibrate` has
it. Sequences with fewer than five vehicles give no row. `all`: the RMS of the errors, and chi2 of them by their own
sigmas (1: honest), also without the worst. With networks further rows have the height by the width of lanes on images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES, measure
from birdslam.calibration.calibration import calibrate
from birdslam.calibration.height_check import LANES, HeightCheck, VehicleHeightConfig, checks_by_vehicles
from birdslam.frontend import FrontEndConfig, Pending
from birdslam.perf.accuracy.drives import networks_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.calibration.drive import ROUGH
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames
from birdslam.sources.kitti import KITTI_HEIGHT_M
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.opening import open_recording
from birdslam.types import Frame
from birdslam.vehicles.camera_height import measure_heights

label = "the camera's height by the size of cars, on KITTI's tracking sequences"

BEGIN_M = 1.35
LEAST_WAY_M = 30.0  # of a sequence: below it nothing shows the tilt
LEAST_STEP_M = 0.3
LANED = (
    "kitti_odometry/sequences/01",
    "kitti_tracking/training/image_03/0005",
    "kitti_tracking/training/image_02/0002",
)  # drives at hand whose lanes are painted
SIGMA_PITCH_RAD, SIGMA_ROLL_RAD = 0.004, 0.015  # as `calibrate` has them after such a way


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("camera_height", label)
    add_data(parser)
    add_networks(parser)
    options = parser.parse_args(arguments)
    root = options.data / "kitti_tracking" / "training"
    names = sorted(path.stem for path in (root / "det_02_rrc" / "Car").glob("*.txt"))
    if not names:
        raise PerfError(f"{root}: has no recorded boxes (det_02_rrc/Car)")
    errors, sigmas = [], []
    with Ledger(options.output, label, height_m=KITTI_HEIGHT_M, begin_m=BEGIN_M) as ledger:
        for name in names:
            sequence = open_tracking(root, name, CAMERA_OF_BOXES)
            pitch_rad = _pitch_rad(sequence)
            if pitch_rad is None:
                continue
            camera = msgspec.structs.replace(sequence.camera, height_m=BEGIN_M, pitch_rad=pitch_rad)
            detections = read_detections(root / "det_02_rrc", name, len(sequence))
            config = FrontEndConfig()
            boxes = [
                box
                for record in measure(sequence, detections, config)
                for box in measure_heights(record.cv, camera, config.localisation)
            ]
            cov = np.diag([SIGMA_PITCH_RAD**2, SIGMA_ROLL_RAD**2])
            for found in checks_by_vehicles(boxes, camera, cov, VehicleHeightConfig()):
                error, sigma = math.log(found.height_m / KITTI_HEIGHT_M), found.sigma_m / found.height_m
                errors.append(error)
                sigmas.append(sigma)
                row = {"height_m": round(found.height_m, 3), "sigma_rel": round(sigma, 4), "error": round(error, 4)}
                text = f"{found.height_m:.2f} m, {error:+.1%}, own sigma {sigma:.1%}, {found.samples} vehicles"
                ledger.add(name, text, **row, vehicles=found.samples)
        e, s = np.array(errors), np.array(sigmas)
        kept = np.arange(len(e)) != int(np.abs(e / s).argmax())
        rms, chi2, chi2_without = (
            float(v) for v in (np.sqrt(np.mean(e**2)), np.mean((e / s) ** 2), np.mean((e / s)[kept] ** 2))
        )
        text = f"{len(e)} sequences: {rms:.1%} RMS, chi2 {chi2:.2f}, without the worst {chi2_without:.2f}"
        ledger.add("all", text, rms=round(rms, 4), chi2=round(chi2, 3), chi2_without_worst=round(chi2_without, 3))
        configuration = networks_of(options)
        if configuration is None:
            return
        for uri in LANED:
            for found in _by_images(options.data / uri, configuration):
                error, sigma = math.log(found.height_m / KITTI_HEIGHT_M), found.sigma_m / found.height_m
                text = f"{found.height_m:.2f} m, {error:+.1%}, own sigma {sigma:.1%}, {found.samples} frames"
                row = {"height_m": round(found.height_m, 3), "sigma_rel": round(sigma, 4), "error": round(error, 4)}
                ledger.add(f"{Path(uri).name}, {found.cue}", text, **row, frames=found.samples)


def _by_images(folder: Path, configuration: Configuration) -> Iterator[HeightCheck]:
    """By the width of lanes, as `calibrate` has it of a drive's images."""
    recording = open_recording(f"kitti:{folder}")
    camera = msgspec.structs.replace(recording.camera, height_m=BEGIN_M)
    recording.camera = camera
    with Inference(complete(configuration, camera, recording.rate_hz)) as inference:

        def drive() -> Iterator[tuple[Frame, Pending]]:
            for frame in offline_frames(RecordedSource(recording, configuration.source)):
                yield frame, inference.start(frame)

        found = calibrate(drive, camera, configuration.slam.frontend, ROUGH)
    yield from (check for check in found.height_checks if check.cue == LANES)


def _pitch_rad(sequence: TrackingSequence) -> float | None:
    """Of the camera against its direction of travel; None where it hardly drives."""
    poses = sequence.camera_poses
    steps = np.einsum("nji,nj->ni", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    length_m = np.linalg.norm(steps, axis=1)
    if length_m.sum() < LEAST_WAY_M:
        return None
    moving = length_m > LEAST_STEP_M
    return float(np.median(-np.arcsin(steps[moving, 1] / length_m[moving])))
