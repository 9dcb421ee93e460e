"""Recorded drives by their URI: KITTI's layouts, video files, ROS bags, and the drive that ships with birdslam."""

from __future__ import annotations

from pathlib import Path

from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.sources.kitti import KittiRecording, image_size
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.sources.speed_file import with_speeds
from birdslam.sources.video import VideoRecording, video_size


def open_recording(
    uri: str,
    camera: Camera | None = None,
    stride: int = 1,
    speeds: Path | None = None,
    topics: BagTopics = BagTopics(),  # noqa: B008
) -> Recording:
    """Open `kitti:DIR`, `video:FILE`, `rosbag:PATH` or `demo`, the drive that ships with birdslam, every `stride`-th
    frame of it; `demo:DIR` is another drive of the built-in world.

    `camera` goes before the recording's own calibration. `speeds` is a file of the car's own speed over the drive
    (sources/speed_file.py). `topics` says which of a ROS bag are read.

    Raises DatasetError where it can't be used.
    """
    if stride < 1:
        raise DatasetError(f"{uri}: the stride must be 1 or more, got {stride}")
    recording = _open(uri, camera, stride, topics)
    return recording if speeds is None else with_speeds(recording, speeds)


def _open(uri: str, camera: Camera | None, stride: int, topics: BagTopics) -> Recording:
    scheme, _, rest = uri.partition(":")
    if scheme == "demo" and not rest:
        return DemoRecording(camera, stride)
    if not rest or scheme not in ("kitti", "video", "demo", "rosbag"):
        raise DatasetError(f"{uri}: no recording; expected kitti:DIR, video:FILE, rosbag:PATH, demo or demo:DIR")
    path = Path(rest).expanduser()
    if scheme == "rosbag":
        from birdslam.sources.rosbag import RosbagRecording  # only where it is needed: scipy's rotations come with it

        return RosbagRecording(path, camera, stride, topics)
    if topics != BagTopics():
        raise DatasetError(f"{uri}: topics are of ROS bags (rosbag:PATH), and this is none")
    if scheme == "demo":
        return DemoRecording(camera, stride, path)
    return KittiRecording(path, camera, stride) if scheme == "kitti" else VideoRecording(path, camera, stride)


def frame_size(uri: str, topics: BagTopics = BagTopics()) -> tuple[int, int] | None:  # noqa: B008
    """(width, height) in pixels of the frames of `kitti:DIR`, `video:FILE` or `rosbag:PATH`; None where they say
    nothing of it."""
    scheme, _, rest = uri.partition(":")
    path = Path(rest).expanduser()
    try:
        if scheme == "rosbag":
            from birdslam.sources.rosbag import bag_image_size

            return bag_image_size(path, topics)
        return image_size(path) if scheme == "kitti" else video_size(path) if scheme == "video" else None
    except DatasetError:  # opening it says what is wrong
        return None
