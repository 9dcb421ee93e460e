"""Exports the results of a drive: images and camera poses for COLMAP and nerfstudio, trajectories for TUM and KITTI."""

from __future__ import annotations

import csv
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.odometry.corners.feature_tracks import FeatureConfig, FeatureTracker
from birdslam.outputs.drive_files import FRAMES_FILE, ResultsError
from birdslam.outputs.final_trajectories import EGO_FILES
from birdslam.outputs.posed_images import PosedImage, PosedImages, write_image, write_kitti, write_tum
from birdslam.runtime.nodes.sources import open_recorded, recording_uri
from birdslam.runtime.progress import with_progress
from birdslam.sources.recording import DatasetError
from birdslam.trajectory import Transform, mount_pose, read_tum
from birdslam.types import NS_PER_S, Frame

GEOJSON = "ego.geojson"
MODELS: dict[str, Callable[[PosedImages, Path], int]] = {
    "colmap": PosedImages.write_colmap,
    "nerfstudio": PosedImages.write_nerfstudio,
}
TRAJECTORIES: dict[str, Callable[[Path, Sequence[int], Sequence[Transform]], None]] = {
    "tum": write_tum,
    "kitti": write_kitti,
}
FORMATS = (*MODELS, *TRAJECTORIES, "geojson")
_NS_PER_US = 1000  # the resolution of frames.csv


@dataclass(frozen=True)
class DrivePoses:
    """The valid poses of a drive's longest epoch, by source time in microseconds, in a world with z up."""

    camera: Camera
    uri: str
    stride: int
    T_world_cam: dict[int, Transform]
    left_out: int  # invalid frames, and those of other epochs


def export_drive(drive: Path, form: str, output: Path, images: str = "", spacing_m: float = 0.5) -> list[str]:
    """Writes the drive in one of FORMATS to `output`, a file (tum, kitti, geojson) or a directory; returns a summary.

    `images`: source of the frames, in place of the drive's own; one is exported every `spacing_m`. Raises ResultsError
    or DatasetError.
    """
    if not drive.is_dir():
        raise ResultsError(
            f"{drive}: is not the folder of a drive; birdslam run --output writes one, "
            "for a recording birdslam replay FILE.mcap --output DIR"
        )
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ResultsError(f"{output}: exists already; name a new file or directory")
    try:
        if form == "geojson":
            if not (drive / GEOJSON).is_file():
                raise ResultsError(f"{drive}: has no position on Earth; run the drive with --gnss")
            shutil.copyfile(drive / GEOJSON, output)
            return [f"{output}: the trajectory on Earth"]
        poses = read_poses(drive)
        if form in TRAJECTORIES:
            times_ns = [time_us * _NS_PER_US for time_us in poses.T_world_cam]
            TRAJECTORIES[form](output, times_ns, list(poses.T_world_cam.values()))
            return [f"{output}: {len(times_ns)} camera poses", *_left_out(poses)]
        posed = _posed_images(poses, output, images, spacing_m)
        points = MODELS[form](posed, output)
        return [f"{output}: {len(posed.images)} images and {points} points, in metres", *_left_out(poses)]
    except OSError as error:
        raise ResultsError(f"{error.filename or output}: {error.strerror or error}") from None


def read_poses(drive: Path) -> DrivePoses:
    """Reads the camera poses of a drive's folder, smoothed ones if available. Raises ResultsError."""
    try:
        settings: dict[str, Any] = msgspec.json.decode((drive / "summary.json").read_bytes())["configuration"]
        camera = msgspec.convert(settings["camera"], Camera)
        uri, stride = str(settings["source"]["uri"]), int(settings["source"]["stride"])
        with (drive / FRAMES_FILE).open(encoding="ascii", newline="") as file:
            rows = [(round(float(row["t_s"]) * 1e6), row["epoch"], row["valid"] == "1") for row in csv.DictReader(file)]
        final = drive / EGO_FILES["ego.tum.txt"]
        t_s, T_world_ego = read_tum(final if final.is_file() else drive / "ego.tum.txt")
    except OSError as error:
        raise ResultsError(f"{error.filename}: {error.strerror}; is this the folder of a finished drive?") from None
    except (KeyError, TypeError, ValueError, msgspec.MsgspecError) as error:
        raise ResultsError(f"{drive}: is not the folder of a drive of this version: {error}") from None
    longest = Counter(epoch for _, epoch, valid in rows if valid).most_common(1)
    if not longest:
        raise ResultsError(f"{drive}: has no valid frame to export")
    ego = dict(zip(np.rint(t_s * 1e6).astype(np.int64).tolist(), T_world_ego, strict=True))
    mount = mount_pose(camera.ground)
    kept = [time_us for time_us, epoch, valid in rows if valid and epoch == longest[0][0] and time_us in ego]
    return DrivePoses(camera, uri, stride, {time_us: ego[time_us] @ mount for time_us in kept}, len(rows) - len(kept))


def _posed_images(poses: DrivePoses, output: Path, images: str, spacing_m: float) -> PosedImages:
    """Writes the images to `output`, one every `spacing_m`, and tracks their features."""
    (output / "images").mkdir(parents=True, exist_ok=True)
    camera = msgspec.structs.replace(poses.camera, distortion=(), fisheye=False)
    posed, tracker = PosedImages(camera), FeatureTracker(camera.width_px, camera.height_px, FeatureConfig())
    last_m: np.ndarray[Any, np.dtype[np.float64]] | None = None
    for frame in _frames(poses, images):
        if frame.image is None:
            continue
        tracks = tracker.track(frame.image)
        tracker.accept(tracks)
        T_world_cam = poses.T_world_cam.get(round(frame.t_source_ns / _NS_PER_US))
        if T_world_cam is None or (last_m is not None and np.linalg.norm(T_world_cam[:3, 3] - last_m) < spacing_m):
            continue
        name, last_m = f"{frame.frame_id:06d}.jpg", T_world_cam[:3, 3]
        write_image(output / "images" / name, frame.image)
        px = np.asarray(tracks.px, np.float64)
        posed.add(PosedImage(name, frame.t_source_ns, T_world_cam, tracks.ids, px), frame.image)
    if not posed.images:
        raise DatasetError(f"{images or poses.uri}: has no frame at the times of this drive; name one with --images")
    return posed


def _frames(poses: DrivePoses, images: str) -> Iterator[Frame]:
    """Yields the undistorted frames of the drive's source, up to its last pose."""
    uri = recording_uri(images or poses.uri)
    try:
        recording = open_recorded(uri, poses.camera, poses.stride)
    except DatasetError as error:
        raise DatasetError(f"{error}; name the source of the frames with --images") from None
    last_us = max(poses.T_world_cam)
    for frame in with_progress(recording.undistorted_frames(), "export", len(recording) or None):
        if frame.t_source_ns > last_us * _NS_PER_US + NS_PER_S:
            return
        yield frame


def _left_out(poses: DrivePoses) -> list[str]:
    return [f"left out: {poses.left_out} frames that are invalid or of another epoch"] * (poses.left_out > 0)
