"""How soon and how well the ego-motion finds its metres: cold starts from all along a recorded drive.

    python -m perf starts [SEQUENCE ...] [--output DIR] [--data DIR] [--networks] [--model ROLE=PATH ...]

From every `--every`-th image of each sequence (kitti:DIR, or a folder of `--data`) the odometry begins anew, and runs
over `--images` images: as recorded, mirrored left to right (the principal point as well), and over every second image.
Without networks unless some are asked for; what they say of an image is then kept for all the starts that show it.

Writes starts.json, a row of figures for each sequence and variant with the curves of every start, and starts.png: the
errors of scale and rotation over the way since the start.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from birdslam.bench.ego import truth_quality
from birdslam.bench.ego.trajectory_errors import from_first
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.perception import ModelError
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.configuration import Configuration, SourceConfig, load
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.process.workers import workers
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.status import INVALIDATING
from birdslam.trajectory import as_poses, inverse
from birdslam.types import Frame, Status

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Image = NDArray[np.uint8]
Edit = Callable[[int, int, Image], Image]

label = "cold starts along recorded drives: scale and rotation against the way since the start"

SEQUENCES = (
    "kitti_odometry/sequences/00",
    "kitti_odometry/sequences/01",
    "kitti_odometry/sequences/06",
    "kitti_tracking/training/image_03/0005",
)
VARIANTS = (("as recorded", False, 1), ("mirrored", True, 1), ("every second image", False, 2))
LEAST_IMAGES = 13  # of a start near the end of a sequence, which has no more
LEAST_WAY_M = 2.0  # of a start: a standing car has no scale
SCALE_LIMIT, SPEED_LIMIT, SPEED_FLOOR_M = 0.05, 0.1, 0.05  # the floor: a true step is known to a few centimetres
_COUNTS = ("n", "over_limit", "wrong_valid", "wrong_valid_truth_doubtful")
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Drive:
    """The images of one variant of a sequence, and where its camera was, (N, 4, 4) from the first image."""

    camera: Camera
    images: list[Image]
    t_ns: list[int]
    poses: Floats
    seen: list[tuple[Floats, Bools | None]]  # by networks: boxes (M, 4), the road


@dataclass(frozen=True)
class Task:
    """One process's work: one variant of one sequence."""

    uri: str
    name: str
    mirrored: bool
    stride: int
    every: int
    images: int
    configuration: Configuration | None  # None: without networks


def run(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m perf starts", description=label)
    add_drive_options(parser)
    parser.add_argument("--every", type=int, default=5, help="images from one start to the next")
    parser.add_argument("--images", type=int, default=25, help="of each start")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--output", type=Path, help="folder of starts.json and starts.png")
    options = parser.parse_args(arguments)
    if min(options.every, options.jobs) < 1 or options.images < LEAST_IMAGES:
        raise PerfError(f"--every and --jobs must be at least 1, --images at least {LEAST_IMAGES}")
    configuration = networks_of(options)
    tasks = [
        Task(uri_of(sequence, options.data), name, mirrored, stride, options.every, options.images, configuration)
        for sequence in options.sequences or SEQUENCES
        for name, mirrored, stride in VARIANTS
    ]
    path = None if options.output is None else options.output / "starts.json"
    settings = {"every": options.every, "images": options.images, "networks": configuration is not None}
    try:
        with Ledger(path, label, **settings) as ledger, workers(min(options.jobs, len(tasks))) as pool:
            for task, (sequence, starts) in zip(tasks, pool.map(measure, tasks), strict=True):
                figures = summary(starts)
                ledger.add(f"{sequence} {task.name}", told(figures), **figures, starts=starts)
            rows = ledger.content["rows"]
            total = {key: sum(row[key] for row in rows) for key in _COUNTS}
            ledger.set(total=total)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error
    print(
        f"{total['n']} starts, {total['over_limit']} with a scale off by more than {SCALE_LIMIT:.0%}, "
        f"{total['wrong_valid']} valid frames with a speed off by more than {SPEED_LIMIT:.0%}, of them "
        f"{total['wrong_valid_truth_doubtful']} where the truth is doubtful"
    )
    if options.output is not None:
        draw(rows, options.output / "starts.png")
        print(f"results in {options.output}")


def add_drive_options(parser: argparse.ArgumentParser) -> None:
    """Which drives, and which networks look at them."""
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="kitti:DIR, or a folder of --data")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BIRDSLAM_DATA", "../shared/data")))
    parser.add_argument("--networks", action="store_true", help="with the configured networks")
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="with this network")


def networks_of(options: argparse.Namespace) -> Configuration | None:
    """The configuration whose networks are to run; None: none are."""
    if not options.networks and not options.model:
        return None
    configuration = load(None, {f"models.{m.partition('=')[0]}.path": m.partition("=")[2] for m in options.model})
    return msgspec.structs.replace(configuration, source=SourceConfig(rate="max"))


def uri_of(sequence: str, data: Path) -> str:
    return sequence if ":" in sequence else f"kitti:{data / sequence}"


def measure(task: Task) -> tuple[str, list[dict[str, Any]]]:
    """The sequence's name, and what each start of one variant of it came to."""
    cv2.setNumThreads(1)
    name, drive = read(task)
    count = len(drive.images)
    starts = []
    interpolated = truth_quality.interpolated(drive.poses)
    doubtful = truth_quality.doubtful(drive.poses, np.array(drive.t_ns, np.int64))
    for first in range(0, count - LEAST_IMAGES + 1, task.every):
        start = cold_start(drive, range(first, min(first + task.images, count)))
        if start is not None:
            # Counted among the wrong ones, and beside them: their truth is no measurement, or of no car
            doubted = [frame for frame in start["wrong_valid"] if doubtful[frame]]
            begins = bool(interpolated[first + 1])
            starts.append(start | {"truth_interpolated": begins, "wrong_valid_truth_doubtful": doubted})
    return name, starts


def read(task: Task, edit: Edit | None = None) -> tuple[str, Drive]:
    """The sequence, its images decoded once, undistorted and grey, and mirrored where that is asked for.

    `edit` takes an image's index, the number of images, and the image.
    """
    recording = open_recording(task.uri, stride=task.stride)
    truth = recording.truth_poses()
    if truth is None:
        raise DatasetError(f"{task.uri}: has no true poses to compare with")
    T = recording.T_cam0_cam()
    poses = from_first(inverse(T) @ as_poses(truth) @ T)
    undistort, camera = Undistorter(recording.camera), recording.camera
    if task.mirrored:
        camera, poses = mirrored_camera(camera), _MIRROR @ poses @ _MIRROR
    images: list[Image] = []
    t_ns, seen = [], []
    for frame, looked in zip(recording.frames(), _looks(task.configuration), strict=False):
        if frame.image is None:
            raise DatasetError(f"{task.uri}: image {frame.index}: {frame.error}")
        image = undistort(frame.image)
        if edit is not None:
            image = edit(frame.index, len(recording), image)
        if task.mirrored:
            image = np.ascontiguousarray(image[:, ::-1])
        seen.append(looked(Frame(frame.index, frame.t_source_ns, frame.index, frame.index, image)))
        images.append(image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
        t_ns.append(frame.t_source_ns)
    return recording.name, Drive(camera, images, t_ns, poses, seen)


def mirrored_camera(camera: Camera) -> Camera:
    """Of images mirrored left to right."""
    return msgspec.structs.replace(camera, cx_px=camera.width_px - 1 - camera.cx_px, roll_rad=-camera.roll_rad)


def _looks(configuration: Configuration | None) -> Iterator[Any]:
    """For each image in its order, what takes it and gives the networks' boxes and road."""
    if configuration is None:
        yield from itertools.repeat(lambda frame: (np.zeros((0, 4)), None))
        return
    with Inference(configuration) as inference:

        def look(frame: Frame) -> tuple[Floats, Bools | None]:
            found = inference.start(frame).result()
            boxes = np.zeros((0, 4)) if found.detections is None else found.detections.boxes_px
            return boxes, None if found.segmentation is None else found.segmentation.road

        while True:
            yield look


def cold_start(drive: Drive, over: range) -> dict[str, Any] | None:
    """The odometry from nothing over some images of a drive; None where the car does not move."""
    return errors(drive, over, *follow(drive, over))


def follow(drive: Drive, over: range) -> tuple[Floats, list[Motion]]:
    """Where the odometry has the camera at each of the images, (N, 4, 4) from the first one, and all its motions."""
    odometry = Odometry(drive.camera)
    poses = {over[0]: np.eye(4)}
    motions: list[Motion] = []
    for k in over:
        motion = odometry.estimate(odometry.track(drive.images[k]), k, drive.t_ns[k], *drive.seen[k])
        poses[k] = poses.get(k - 1, np.eye(4))
        if motion is not None:
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = motion.R_prev_curr, motion.t_prev_curr_m
            poses[k] = poses.get(motion.from_frame, poses[k]) @ step
            motions.append(motion)
    return np.stack([poses[k] for k in over]), motions


def errors(drive: Drive, over: range, estimated: Floats, motions: Sequence[Motion]) -> dict[str, Any] | None:
    """What `follow` gave against the truth; None where the car does not move."""
    truth = drive.poses[over.start : over.stop]
    way, true_way = (_way_m(track) for track in (estimated, truth))
    if true_way[-1] < LEAST_WAY_M:
        return None
    turned = inverse(inverse(truth[0]) @ truth) @ estimated
    rotation_deg = np.degrees(Rotation.from_matrix(turned[:, :3, :3]).magnitude())
    moved = true_way >= 0.5
    return {
        "first": over[0],
        "images": len(over),
        "true_way_m": true_way[moved].round(3).tolist(),
        "scale_error": (way[moved] / true_way[moved] - 1.0).round(4).tolist(),
        "rotation_error_deg": rotation_deg[moved].round(3).tolist(),
        "valid": sum(is_valid(motion) for motion in motions),
        "wrong_valid": [motion.to_frame for motion in motions if is_valid(motion) and is_wrong(motion, drive.poses)],
        "standstill": sum(Status.STANDSTILL in motion.status for motion in motions),
    }


def _way_m(poses: Floats) -> Floats:
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def is_valid(motion: Motion) -> bool:
    return not INVALIDATING & set(motion.status)


def is_wrong(motion: Motion, poses: Floats) -> bool:
    """Whether its length is off by more than SPEED_LIMIT, and by more than the truth's own noise."""
    true_m = float(np.linalg.norm(poses[motion.to_frame, :3, 3] - poses[motion.from_frame, :3, 3]))
    off_m = abs(float(np.linalg.norm(motion.t_prev_curr_m)) - true_m)
    return off_m > max(SPEED_LIMIT * true_m, SPEED_FLOOR_M)


def summary(starts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the starts of one variant came to, at the end of each."""
    scale = np.array([start["scale_error"][-1] for start in starts])
    rotation_deg = np.array([start["rotation_error_deg"][-1] for start in starts])
    if not len(scale):
        counts = ("n", "over_limit", "over_limit_interpolated", "wrong_valid", "wrong_valid_truth_doubtful")
        return dict.fromkeys(counts, 0)
    interpolated = np.array([start["truth_interpolated"] for start in starts])
    images = sum(start["images"] - 1 for start in starts)
    return {
        "n": len(starts),
        "scale_median": float(np.median(scale)),
        "scale_worst": float(scale[np.abs(scale).argmax()]),
        "over_limit": int((np.abs(scale) > SCALE_LIMIT).sum()),
        "over_limit_interpolated": int((np.abs(scale[interpolated]) > SCALE_LIMIT).sum()),
        "rotation_median_deg": float(np.median(rotation_deg)),
        "rotation_worst_deg": float(rotation_deg.max()),
        "valid_share": sum(start["valid"] for start in starts) / images,
        "wrong_valid": sum(len(start["wrong_valid"]) for start in starts),
        "wrong_valid_truth_doubtful": sum(len(start["wrong_valid_truth_doubtful"]) for start in starts),
        "standstill": sum(start["standstill"] for start in starts),
    }


def told(figures: dict[str, Any]) -> str:
    """A row for a person."""
    if not figures["n"]:
        return "no start: too short, or the car stands"
    return (
        f"{figures['n']:3} starts  scale median {figures['scale_median']:+.1%} worst {figures['scale_worst']:+.1%} "
        f"(over {SCALE_LIMIT:.0%}: {figures['over_limit']})  rotation median {figures['rotation_median_deg']:.2f} "
        f"worst {figures['rotation_worst_deg']:.2f} deg  valid {figures['valid_share']:.0%}, "
        f"of them wrong {figures['wrong_valid']} ({figures['wrong_valid_truth_doubtful']} where the truth is "
        "interpolated or accelerates as no car does)"
        + f"; {figures['over_limit_interpolated']} of those over begin where the truth is interpolated"
    )


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Each start a line."""
    figure, grid = plt.subplots(len(rows), 2, figsize=(12, 2.2 * len(rows)), squeeze=False, sharex=True)
    for row, (scale, rotation) in zip(rows, grid, strict=True):
        for start in row["starts"]:
            scale.plot(start["true_way_m"], 100.0 * np.array(start["scale_error"]), linewidth=0.8)
            rotation.plot(start["true_way_m"], start["rotation_error_deg"], linewidth=0.8)
        for side in (-1.0, 1.0):
            scale.axhline(side * 100.0 * SCALE_LIMIT, color="k", linestyle=":", linewidth=1)
        scale.set(ylabel="way, % off", ylim=(-30, 30), title=row["name"])
        rotation.set(ylabel="rotation, deg off", ylim=(0, 5))
    for axes in grid.ravel():
        axes.grid(True, alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel("true way since the start, m")
    figure.tight_layout()
    figure.savefig(path, dpi=70)
    plt.close(figure)
