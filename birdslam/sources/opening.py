"""Recorded drives by their URI, as the table in schemes.py says."""

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
    """Opens every `stride`-th frame of a recording, given its path or its URI (`video:FILE`; `schemes.RECORDED`).

    `camera` replaces the recording's own calibration. `speeds` is a file of the car's own speed over the drive
    (sources/speed_file.py). `topics` says which of a ROS bag are read.

    Raises DatasetError where it can't be used.
    """
    try:
        scheme, address = parse(uri_of(uri, schemes.RECORDED), schemes.RECORDED)
    except ValueError as error:
        raise DatasetError(str(error)) from None
    return open_address(scheme, address, camera, stride, speeds, topics)


def open_address(
    scheme: Scheme, address: str, camera: Camera | None, stride: int, speeds: Path | None, topics: BagTopics
) -> Recording:
    """`open_recording` of a URI that is parsed, for any scheme that is recorded."""
    uri = f"{scheme.name}:{address}" if address else scheme.name
    if stride < 1:
        raise DatasetError(f"{uri}: the stride must be 1 or more, got {stride}")
    if "topics" in scheme.refused and topics != BagTopics():
        raise DatasetError(f"{uri}: topics are of ROS bags (rosbag:PATH), and this is none")
    more = {"topics": topics} if "topics" in scheme.options else {}
    place = (Path(address).expanduser(),) if address else ()
    recording: Recording = scheme.load()(*place, camera=camera, stride=stride, **more)
    return recording if speeds is None else with_speeds(recording, speeds)
