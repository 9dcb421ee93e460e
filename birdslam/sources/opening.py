"""Opens recorded drives by URI with the table in schemes.py."""

from __future__ import annotations

from pathlib import Path

from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.sources import schemes
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.schemes import Scheme, parse, uri_of
from birdslam.sources.speed_file import with_speeds


def open_recording(
    uri: str,
    camera: Camera | None = None,
    stride: int = 1,
    speeds: Path | None = None,
    topics: BagTopics = BagTopics(),  # noqa: B008
) -> Recording:
    """Opens every `stride`-th frame of a recording by path or URI (`video:FILE`, or any other of `schemes.RECORDED`).

    `camera` replaces the recording's calibration. `speeds`: a file of vehicle speeds (sources/speed_file.py).
    `topics`: topics of a ROS bag. Raises DatasetError if the recording cannot be used.
    """
    try:
        scheme, address = parse(uri_of(uri, schemes.RECORDED), schemes.RECORDED)
    except ValueError as error:
        raise DatasetError(str(error)) from None
    return open_address(scheme, address, camera, stride, speeds, topics)


def open_address(
    scheme: Scheme, address: str, camera: Camera | None, stride: int, speeds: Path | None, topics: BagTopics
) -> Recording:
    """`open_recording` for a parsed URI and any recorded scheme."""
    uri = f"{scheme.name}:{address}" if address else scheme.name
    if stride < 1:
        raise DatasetError(f"{uri}: the stride must be 1 or more, got {stride}")
    if "topics" in scheme.refused and topics != BagTopics():
        raise DatasetError(f"{uri}: topics need a ROS bag (rosbag:PATH)")
    more = {"topics": topics} if "topics" in scheme.options else {}
    place = (Path(address).expanduser(),) if address else ()
    recording: Recording = scheme.load()(*place, camera=camera, stride=stride, **more)
    return recording if speeds is None else with_speeds(recording, speeds)
