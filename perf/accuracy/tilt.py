"""Pitch and roll of the camera over the road ahead, against labels and LiDAR: as filed, by the images, as vehicles use.

    python -m perf tilt [--output JSON] [--data DIR] [--model ROLE=PATH ...]

*Filed* is the camera file's, *images* what the odometry measures, *placed* what the front end places vehicles by. The
truth is the road by labelled vehicles (0005, 0002), or the LiDAR's plane 20 m ahead (raw clip). Medians in mrad;
`sigmas` is the RMS of errors over the stated sigma and the truth's (1: honest).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from birdslam.bench.simulation.odometry import fit_drift
from birdslam.bench.tracking.labelled_road import LEAST_VEHICLES, labelled_grounds
from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.perf.accuracy.drives import with_networks
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.kitti import KittiRecording
from birdslam.sources.kitti_tracking import open_tracking
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import inverse
from birdslam.types import Frame

label = "pitch and roll of the road ahead on real drives, in mrad: as filed, by images, as placed"

AHEAD_M = (14.0, 26.0)  # of LiDAR returns that tell the road
ASIDE_M = 5.0
NEAR_PLANE_RAD = 0.05  # of slopes: what lies farther off the camera file's road is none
SCATTER_RAD = 0.004  # of the road's slopes about its plane
LEAST_RETURNS = 200
FITS = 10
LIDAR_SIGMA_RAD = (0.001, 0.003)  # of pitch and roll of such a plane


@dataclass(frozen=True)
class Tilt:
    """Pitch and roll (rad), (2,), with their 1-sigma, (2,)."""

    tilt_rad: Floats
    sigma_rad: Floats


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("tilt", label)
    add_data(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    tracking = options.data / "kitti_tracking" / "training"
    drives: list[tuple[str, Callable[[Recording], list[Tilt | None]]]] = [
        ("kitti_tracking/training/image_03/0005", lambda _: by_labels(tracking, "0005")),
        ("kitti_tracking/training/image_02/0002", lambda _: by_labels(tracking, "0002")),
        ("kitti_raw_clip", lambda recording: by_lidar(recording, options.data / "kitti_raw_clip" / "lidar_cam0")),
    ]
    by_images: list[list[Floats]] = []
    with Ledger(options.output, label) as ledger, Inference(with_networks(options.model)) as inference:
        for name, truth_of in drives:
            recording = open_recording(f"kitti:{options.data / name}")
            sources = follow(recording, inference.networks.start)
            truth = truth_of(recording)
            for source, tilts in sources.items():
                row = _row(tilts, truth)
                ledger.add(f"{Path(name).name} {source}", ", ".join(f"{k} {v}" for k, v in row.items()), **row)
            by_images.append(
                [t.tilt_rad - u.tilt_rad for t, u in zip(sources["images"], truth, strict=False) if t and u]
            )
        for axis, angle in enumerate(("pitch", "roll")):
            errors = [np.array(of)[:, axis] for of in by_images if of]
            drift = fit_drift(errors, [np.ones(len(e)) for e in errors])
            ledger.add(f"images' {angle}", f"{drift}", **msgspec.structs.asdict(drift))


class _Watched(Odometry):
    """The odometry, with its newest motion."""

    motion: Motion | None = None

    def estimate(self, *arguments: Any, **named: Any) -> Motion | None:
        self.motion = super().estimate(*arguments, **named)
        return self.motion


def follow(recording: Recording, start: Callable[..., Any]) -> dict[str, list[Tilt | None]]:
    """What each source says in every frame; the images nothing while the car stands."""
    camera = recording.camera
    odometry = _Watched(camera)
    front = FrontEnd(camera, FrontEndConfig(), odometry)
    ground = FrontEndConfig().ground_size
    filed = Tilt(
        np.array([camera.pitch_rad, camera.roll_rad]), np.array([ground.sigma_pitch_rad, ground.sigma_roll_rad])
    )
    out: dict[str, list[Tilt | None]] = {"filed": [], "images": [], "placed": []}
    for frame in recording.frames():
        if frame.image is None:
            raise DatasetError(f"{recording.name}: image {frame.index}: {frame.error}")
        seen = Frame(frame.index, frame.t_source_ns, frame.index, frame.index, frame.image)
        front.measure(seen, start(frame.index, frame.image))
        motion, road = odometry.motion, front.vehicles.road
        out["filed"].append(filed)
        out["images"].append(
            None
            if motion is None or motion.standstill
            else Tilt(np.array([motion.ground.pitch_rad, motion.ground.roll_rad]), np.sqrt(np.diag(motion.tilt_cov)))
        )
        out["placed"].append(
            Tilt(np.array([road.ground.pitch_rad, road.ground.roll_rad]), np.sqrt(np.diag(road.tilt_cov)))
        )
    return out


def by_labels(root: Path, name: str) -> list[Tilt | None]:
    """The road by labelled vehicles, where there are two or more."""
    return [
        None
        if at is None or at.vehicles < LEAST_VEHICLES
        else Tilt(
            np.array([at.ground.pitch_rad, at.ground.roll_rad]), np.array([at.sigma_pitch_rad, at.sigma_roll_rad])
        )
        for at in labelled_grounds(open_tracking(root, name))
    ]


def by_lidar(recording: Recording, folder: Path) -> list[Tilt | None]:
    """The road's plane through its LiDAR's returns, files (N, 3) in camera 0 by the image's number."""
    assert isinstance(recording, KittiRecording)
    T_cam_cam0, out = inverse(recording.T_cam0_cam()), []
    for number in recording.numbers:
        path = folder / f"{number:06d}.npy"
        points = None if not path.is_file() else np.load(path).astype(np.float64)
        out.append(
            None
            if points is None
            else road_by_returns(recording.camera, points @ T_cam_cam0[:3, :3].T + T_cam_cam0[:3, 3])
        )
    return out


def road_by_returns(camera: Camera, points_cam: Floats) -> Tilt | None:
    """Of returns (N, 3) in camera axes; None where too few lie near the camera file's road.

    A point of the road lies H / z - pitch + roll y/x below the camera's axis, as a slope (Eq. 1). Weights are Cauchy's:
    kerbs, cars and people stand above the road.
    """
    x, down, z = points_cam.T
    at = (z > AHEAD_M[0]) & (z < AHEAD_M[1]) & (np.abs(x) < ASIDE_M)
    slope = (down[at] - camera.height_m) / z[at]
    bearing = -x[at] / z[at]
    tilt = np.array([camera.pitch_rad, camera.roll_rad])
    J = np.column_stack([-np.ones_like(bearing), bearing])
    near = np.abs(slope - J @ tilt) < NEAR_PLANE_RAD
    if near.sum() < LEAST_RETURNS:
        return None
    J, slope = J[near], slope[near]
    tilt[0] -= float(np.percentile(slope - J @ tilt, 80.0))  # the road is the lowest of what is seen
    for _ in range(FITS):
        weight = 1.0 / (1.0 + ((slope - J @ tilt) / SCATTER_RAD) ** 2)
        tilt = np.linalg.solve((J.T * weight) @ J, (J.T * weight) @ slope)
    return Tilt(tilt, np.array(LIDAR_SIGMA_RAD))


def page(report: str) -> str:
    """The report as a page."""
    rows = [row for row in json.loads(report)["rows"] if "n" in row]
    out = [
        "# The road's tilt",
        "",
        "Pitch and roll of the camera over the road on real drives: by the camera file, by images, and as vehicles are",
        "placed by. Medians of errors; *sigmas*: RMS of errors over the sigmas of estimate and truth (1: honest).",
        "0005 and 0002 are held to the road by labelled vehicles: where all stand to one side, it knows the roll to",
        "11 mrad only. The raw clip is held to its LiDAR. `birdslam evaluate localisation` feeds the errors of images.",
        "",
        "| drive | frames | pitch, mrad | roll, mrad | pitch, sigmas | roll, sigmas |",
        "|---|---|---|---|---|---|",
    ]
    names = "n", "pitch_mrad", "roll_mrad", "pitch_sigmas", "roll_sigmas"
    out += ["| " + " | ".join([row["name"], *(str(row.get(name, "-")) for name in names)]) + " |" for row in rows]
    return "\n".join(out) + "\n"


def _row(tilts: Sequence[Tilt | None], truth: Sequence[Tilt | None]) -> dict[str, Any]:
    both = [(t, u) for t, u in zip(tilts, truth, strict=False) if t is not None and u is not None]
    if not both:
        return {"n": 0}
    errors = np.array([t.tilt_rad - u.tilt_rad for t, u in both])
    sigmas = np.array([np.hypot(t.sigma_rad, u.sigma_rad) for t, u in both])
    pitch, roll = (1e3 * np.median(np.abs(errors), axis=0)).round(2).tolist()
    of_pitch, of_roll = np.sqrt(np.mean((errors / sigmas) ** 2, axis=0)).round(2).tolist()
    return {"n": len(both), "pitch_mrad": pitch, "roll_mrad": roll, "pitch_sigmas": of_pitch, "roll_sigmas": of_roll}
