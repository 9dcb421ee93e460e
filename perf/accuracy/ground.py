"""The estimate of the ground on a grade, after a knock of the camera, and with a wrong height.

    python -m perf ground --output DIR [--data DIR] [--model ROLE=PATH ...]

A grade of 6 %, up over a crest and down: drawn by `graded_road`, whose true ground is known. A pitch step of 1.5
degrees: KITTI 00 with each image from frame 40 on turned by K R K^-1, so that the unedited drive is the truth. A height
10 and 15 % off: KITTI 00 with another `height_m`, which the scale follows. Writes ground.json and ground.png.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import msgspec
import numpy as np

from birdslam.bench.ego.trajectory_errors import path_length_m
from birdslam.frontend import FrontEnd, FrontEndConfig, Pending
from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats, Image
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import rotation_exp
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.outputs.drive_files import claim_directory
from birdslam.perception import Perception, Ready
from birdslam.perf.accuracy.drives import with_networks
from birdslam.perf.accuracy.graded_road import GradedRoad, Stand
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import Recording
from birdslam.trajectory import as_poses
from birdslam.types import Frame, Measurements

matplotlib.use("Agg")
import matplotlib.pyplot as plt

label = "the ground on a grade, after a pitch step, with a wrong height: plotted"

GRADE, SPEED_MPS, RATE_HZ = 0.06, 10.0, 10.0
LOOK_AHEAD_M = 15.0  # where the depth by Eq. 1 is compared
LEVEL_REL = 1e-3  # the road bends or climbs where Eq. 1 on level ground errs by more
STEP_DEG, STEP_FRAME = 1.5, 40
HEIGHTS = (0.85, 0.9, 1.0, 1.1, 1.15)
STREET = Camera(931, 282, 540.0, 540.0, 456.3, 139.2, height_m=1.65)


@dataclass(frozen=True)
class Drive:
    """What the front end said over a drive, frame by frame."""

    measurements: list[Measurements]
    heights: list[tuple[float, float, int]]  # height over the stated one, 1-sigma, vehicles

    @property
    def pitch_rad(self) -> Floats:
        return np.array([np.nan if m.ground is None else m.ground.pitch_rad for m in self.measurements])

    @property
    def way_m(self) -> Floats:
        """Along the road, by frame."""
        steps = [0.0 if m.cc is None else math.hypot(m.cc.T_from_to.x_m, m.cc.T_from_to.y_m) for m in self.measurements]
        return np.cumsum(steps)

    def first(self, status: str, after: int = 0) -> int | None:
        """The first frame that carries a status."""
        return next((m.frame_id for m in self.measurements[after:] if status in m.status), None)


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("ground", label, output="")
    parser.add_argument("--output", type=Path, required=True)
    add_data(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH")
    options = parser.parse_args(arguments)
    claim_directory(options.output)
    cv2.setNumThreads(2)
    figure, (grade, step, height) = plt.subplots(3, 2, figsize=(13, 11))
    with Ledger(options.output / "ground.json", label) as ledger:
        row = _grade(grade)
        ledger.add(f"grade of {GRADE:.0%}, simulated", str(row), **row)
        configuration = with_networks(options.model)
        recording = open_recording(f"kitti:{options.data / 'kitti_odometry' / 'sequences' / '00'}")
        for name, measure, axes in (("pitch step", _pitch_step, step), ("wrong height", _height, height)):
            for case, row in measure(recording, configuration, axes).items():
                ledger.add(f"{name}, KITTI 00, {case}", str(row), **row)
    figure.tight_layout()
    figure.savefig(options.output / "ground.png", dpi=80)
    plt.close(figure)
    print(f"results in {options.output}")


def _drive(camera: Camera, frames: Iterable[Frame], start: Callable[[Frame], Pending]) -> Drive:
    config = FrontEndConfig()
    front = FrontEnd(camera, config)
    measurements, heights = [], []
    for frame in frames:
        measurements.append(front.measure(frame, start(frame)))
        heights.append(front.height.estimate)
    return Drive(measurements, heights)


def _alone(frame: Frame) -> Pending:
    return Ready(Perception())


# --- the grade ---


def _grade(axes: Any) -> dict[str, Any]:
    road, rng = GradedRoad(STREET, GRADE), np.random.default_rng(0)
    stands = [road.stand(s) for s in np.arange(0.0, road.length_m, SPEED_MPS / RATE_HZ)]
    frames = (
        Frame(k, round(k * 1e9 / RATE_HZ), k, k, road.render(stand, rng)) for k, stand in enumerate(stands)
    )  # fmt: skip
    drive = _drive(STREET, frames, _alone)
    way = np.array([stand.way_m for stand in stands])
    up = np.array([stand.up_m for stand in stands])
    true_way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(way), np.diff(up)))])
    # The estimated ground is given as the plane through the road under the camera and that `chord_m` ahead
    chord_m = RoadScaleConfig().chord_m
    true_pitch = np.array(
        [s.pitch_rad + math.atan((road.up_m(s.way_m + chord_m) - road.up_m(s.way_m)) / chord_m) for s in stands]
    )
    px = np.array([[STREET.cx_px, road.pixel_row(s, LOOK_AHEAD_M)] for s in stands])
    depth = {
        "estimated": [
            _depth_m(None if m.ground is None else GroundPlane(m.ground.height_m, m.ground.pitch_rad), row)
            for m, row in zip(drive.measurements, px, strict=True)
        ],
        "level": [_depth_m(STREET.ground, row) for row in px],
    }
    true_depth = np.array([_along_road_m(road, stand) for stand in stands])
    error = {name: np.array(values) / true_depth - 1.0 for name, values in depth.items()}
    settled = slice(6, None)
    bends = np.abs(error["level"]) > LEVEL_REL
    left, right = axes
    left.plot(true_way, up - up[0], "k", label="height of the camera, true")
    left.plot(true_way, [m.attitude.z_m for m in drive.measurements], label="estimated (attitude.z_m)")
    left.set(xlabel="way, m", ylabel="m", title=f"A grade of {GRADE:.0%} up, a crest, down (simulated)")
    pitch = left.twinx()
    pitch.plot(true_way, np.degrees(true_pitch), "k:", linewidth=1)
    pitch.plot(true_way, np.degrees(drive.pitch_rad), "C1", linewidth=1)
    pitch.set_ylabel("pitch against the road ahead, deg (dotted: true)")
    for name, values in error.items():
        right.plot(true_way, 100.0 * values, label=f"Eq. 1, {name} ground")
    title = f"Depth of the road {LOOK_AHEAD_M:g} m ahead"
    right.set(xlabel="way, m", ylabel="error of the depth, %", ylim=(-40, 40), title=title)
    for a in axes:
        a.legend(fontsize=7)
        a.grid(True, alpha=0.3)
    return {
        "way_error": float(drive.way_m[-1] / true_way[-1] - 1.0),
        "climb_true_m": float(up.max() - up[0]),
        "climb_estimated_m": float(max(m.attitude.z_m for m in drive.measurements)),
        "pitch_error_median_deg": float(np.degrees(np.nanmedian(np.abs((drive.pitch_rad - true_pitch)[settled])))),
        "pitch_error_max_deg": float(np.degrees(np.nanmax(np.abs((drive.pitch_rad - true_pitch)[settled])))),
        **{f"depth_error_median_{name}": float(np.nanmedian(np.abs(e[settled]))) for name, e in error.items()},
        # This camera stands as its file says and never bounces: where the road does not bend, level is true
        **{f"depth_error_median_bends_{name}": float(np.nanmedian(np.abs(e[bends]))) for name, e in error.items()},
        **{f"depth_error_median_straight_{name}": float(np.nanmedian(np.abs(e[~bends]))) for name, e in error.items()},
        **{f"depth_error_p90_{name}": float(np.nanpercentile(np.abs(e[settled]), 90)) for name, e in error.items()},
        "statuses": _statuses(drive, 6),
    }


def _along_road_m(road: GradedRoad, stand: Stand) -> float:
    """From the camera's foot on the road, in a straight line, to the road LOOK_AHEAD_M in front of the camera."""
    rise = STREET.pitch_rad - stand.pitch_rad
    ahead_m = LOOK_AHEAD_M - STREET.height_m * math.sin(rise)
    climb_m = float(road.up_m(stand.way_m + LOOK_AHEAD_M)) - (stand.up_m - STREET.height_m * math.cos(rise))
    return math.hypot(ahead_m, climb_m)


def _depth_m(ground: GroundPlane | None, px: Floats) -> float:
    return math.nan if ground is None else float(bev.pixel_to_ego(STREET, ground, px)[0, 0])


def _statuses(drive: Drive, after: int) -> dict[str, int]:
    names = [str(status) for m in drive.measurements[after:] for status in m.status]
    return {name: names.count(name) for name in sorted(set(names))}


# --- recorded frames, edited ---


def _frames(recording: Recording, edit: Callable[[int, Image], Image] = lambda k, image: image) -> Iterator[Frame]:
    for frame in recording.frames():
        image = None if frame.image is None else edit(frame.index, frame.image)
        yield Frame(frame.index, frame.t_source_ns, frame.index, frame.index, image)


def _pitch_step(recording: Recording, configuration: Configuration, axes: Any) -> dict[str, Any]:
    with Inference(configuration) as inference:
        plain = _drive(recording.camera, _frames(recording), inference.start)
    # The file of a calibrated camera, as `birdslam calibrate` would have written it before the knock
    pitch_rad = float(np.nanmedian(plain.pitch_rad[6:STEP_FRAME]))
    calibrated = msgspec.structs.replace(recording.camera, pitch_rad=pitch_rad, tilt_sigma_rad=0.004)
    out: dict[str, Any] = {}
    left, right = axes
    for sign in (1, -1):
        R = rotation_exp(np.array([math.radians(sign * STEP_DEG), 0.0, 0.0]))
        H = calibrated.K @ R @ np.linalg.inv(calibrated.K)

        def knocked(k: int, image: Image, H: Floats = H) -> Image:
            size = (image.shape[1], image.shape[0])
            turned = cv2.warpPerspective(image, H, size, borderMode=cv2.BORDER_REPLICATE)
            return np.asarray(turned, np.uint8) if k >= STEP_FRAME else image

        with Inference(configuration) as inference:
            drive = _drive(calibrated, _frames(recording, knocked), inference.start)
        found = np.degrees(drive.pitch_rad - plain.pitch_rad)
        name = f"{sign * STEP_DEG:+g} deg"
        warned = drive.first("calibration_drift", STEP_FRAME)
        left.plot(found, label=f"{name}: pitch, less the unedited drive's")
        left.axhline(sign * STEP_DEG, color="k", linestyle=":", linewidth=1)
        if warned is not None:
            left.axvline(warned, color="C3", linewidth=1)
        right.plot(100.0 * (drive.way_m / np.maximum(plain.way_m, 1e-3) - 1.0), label=name)
        out[name] = {
            "found_after_1_frame_deg": float(found[STEP_FRAME + 1]),
            "found_median_deg": float(np.nanmedian(found[STEP_FRAME:])),
            "calibration_drift_after_frames": None if warned is None else warned - STEP_FRAME,
            "calibration_drift_after_m": (
                None if warned is None else float(plain.way_m[warned] - plain.way_m[STEP_FRAME])
            ),
            "way_against_unedited": float(drive.way_m[-1] / plain.way_m[-1] - 1.0),
            "statuses": _statuses(drive, STEP_FRAME),
        }
    left.set(xlabel="frame", ylabel="deg", title="A pitch step in KITTI 00 (red: calibration_drift)")
    right.set(xlabel="frame", ylabel="way against the unedited drive, %", ylim=(-5, 5), title="... and the scale")
    for a in axes:
        a.legend(fontsize=7)
        a.grid(True, alpha=0.3)
    return out


def _height(recording: Recording, configuration: Configuration, axes: Any) -> dict[str, Any]:
    truth = recording.truth_poses()
    assert truth is not None, recording.name
    true_m = path_length_m(as_poses(truth))
    out: dict[str, Any] = {}
    left, right = axes
    for factor in HEIGHTS:
        camera = msgspec.structs.replace(recording.camera, height_m=factor * recording.camera.height_m)
        with Inference(configuration) as inference:
            drive = _drive(camera, _frames(recording), inference.start)
        name = f"stated {factor - 1:+.0%}"
        left.plot(drive.way_m, label=name)
        ratio, sigma, vehicles = (np.array(column) for column in zip(*drive.heights, strict=True))
        if vehicles[-1]:
            k = np.flatnonzero(vehicles)
            right.errorbar(k[::6], ratio[k][::6] * factor, yerr=(sigma * factor)[k][::6], label=name, linewidth=1)
        out[name] = {
            "way_error": float(drive.way_m[-1] / true_m - 1.0),
            "height_by_vehicles_over_true": float(ratio[-1] * factor) if vehicles[-1] else None,
            "its_sigma_rel": float(sigma[-1]) if vehicles[-1] else None,
            "vehicles": int(vehicles[-1]),
            "calibration_drift_frames": _statuses(drive, 0).get("calibration_drift", 0),
        }
    left.axhline(true_m, color="k", linestyle=":", linewidth=1)
    left.set(xlabel="frame", ylabel="way, m (dotted: true)", title="A height stated wrongly in KITTI 00")
    right.axhline(1.0, color="k", linestyle=":", linewidth=1)
    right.set(xlabel="frame", ylabel="height over the true one", title="The height as the vehicles have it")
    left.legend(fontsize=7)
    if any(row["vehicles"] for row in out.values()):
        right.legend(fontsize=7)
    else:
        right.text(0.5, 0.5, "needs --model detector=PATH", ha="center", transform=right.transAxes)
    for a in axes:
        a.grid(True, alpha=0.3)
    return out
