"""What the car's own speed adds to the ego's motion, and what a wrong one does to it, on drives with their truth.

    python -m perf car_speed [SEQUENCE ...] [--output DIR] [--data DIR] [--networks] [--model ROLE=PATH ...]

A sequence: a folder of `--data`, kitti:DIR, a folder with a `drive.npz`, or video:FILE with `--camera` and `--speed`
(of a straight road). Readings are made from the true poses: RATE_HZ, NOISE_REL, FACTOR, DELAY_S. Each is driven without
them, with them, with yaw rates, in the dark, and once for each fault. Rows: error of the way, ATE, NEES, valid frames.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import savgol_filter

from birdslam.bench.ego.consistency import Consistency
from birdslam.bench.ego.trajectory_errors import ate_m, from_first, path_length_m
from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Perception
from birdslam.perf.accuracy.drives import SPEED_FLOOR_M, SPEED_LIMIT, networks_of, uri_of
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import as_poses, ego_pose, inverse, mount_pose
from birdslam.types import NS_PER_S, Estimate, Frame, SpeedReading, Status

Readings = list[SpeedReading]
Coming = list[tuple[int, SpeedReading]]  # with the time of each one's coming, in its order
Fault = Callable[[Readings, float], Coming]  # of the readings, and the middle of the drive in s

label = "the car's own speed: what it adds to the ego's motion, and what a wrong one does"

SEQUENCES = (
    "kitti_odometry/sequences/00",
    "kitti_odometry/sequences/01",
    "kitti_odometry/sequences/06",
    "kitti_raw_clip",
)
RATE_HZ, NOISE_REL, FACTOR, DELAY_S = 50.0, 0.02, 1.03, 0.08
YAW_NOISE_RADPS = 0.005
SMOOTHED_S = 0.9  # over which a cubic is fitted to the true way: KITTI's poses tremble by centimetres
DARK_GAIN, DARK_GREY, DARK_NOISE_GREY = 0.02, 12.0, 3.0


@dataclass(frozen=True)
class Drive:
    """A sequence, its images undistorted, what networks say of them, and `T_first_i` of its camera."""

    name: str
    camera: Camera
    frames: list[Frame]
    seen: list[Perception]
    poses: Floats


@dataclass(frozen=True)
class Known:
    """What networks are done with."""

    perception: Perception

    def result(self) -> Perception:
        return self.perception


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("car_speed", label, output="folder of car_speed.json")
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="folder of --data, kitti:DIR, video:FILE")
    add_data(parser)
    parser.add_argument("--camera", type=Path, help="camera file, where the recording has none")
    parser.add_argument("--speed", type=float, help="m/s all the way, where the recording has no true poses")
    parser.add_argument("--seeds", type=int, default=1, help="drives with readings, each with other noise")
    parser.add_argument("--no-faults", action="store_true", help="without the rows of faults")
    add_networks(parser)
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    path = None if options.output is None else options.output / "car_speed.json"
    configuration = networks_of(options)
    with Ledger(path, label, rate_hz=RATE_HZ, noise_rel=NOISE_REL, factor=FACTOR, delay_s=DELAY_S) as ledger:
        for sequence in options.sequences or SEQUENCES:
            drive = read(sequence, options, configuration)
            for name, readings, dark in variants(drive, options.seeds, not options.no_faults):
                figures = measure(drive, readings, dark)
                ledger.add(f"{drive.name} {name}", row_text(figures), **figures)


def variants(drive: Drive, seeds: int, faults: bool) -> list[tuple[str, Coming, bool]]:
    """Name, readings, and whether the images are darkened."""
    true = [readings_of(drive, seed) for seed in range(seeds)]
    turning = readings_of(drive, 0, yaw_rates=True)
    out: list[tuple[str, Coming, bool]] = [("without", [], False)]
    out += [(f"with, seed {seed}", in_time(readings), False) for seed, readings in enumerate(true)]
    out.append(("with yaw rates", in_time(turning), False))
    out += [("dark", in_time(true[0]), True), ("dark, with yaw rates", in_time(turning), True)]
    if faults:
        middle_s = 0.5 * (drive.frames[0].t_source_ns + drive.frames[-1].t_source_ns) / NS_PER_S
        out += [(name, fault(true[0], middle_s), False) for name, fault in FAULTS.items()]
    return out


def in_time(readings: Readings) -> Coming:
    """Each comes when it holds."""
    return [(reading.t_ns, reading) for reading in readings]


def read(sequence: str, options: argparse.Namespace, configuration: Configuration | None) -> Drive:
    recording = _open(sequence, options)
    frames = list(recording.undistorted_frames())
    truth = recording.truth_poses()
    if truth is not None:
        T = recording.T_cam0_cam()
        poses = from_first(inverse(T) @ as_poses(truth) @ T)
    elif options.speed is not None:
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        poses[:, 2, 3] = [options.speed * (f.t_source_ns - frames[0].t_source_ns) / NS_PER_S for f in frames]
    else:
        raise DatasetError(f"{sequence}: has no true poses; say --speed where it is known")
    if configuration is None:
        nothing = Perception(None, None, {}, ())
        return Drive(recording.name, recording.camera, frames, [nothing] * len(frames), poses)
    with Inference(configuration) as inference:
        seen = [inference.start(frame).result() for frame in frames]
    return Drive(recording.name, recording.camera, frames, seen, poses)


def _open(sequence: str, options: argparse.Namespace) -> Recording:
    camera = None if options.camera is None else load_camera(options.camera)
    rendered = Path(sequence)
    if (rendered / "drive.npz").is_file():
        recording = DemoRecording(rendered, camera)
        recording.name = rendered.resolve().name
        return recording
    if sequence == "demo":
        return DemoRecording(camera=camera)
    return open_recording(uri_of(sequence, options.data), camera)


def readings_of(drive: Drive, seed: int, yaw_rates: bool = False) -> Readings:
    """Seeded readings of a car that drives as the truth has it, at rest before and after."""
    rng = np.random.default_rng(seed)
    mount = mount_pose(drive.camera.ground)
    ego = mount @ drive.poses @ inverse(mount)
    twists = np.array([_planar(step).log() for step in inverse(ego[:-1]) @ ego[1:]])
    t_s = np.array([frame.t_source_ns for frame in drive.frames]) / NS_PER_S
    interval_s = float(np.median(np.diff(t_s)))
    width = min(2 * round(0.5 * SMOOTHED_S / interval_s) + 1, 2 * ((len(t_s) - 1) // 2) + 1)
    speed, turn = (
        PchipInterpolator(t_s, savgol_filter(np.append(0.0, np.cumsum(along)), width, 3, deriv=1, delta=interval_s))
        for along in (twists[:, 0], twists[:, 2])
    )
    out = []
    for now_s in np.arange(t_s[0] - 0.5, t_s[-1] + 0.5, 1.0 / RATE_HZ):
        held_s = float(np.clip(now_s - DELAY_S, t_s[0], t_s[-1]))
        read_mps = FACTOR * float(speed(held_s))
        sigma_mps = NOISE_REL * abs(read_mps)
        reading = SpeedReading(
            t_ns=round(now_s * NS_PER_S), speed_mps=read_mps + sigma_mps * rng.normal(), sigma_mps=sigma_mps
        )
        if yaw_rates:
            rate = float(turn(held_s)) + YAW_NOISE_RADPS * rng.normal()
            reading = _with(reading, yaw_rate_radps=rate, yaw_rate_sigma_radps=YAW_NOISE_RADPS)
        out.append(reading)
    return out


def _planar(T: Floats) -> SE2:
    return SE2(float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0], T[0, 0])))


def _with(reading: SpeedReading, **fields: Any) -> SpeedReading:
    return SpeedReading(**({name: getattr(reading, name) for name in reading.__struct_fields__} | fields))


def _each(change: Callable[[SpeedReading, float], SpeedReading | None]) -> Fault:
    """A fault that changes or loses each reading, by its time since the middle of the drive (s)."""

    def fault(readings: Readings, middle_s: float) -> Coming:
        changed = [(r.t_ns, change(r, r.t_ns / NS_PER_S - middle_s)) for r in readings]
        return [(come_ns, reading) for come_ns, reading in changed if reading is not None]

    return fault


def _stuck(readings: Readings, middle_s: float) -> Coming:
    held = [r for r in readings if r.t_ns / NS_PER_S < middle_s][-1]
    return [(r.t_ns, r if r.t_ns <= held.t_ns else _with(held, t_ns=r.t_ns)) for r in readings]


def _late(readings: Readings, middle_s: float) -> Coming:
    return [(r.t_ns + round(0.4 * NS_PER_S), r) for r in readings]


def _out_of_order(readings: Readings, middle_s: float) -> Coming:
    later_s = np.random.default_rng(0).uniform(0.0, 0.15, len(readings))
    return sorted((r.t_ns + round(late * NS_PER_S), r) for r, late in zip(readings, later_s, strict=True))


FAULTS: dict[str, Fault] = {
    "stuck at 30 m/s": _each(lambda r, _: _with(r, speed_mps=30.0, sigma_mps=0.3)),
    "stuck at 30 m/s from the middle": _each(lambda r, s: r if s < 0 else _with(r, speed_mps=30.0, sigma_mps=0.3)),
    "stuck at its last value": _stuck,
    "stuck at 0 from the middle": _each(lambda r, s: r if s < 0 else _with(r, speed_mps=0.0, sigma_mps=0.0)),
    "km/h": _each(lambda r, _: _with(r, speed_mps=3.6 * r.speed_mps, sigma_mps=3.6 * r.sigma_mps)),
    "half too fast": _each(lambda r, _: _with(r, speed_mps=1.5 * r.speed_mps)),
    "reversed": _each(lambda r, _: _with(r, speed_mps=-r.speed_mps)),
    "wheels spin, 50 % for 1 s": _each(lambda r, s: _with(r, speed_mps=1.5 * r.speed_mps) if 0 <= s < 1 else r),
    "half of them NaN": _each(lambda r, _: _with(r, speed_mps=float("nan")) if r.t_ns // 20_000_000 % 2 else r),
    "missing from the middle": _each(lambda r, s: r if s < 0 else None),
    "an hour ahead": _each(lambda r, _: _with(r, t_ns=r.t_ns + 3600 * NS_PER_S)),
    "0.4 s late": _late,
    "out of order": _out_of_order,
}


def measure(drive: Drive, readings: Coming, dark: bool = False) -> dict[str, Any]:
    """One drive's figures."""
    front_end, graph = FrontEnd(drive.camera, FrontEndConfig()), PoseGraph(GraphConfig(), WeightsConfig())
    consistency, mount = Consistency(drive.camera.ground), mount_pose(drive.camera.ground)
    rng = np.random.default_rng(5)
    estimates: list[Estimate] = []
    sources: Counter[str] = Counter()
    true_m, wrong = np.linalg.norm(np.diff(drive.poses[:, :3, 3], axis=0), axis=1), 0
    for k, (frame, seen) in enumerate(zip(drive.frames, drive.seen, strict=True)):
        now_ns = frame.t_source_ns
        come = tuple(reading for come_ns, reading in readings if now_ns - NS_PER_S < come_ns <= now_ns)
        image = frame.image
        if dark and image is not None:
            noisy = DARK_GAIN * image + DARK_GREY + DARK_NOISE_GREY * rng.normal(size=image.shape)
            image = np.clip(noisy, 0, 255).astype(np.uint8)
        measurements = front_end.measure(dataclasses.replace(frame, image=image, speeds=come), Known(seen))
        estimate = graph.optimise(measurements)
        consistency.add(estimate)
        estimates.append(estimate)
        sources["+".join(measurements.speed_sources)] += 1
        cc = measurements.cc
        if k and estimate.valid and cc is not None and cc.from_frame == drive.frames[k - 1].frame_id:
            off_m = abs(float(np.hypot(cc.T_from_to.x_m, cc.T_from_to.y_m)) - true_m[k - 1])
            wrong += off_m > max(SPEED_LIMIT * true_m[k - 1], SPEED_FLOOR_M)
    estimated = np.stack([inverse(mount) @ ego_pose(e.T_world_ego, e.attitude) @ mount for e in estimates])
    way_m, true_way_m = path_length_m(estimated), path_length_m(drive.poses)
    statuses = Counter(str(status) for estimate in estimates for status in estimate.status)
    return {
        "way_m": way_m,
        "true_way_m": true_way_m,
        "scale_error": way_m / true_way_m - 1.0,
        "ate_m": ate_m(drive.poses, estimated),
        "nees": consistency.report(drive.poses).nees,
        "scale_sigma_rel": float(np.median([estimate.scale_sigma_rel for estimate in estimates])),
        "frames": len(estimates),
        "valid": sum(estimate.valid for estimate in estimates),
        "wrong_valid": int(wrong),
        "epochs": estimates[-1].epoch + 1,
        "sources": dict(sources),
        "statuses": dict(statuses),
    }


def row_text(figures: dict[str, Any]) -> str:
    """A row for a person."""
    nees = "-" if figures["nees"] is None else f"{figures['nees']:.1f}"
    reported = {str(Status.MOTION_IMPLAUSIBLE), *(name for name in figures["statuses"] if name.startswith("car_speed"))}
    names = sorted(reported & set(figures["statuses"]))
    return (
        f"way {figures['scale_error']:+.2%}  ATE {figures['ate_m']:.2f} m  NEES {nees}  sigma "
        f"{figures['scale_sigma_rel']:.1%}  valid {figures['valid']}/{figures['frames']}, of them wrong "
        f"{figures['wrong_valid']}  " + ", ".join(f"{name} {figures['statuses'][name]}" for name in names)
    )
