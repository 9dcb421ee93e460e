"""Consistency of the scale of one video at other sizes and rates, and with later starts.

    python -m perf films [FILM ...] [--part PART ...] [--seconds S] [--begin-at S ...] [--output FILE.json] [--data DIR]
                         [--networks] [--model ROLE=PATH ...]

The odometry processes each variant (film_variants.py) with the same fixed camera file of CAMERAS.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.ego.trajectory_errors import from_first
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.odometry.odometry import Odometry
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import is_valid, networks_of
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.robustness.film_figures import (
    BEGINNING_S,
    Step,
    TrueSpeed,
    over,
    row_text,
    summary,
)
from birdslam.perf.robustness.film_variants import PARTS, Timed, Variant, variants
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.trajectory import as_poses, inverse
from birdslam.types import NS_PER_S, Frame

label = "consistency of the scale of one video at other sizes and rates, and with later starts"

Floats = NDArray[np.float64]
Seen = tuple[Floats, NDArray[np.bool_] | None]  # boxes (N, 4) and the road (H, W) from networks
BEGINS_S = {"starts": (0.0, 5.0, 12.0)}  # start times; other parts start at 0
SECONDS = 5.0  # duration of each variant


@dataclass(frozen=True)
class Film:
    """A video: its source and its truth."""

    uri: str  # {data} is the folder of data
    gps: str | None = None  # file of times and speeds
    speed_mps: float | None = None  # constant speed
    camera: str | None = None  # the film whose camera file it shares


FILMS = {
    "town": Film("video:{data}/dashcam/town.mp4", gps="dashcam/town_gps.csv"),
    # The field of view that matches GPS: not a test of the scale, but of the rest
    "town_72": Film("video:{data}/dashcam/town.mp4", gps="dashcam/town_gps.csv"),
    "overtaken": Film(
        "video:{data}/dashcam/town_overtaken.mp4", gps="dashcam/town_overtaken_gps.csv", camera="town_72"
    ),
    "motorway": Film("video:{data}/highway/solidWhiteRight.mp4", speed_mps=25.4),
    "00": Film("kitti:{data}/kitti_odometry/sequences/00"),
    "0005": Film("kitti:{data}/kitti_tracking/training/image_03/0005"),
    "06": Film("kitti:{data}/kitti_odometry/sequences/06"),
    "01": Film("kitti:{data}/kitti_odometry/sequences/01"),
}
DEFAULT = ("town", "town_72", "overtaken", "motorway", "00", "0005")
# Camera files of `birdslam calibrate`, fixed, so that the table compares variants and not calibrations
CAMERAS = Path(__file__).resolve().parents[1] / "film_cameras"


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("films", label)
    parser.add_argument("films", nargs="*", metavar="FILM", help=f"of {', '.join(FILMS)}")
    parser.add_argument("--part", action="append", choices=PARTS, help="only this part; repeatable")
    parser.add_argument("--begin-at", type=float, nargs="+", metavar="S", help="start times in the film")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="duration of each variant")
    add_data(parser)
    add_networks(parser)
    options = parser.parse_args(arguments)
    unknown = set(options.films) - set(FILMS)
    if unknown:
        raise PerfError(f"{', '.join(sorted(unknown))}: unknown film; expected one of {', '.join(FILMS)}")
    cv2.setNumThreads(1)
    try:
        measure_all(options)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error


def measure_all(options: argparse.Namespace) -> None:
    """Measures each variant of each part of each film."""
    configuration = networks_of(options)
    with Ledger(options.output, label, seconds=options.seconds, networks=configuration is not None) as ledger:
        for name in options.films or DEFAULT:
            film = FILMS[name]
            camera = camera_of(name)
            recording = open_recording(film.uri.format(data=options.data), camera)
            true_mps = truth(film, recording, options.data)
            for part in options.part or PARTS:
                for begin_s in options.begin_at or BEGINS_S.get(part, (0.0,)):
                    span_s = begin_s, begin_s + options.seconds
                    seen = looks(recording, span_s, configuration)
                    unchanged: dict[str, Any] | None = None
                    for variant in variants(recording.camera, part):
                        steps = drive(recording, variant, span_s, true_mps, seen)
                        if not steps or steps[-1].t_s <= BEGINNING_S:
                            continue  # the film ends before its speed counts
                        figures = summary(steps)
                        unchanged = unchanged or figures
                        figures["way_over_unchanged"] = over(figures, unchanged)
                        started = "" if begin_s == 0.0 else f", from {begin_s:g} s"
                        ledger.add(
                            f"{name}: {variant.name}{started}", row_text(figures), film=name, part=part, **figures
                        )


def camera_of(name: str) -> Camera | None:
    """The fixed camera of a film; None for a recording with a camera file."""
    path = CAMERAS / f"{FILMS[name].camera or name}.toml"
    return load_camera(path) if path.is_file() else None


def drive(
    recording: Recording,
    variant: Variant,
    span_s: tuple[float, float],
    true_mps: TrueSpeed,
    looks: Callable[[int], Seen],
) -> list[Step]:
    """Runs the odometry on a variant of a film from `span_s`[0] to `span_s`[1], with the networks' results by time."""
    camera = variant.camera(recording.camera)
    odometry, undistort = Odometry(camera), Undistorter(camera)
    steps, times_ns = list[Step](), list[int]()
    for k, (t_ns, raw) in enumerate(variant.images(_within(recording, span_s))):
        times_ns.append(t_ns)
        boxes_px, road = _at_size(looks(t_ns), recording.camera, camera)
        motion = odometry.estimate(odometry.track(undistort(raw)), k, t_ns, boxes_px, road)
        begin_ns = times_ns[k if motion is None else motion.from_frame]
        if motion is None or begin_ns == t_ns:
            continue
        begin_s, end_s = begin_ns / NS_PER_S, t_ns / NS_PER_S
        mps = float(np.linalg.norm(motion.t_prev_curr_m)) / (end_s - begin_s)
        at_s = end_s - times_ns[0] / NS_PER_S
        true, sigma_rel = true_mps(begin_s, end_s), math.hypot(motion.scale_sigma_rel, camera.scale_sigma_rel)
        steps.append(Step(at_s, end_s - begin_s, mps, true, is_valid(motion), sigma_rel, motion.standstill))
    return steps


def looks(
    recording: Recording, span_s: tuple[float, float], configuration: Configuration | None
) -> Callable[[int], Seen]:
    """The networks' results on the unchanged film as a function of time: those of the newest image."""
    nothing: Seen = (np.zeros((0, 4)), None)
    if configuration is None:
        return lambda t_ns: nothing
    undistort, seen = Undistorter(recording.camera), dict[int, Seen]()
    with Inference(complete(configuration, recording.camera, recording.rate_hz)) as inference:
        for k, (t_ns, raw) in enumerate(_within(recording, span_s)):
            found = inference.start(Frame(k, t_ns, t_ns, 0, undistort(raw))).result()
            boxes_px = nothing[0] if found.detections is None else found.detections.boxes_px
            seen[t_ns] = boxes_px, None if found.segmentation is None else found.segmentation.road
    times_ns = np.array(list(seen), np.int64)
    return lambda t_ns: seen[int(times_ns[max(int(np.searchsorted(times_ns, t_ns, side="right")) - 1, 0)])]


def _at_size(seen: Seen, given: Camera, camera: Camera) -> Seen:
    """Scales the networks' results from the images of one camera to those of another size."""
    boxes_px, road = seen
    width_px, height_px = camera.width_px, camera.height_px
    if (width_px, height_px) == (given.width_px, given.height_px):
        return seen
    boxes_px = (boxes_px + 0.5) * np.tile([width_px / given.width_px, height_px / given.height_px], 2) - 0.5
    if road is not None:
        road = cv2.resize(road.astype(np.uint8), (width_px, height_px), interpolation=cv2.INTER_NEAREST) > 0
    return boxes_px, road


def truth(film: Film, recording: Recording, data: Path) -> TrueSpeed:
    """The true speed, from the film or from the recording's poses. Raises DatasetError."""
    if film.speed_mps is not None:
        speed_mps = film.speed_mps
        return lambda begin_s, end_s: speed_mps
    if film.gps is not None:
        t_s, *_, mps = np.loadtxt(data / film.gps, delimiter=",", skiprows=1).T
        return lambda begin_s, end_s: float(np.interp(0.5 * (begin_s + end_s), t_s, mps))
    rows = recording.truth_poses()
    if rows is None:
        raise DatasetError(f"{film.uri}: has no truth")
    T = recording.T_cam0_cam()
    at_m = from_first(inverse(T) @ as_poses(rows) @ T)[:, :3, 3]
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at_m, axis=0), axis=1)))
    times_s = np.array([frame.t_source_ns / NS_PER_S for frame in recording.frames()])

    def by_poses(begin_s: float, end_s: float) -> float:
        return float(np.diff(np.interp([begin_s, end_s], times_s, way_m))[0] / (end_s - begin_s))

    return by_poses


def _within(recording: Recording, span_s: tuple[float, float]) -> Iterator[Timed]:
    first_ns: int | None = None
    for frame in recording.frames():
        first_ns = frame.t_source_ns if first_ns is None else first_ns
        at_s = (frame.t_source_ns - first_ns) / NS_PER_S
        if at_s >= span_s[1]:
            return
        if frame.image is not None and at_s >= span_s[0]:
            yield frame.t_source_ns, frame.image
