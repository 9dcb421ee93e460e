"""Recorded drives for benchmarks of the odometry: reading, estimation, and comparison with the truth."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.bench.ego.trajectory_errors import from_first
from birdslam.geometry.arrays import Bools, Floats, Image
from birdslam.geometry.camera import Camera, Undistorter
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.perf.reporting.arguments import add_data, add_networks
from birdslam.runtime.configuration import Configuration, load
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.status import INVALIDATING
from birdslam.trajectory import as_poses, inverse
from birdslam.types import Frame, Status

Edit = Callable[[int, int, Image], Image]

SEQUENCES = (
    "kitti_odometry/sequences/00",
    "kitti_odometry/sequences/01",
    "kitti_odometry/sequences/06",
    "kitti_tracking/training/image_03/0005",
)
MIN_IMAGES = 13  # of a start near the end of a sequence
MIN_DISTANCE_M = 2.0  # of a start; the scale of a stationary car is undefined
SCALE_LIMIT, SPEED_LIMIT, SPEED_FLOOR_M = 0.05, 0.1, 0.05  # the floor is the noise of a true step
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Drive:
    """The images of one variant of a sequence, and the true camera poses (N, 4, 4) relative to the first image."""

    camera: Camera
    images: list[Image]
    t_ns: list[int]
    poses: Floats
    seen: list[tuple[Floats, Bools | None]]  # results of networks: boxes (M, 4), road mask


@dataclass(frozen=True)
class Task:
    """The work of one process: one variant of one sequence."""

    uri: str
    name: str
    mirrored: bool
    stride: int
    every: int
    images: int
    configuration: Configuration | None  # None: without networks


def add_drive_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options for drives and networks."""
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="kitti:DIR, or a folder of --data")
    add_data(parser)
    add_networks(parser)


def networks_of(options: argparse.Namespace) -> Configuration | None:
    """The configuration of the networks to run; None: no networks."""
    return with_networks(options.model) if options.networks or options.model else None


def with_networks(models: Sequence[str]) -> Configuration:
    """The default configuration with these networks (ROLE=PATH), which run on every frame."""
    return load(None, {f"models.{m.partition('=')[0]}.path": m.partition("=")[2] for m in models}).as_lossless()


def uri_of(sequence: str, data: Path) -> str:
    """The URI of a recording, of a folder with a rendered `drive.npz`, or of a KITTI folder of the data."""
    rendered = (Path(sequence) / "drive.npz").is_file()
    return sequence if ":" in sequence or rendered else f"kitti:{data / sequence}"


def _open(task: Task) -> Recording:
    """Opens the recording. Raises DatasetError."""
    if ":" in task.uri:
        return open_recording(task.uri, stride=task.stride)
    if task.stride != 1:
        raise DatasetError(f"{task.uri}: a rendered drive cannot be read in parts")
    recording = DemoRecording(Path(task.uri))
    recording.name = Path(task.uri).resolve().name
    return recording


def read(task: Task, edit: Edit | None = None) -> tuple[str, Drive]:
    """The sequence with its images decoded once, undistorted and grey, mirrored on request.

    `edit` takes an image's index, the number of images, and the image.
    """
    recording = _open(task)
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
    for frame, looked in zip(recording.frames(), _network_results(task.configuration), strict=False):
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
    """The camera of images mirrored left to right."""
    return msgspec.structs.replace(camera, cx_px=camera.width_px - 1 - camera.cx_px, roll_rad=-camera.roll_rad)


def _network_results(configuration: Configuration | None) -> Iterator[Any]:
    """Yields a function from an image to the networks' boxes and road, to be called for each image in order."""
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
    """A cold start of the odometry over some images of a drive; None if the car does not move."""
    return errors(drive, over, *follow(drive, over))


def follow(drive: Drive, over: range) -> tuple[Floats, list[Motion]]:
    """The odometry's camera poses (N, 4, 4) relative to the first image, and all its motions."""
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
    """Errors of the result of `follow`; None if the car does not move."""
    truth = drive.poses[over.start : over.stop]
    way, true_way = (_distance_m(track) for track in (estimated, truth))
    if true_way[-1] < MIN_DISTANCE_M:
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


def _distance_m(poses: Floats) -> Floats:
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def is_valid(motion: Motion) -> bool:
    return not INVALIDATING & set(motion.status)


def is_wrong(motion: Motion, poses: Floats) -> bool:
    """Whether its length is wrong by more than SPEED_LIMIT and by more than the noise of the truth."""
    true_m = float(np.linalg.norm(poses[motion.to_frame, :3, 3] - poses[motion.from_frame, :3, 3]))
    off_m = abs(float(np.linalg.norm(motion.t_prev_curr_m)) - true_m)
    return off_m > max(SPEED_LIMIT * true_m, SPEED_FLOOR_M)
