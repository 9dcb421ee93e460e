"""Recorded drives by their URI: KITTI odometry, tracking, raw drives and clips, video files, and the shipped drive."""

from __future__ import annotations

from pathlib import Path

from birdslam.datasets.demo import DemoRecording
from birdslam.datasets.kitti import KittiRecording, image_size
from birdslam.datasets.recording import DatasetError, Recording
from birdslam.datasets.speed_file import with_speeds
from birdslam.datasets.video import VideoRecording, video_size
from birdslam.geometry.camera import Camera


def open_recording(uri: str, camera: Camera | None = None, stride: int = 1, speeds: Path | None = None) -> Recording:
    """Open `kitti:DIR`, `video:FILE` or `demo`, the drive that ships with birdslam, every `stride`-th frame of it;
    `demo:DIR` is another drive of the built-in world.

    `camera` goes before the recording's own calibration. `speeds` is a file of the car's own speed over the drive
    (datasets/speed_file.py).

    Raises DatasetError where it can't be used.
    """
    if stride < 1:
        raise DatasetError(f"{uri}: the stride must be 1 or more, got {stride}")
    recording = _open(uri, camera, stride)
    return recording if speeds is None else with_speeds(recording, speeds)


def _open(uri: str, camera: Camera | None, stride: int) -> Recording:
    scheme, _, rest = uri.partition(":")
    if scheme == "demo" and not rest:
        return DemoRecording(camera, stride)
    if not rest or scheme not in ("kitti", "video", "demo"):
        raise DatasetError(f"{uri}: no recording; expected kitti:DIR, video:FILE, demo or demo:DIR")
    path = Path(rest).expanduser()
    if scheme == "demo":
        return DemoRecording(camera, stride, path)
    return KittiRecording(path, camera, stride) if scheme == "kitti" else VideoRecording(path, camera, stride)


def frame_size(uri: str) -> tuple[int, int] | None:
    """(width, height) in pixels of the frames of `kitti:DIR` or `video:FILE`; None where they say nothing of it."""
    scheme, _, rest = uri.partition(":")
    path = Path(rest).expanduser()
    try:
        return image_size(path) if scheme == "kitti" else video_size(path) if scheme == "video" else None
    except DatasetError:  # opening it says what is wrong
        return None
