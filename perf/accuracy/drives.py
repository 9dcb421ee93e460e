"""Recorded and rendered drives for benchmarks of the odometry: reading, estimation, comparison with the truth."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
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
from birdslam.runtime.configuration import Configuration, load
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.status import INVALIDATING
from birdslam.trajectory import as_poses, inverse
from birdslam.types import Frame, Status

Edit = Callable[[int, int, Image], Image]
Seen = tuple[Floats, Bools | None]  # boxes (M, 4), mask of the road

MIN_IMAGES = 13  # of a start near the end of a sequence
MIN_DISTANCE_M = 2.0  # of a start; the scale of a stationary car is undefined
SCALE_LIMIT, SPEED_LIMIT, SPEED_FLOOR_M = 0.05, 0.1, 0.05  # the floor is the noise of a true step
MIN_VISIBLE_RATIO = 0.05  # of a rendered body with a box
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Drive:
    """The images of a drive, and the true camera poses (N, 4, 4) relative to the first image."""

    camera: Camera
    images: list[Image]
    t_ns: list[int]
    poses: Floats
    seen: list[Seen]  # true bodies or results of networks: boxes (M, 4), road mask


def networks_of(options: argparse.Namespace) -> Configuration | None:
    """The configuration of the networks to run; None: no networks."""
    return with_networks(options.model) if options.networks or options.model else None


def with_networks(models: Sequence[str]) -> Configuration:
    """The default configuration with these networks (ROLE=PATH), which run on every frame."""
    return load(None, {f"models.{m.partition('=')[0]}.path": m.partition("=")[2] for m in models}).as_lossless()


def read(
    recording: Recording,
    edit: Edit | None = None,
    max_images: int = 10**6,
    configuration: Configuration | None = None,
    mirrored: bool = False,
) -> Drive:
    """At most `max_images` images, decoded once, undistorted and grey, on request mirrored left to right.

    `edit` takes an image's index, the number of images, and the image. Without networks (`configuration`), a rendered
    drive has the true boxes of visible bodies. Raises DatasetError.
    """
    truth = recording.truth_poses()
    if truth is None:
        raise DatasetError(f"{recording.name}: has no true poses to compare with")
    T, count = recording.T_cam0_cam(), min(len(recording), max_images)
    poses = from_first(inverse(T) @ as_poses(truth[:count]) @ T)
    undistort, camera = Undistorter(recording.camera), recording.camera
    if mirrored:
        camera, poses = mirrored_camera(camera), _MIRROR @ poses @ _MIRROR
    images: list[Image] = []
    t_ns, seen = [], []
    with _looks(recording, configuration) as look:
        for frame in itertools.islice(recording.frames(), count):
            if frame.image is None:
                raise DatasetError(f"{recording.name}: image {frame.index}: {frame.error}")
            image = undistort(frame.image)
            if edit is not None:
                image = edit(frame.index, count, image)
            if mirrored:
                image = np.ascontiguousarray(image[:, ::-1])
            seen.append(look(Frame(frame.index, frame.t_source_ns, frame.index, frame.index, image)))
            images.append(image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
            t_ns.append(frame.t_source_ns)
    return Drive(camera, images, t_ns, poses, seen)


def mirrored_camera(camera: Camera) -> Camera:
    """The camera of images mirrored left to right."""
    return msgspec.structs.replace(camera, cx_px=camera.width_px - 1 - camera.cx_px, roll_rad=-camera.roll_rad)


@contextmanager
def _looks(recording: Recording, configuration: Configuration | None) -> Iterator[Callable[[Frame], Seen]]:
    """What is seen in an image: by the networks, or the true bodies of a rendered drive; else nothing."""
    if configuration is None:
        yield partial(_true_bodies, recording)
        return
    with Inference(configuration) as inference:

        def look(frame: Frame) -> Seen:
            found = inference.start(frame).result()
            boxes = np.zeros((0, 4)) if found.detections is None else found.detections.boxes_px
            return boxes, None if found.segmentation is None else found.segmentation.road

        yield look


def _true_bodies(recording: Recording, frame: Frame) -> Seen:
    bodies = recording.truth_bodies(frame.frame_id) if isinstance(recording, DemoRecording) else ()
    boxes = [body.box_px for body in bodies if body.visible > MIN_VISIBLE_RATIO]
    return np.array(boxes, np.float64).reshape(-1, 4), None


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
