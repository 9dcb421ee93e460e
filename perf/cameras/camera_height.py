"""The camera's height by the size of the cars that are seen: how sure it is, on drives whose height is known.

    python -m perf camera_height [--output FILE.json] [--data DIR]

KITTI's tracking sequences with their recorded boxes (RRC); the height is 1.65 m, and the estimate begins at 1.35 m. The
tracker follows the boxes, by the true motion; the tilt is that of the direction of travel, as `birdslam calibrate` has
it. A row is a sequence; sequences with fewer than five vehicles give none. The last row is over all: the root mean
square of the errors, and chi2 of them by their own sigmas (1: honest), with the sequence left out that is worst.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES, measure
from birdslam.calibration.height_check import VehicleHeightConfig, checks_by_vehicles
from birdslam.frontend import FrontEndConfig
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.kitti import KITTI_HEIGHT_M
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.vehicles.camera_height import measure_heights

label = "the camera's height by the size of cars, on KITTI's tracking sequences"

BEGIN_M = 1.35
LEAST_WAY_M = 30.0  # of a sequence: below it nothing shows the tilt
LEAST_STEP_M = 0.3
SIGMA_PITCH_RAD, SIGMA_ROLL_RAD = 0.004, 0.015  # as `calibrate` has them after such a way


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("camera_height", label)
    add_data(parser)
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


def _pitch_rad(sequence: TrackingSequence) -> float | None:
    """Of the camera against its direction of travel; None where it hardly drives."""
    poses = sequence.camera_poses
    steps = np.einsum("nji,nj->ni", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    length_m = np.linalg.norm(steps, axis=1)
    if length_m.sum() < LEAST_WAY_M:
        return None
    moving = length_m > LEAST_STEP_M
    return float(np.median(-np.arcsin(steps[moving, 1] / length_m[moving])))
