"""The table of all sources: those of birdslam/sources/schemes.py and those of the runtime (recordings, cameras)."""

from __future__ import annotations

from functools import partial

from birdslam.sources import schemes as recorded
from birdslam.sources.schemes import Scheme

OF_A_CAMERA = ("reopen_ms", "camera_timeout_s")
OF_RECORDINGS = ("speed", "odometry", "detections")  # files that accompany a recording

MCAP = Scheme(
    name="mcap",
    written=("mcap:FILE",),
    what="the images of a BirdSLAM recording, made with `--record-images`: [recording.md](recording.md)",
    opener="birdslam.runtime.recording.recorded_images:RecordedImages",
    camera="calibration",
    clock="recorded times",
    is_at=lambda path: path.suffix.lower() == ".mcap" and not path.is_dir(),  # ROS bags are recognised before
    recognised="any other .mcap file",
)
_live = partial(Scheme, clock="this computer's", live=True, refused=OF_RECORDINGS)
V4L2 = _live(
    name="v4l2",
    written=("v4l2:/dev/videoN",),
    what="a camera of this computer",
    opener="birdslam.runtime.nodes.cameras:DeviceCamera",
    camera="nothing",
    address="device",
    options=OF_A_CAMERA,
)
RTSP = _live(
    name="rtsp",
    written=("rtsp://HOST/PATH",),
    what="a camera of the network",
    opener="birdslam.runtime.nodes.cameras:NetworkCamera",
    camera="nothing",
    address="network",
    options=OF_A_CAMERA,
)
ROS = _live(
    name="ros",
    written=("ros:/TOPIC",),
    what="live images of a ROS 2 topic at a router of rmw_zenoh, without ROS: [ros.md](ros.md)",
    opener="birdslam.runtime.ros.camera:RosCamera",
    camera="intrinsics",
    address="topic",
    options=("topics", *OF_A_CAMERA),
)

OF_THE_RUNTIME = (MCAP, V4L2, RTSP, ROS)


def all_schemes() -> tuple[Scheme, ...]:
    """Returns all schemes, in the order in which they are tried on a path."""
    return (*recorded.RECORDED, *OF_THE_RUNTIME)


def recorded_schemes() -> tuple[Scheme, ...]:
    """Returns the sources of recordings."""
    return tuple(scheme for scheme in all_schemes() if not scheme.live)


def is_live(uri: str) -> bool:
    """Whether the source is a live camera; also true for an empty or unknown one."""
    scheme = recorded.scheme_of(uri, all_schemes())
    return scheme is None or scheme.live
