"""All sources: those of birdslam/sources/schemes.py, then those of the runtime: our own recordings, live cameras."""

from __future__ import annotations

from functools import partial

from birdslam.sources import schemes as recorded
from birdslam.sources.schemes import Scheme

OF_A_CAMERA = ("reopen_ms", "camera_timeout_s")
OF_RECORDINGS = ("speed", "odometry", "detections")  # files beside one, which no live camera has

MCAP = Scheme(
    name="mcap",
    written=("mcap:FILE",),
    what="the images of a recording of ours, made with `--record-images`: [recording.md](recording.md)",
    opener="birdslam.runtime.recording.recorded_images:RecordedImages",
    camera="calibration",
    clock="recorded times",
    is_at=lambda path: path.suffix.lower() == ".mcap" and not path.is_dir(),  # one of ROS has been recognised before
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
    what="images of ROS 2 as they come, from a topic at a router of rmw_zenoh, without ROS: [ros.md](ros.md)",
    opener="birdslam.runtime.ros.camera:RosCamera",
    camera="intrinsics",
    address="topic",
    options=("topics", *OF_A_CAMERA),
)

OF_THE_RUNTIME = (MCAP, V4L2, RTSP, ROS)


def all_schemes() -> tuple[Scheme, ...]:
    """The whole table, in the order in which a path is recognised."""
    return (*recorded.RECORDED, *OF_THE_RUNTIME)


def recorded_schemes() -> tuple[Scheme, ...]:
    """The sources that are no live cameras."""
    return tuple(scheme for scheme in all_schemes() if not scheme.live)


def is_live(uri: str) -> bool:
    """Whether a camera delivers the frames; so too where no source is named yet."""
    scheme = recorded.scheme_of(uri, all_schemes())
    return scheme is None or scheme.live
