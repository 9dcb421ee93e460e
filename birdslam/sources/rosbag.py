"""ROS bags as recorded drives (docs/ros.md): topics, camera, frames and vehicle speed.

Times are header stamps, or receive times if the images' stamps do not increase. An image that is not later than the
previous one is an unreadable frame, and a damaged bag ends with one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.ros.bag import Bag, BagError, BagMessage, BagTopics, stamp_ns
from birdslam.ros.frames import StaticFrames
from birdslam.ros.sensor import (
    CAMERA_INFO,
    IMAGES,
    SPEEDS,
    Lens,
    demosaiced,
    is_rectified,
    lens,
    pixels,
    speed,
    yaw_rate,
)
from birdslam.sources.kitti import decode_image
from birdslam.sources.recording import DatasetError, OwnLens, RecordedFrame, Recording
from birdslam.sources.rosbag_truth import truth_rows
from birdslam.sources.speed_file import SIGMA_MPS, YAW_RATE_SIGMA_RADPS
from birdslam.sources.speed_log import SpeedLog
from birdslam.types import NS_PER_S, SpeedReading

MAX_CLOCK_ERROR_NS = NS_PER_S  # between steps of two clocks: above it one of them was set
RATE_IMAGES = 30  # number of images whose median interval gives the frame rate


class BagCamera(NamedTuple):
    """Camera information in a bag; `mount` is None if the bag does not state the camera's height over the road."""

    topic: str  # of the CameraInfo
    frame: str
    lens: Lens
    mount: GroundPlane | None


class RosbagRecording(Recording):
    """The images of one camera in a ROS bag. Raises DatasetError if it cannot be used."""

    def __init__(
        self,
        path: Path,
        camera: Camera | None = None,
        stride: int = 1,
        topics: BagTopics = BagTopics(),  # noqa: B008
    ) -> None:
        self._path, self._stride, self._topics = path, stride, topics
        self.name = path.stem
        try:
            with Bag(path) as bag:
                self._topic = _image_topic(bag, topics)
                height_px, width_px = _first_image(bag, self._topic).shape[:2]
                self.camera = self._own_camera(bag) if camera is None else camera
                if (self.camera.width_px, self.camera.height_px) != (width_px, height_px):
                    given = "the given camera" if camera else "its CameraInfo"
                    raise BagError(
                        f"{path}: the images of {self._topic} are {width_px}x{height_px}, but {given} is for "
                        f"{self.camera.width_px}x{self.camera.height_px}"
                    )
                self._count = bag.counts[self._topic]
                self._stamped, self.rate_hz = self._rate(bag)
                self.rate_hz /= stride
                if topics.speed:
                    self.speeds = SpeedLog(self._speeds(bag))
                if topics.truth:
                    bag.find(topics.truth, "nav_msgs/Odometry", "sensor_msgs/NavSatFix")
        except BagError as error:
            raise DatasetError(str(error)) from None

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int]:
        """Size of the first readable image. Raises DatasetError."""
        try:
            with Bag(path) as bag:
                return _first_image(bag, _image_topic(bag, topics)).shape[1::-1]
        except BagError as error:
            raise DatasetError(str(error)) from None

    @classmethod
    def own_lens(cls, path: Path, topics: BagTopics) -> OwnLens:
        """Intrinsics of the CameraInfo, with the height of /tf_static. Raises DatasetError."""
        try:
            with Bag(path) as bag:
                found = _camera(bag, topics)
        except BagError as error:
            raise DatasetError(str(error)) from None
        return OwnLens(found.topic, found.lens, None if found.mount is None else found.mount.height_m)

    def _own_camera(self, bag: Bag) -> Camera:
        found = _camera(bag, self._topics)
        if found.mount is None:
            raise BagError(
                f"{self._path}: the height of the camera above the road is missing (no /tf_static from "
                f"base_footprint or base_link to {found.frame or 'a frame that the images name'}); give a camera file "
                f"(--camera FILE): `birdslam calibrate rosbag:{self._path} --height M --output FILE` writes one"
            )
        mount = msgspec.structs.asdict(found.mount)
        try:
            return Camera(**found.lens._asdict(), **mount)
        except ValueError as error:
            raise BagError(f"{self._path}: {found.topic}: {error}") from None

    def _rate(self, bag: Bag) -> tuple[bool, float]:
        """Whether header stamps are used, and the frame rate by them."""
        first = list(islice(bag.messages(self._topic), RATE_IMAGES))
        stamps = [stamp_ns(message.content) for message in first]
        stamped = len(stamps) < 2 or stamps[1] > stamps[0]
        times = stamps if stamped else [message.t_ns for message in first]
        gaps = [gap for gap in np.diff(times).tolist() if gap > 0]
        if not gaps:
            raise BagError(f"{self._path}: {self._topic} has {len(first)} images, but no two with increasing times")
        return stamped, NS_PER_S / float(np.median(gaps))

    def _time_ns(self, message: BagMessage) -> int:
        return stamp_ns(message.content) if self._stamped else message.t_ns

    def _speeds(self, bag: Bag) -> list[SpeedReading]:
        topic = bag.find(self._topics.speed, *SPEEDS)
        messages = list(bag.messages(topic))
        has_yaw_rate = any(yaw_rate(message.content) for message in messages)  # all zero: not measured
        return [
            speed(message.content, self._time_ns(message), SIGMA_MPS, YAW_RATE_SIGMA_RADPS, has_yaw_rate)
            for message in messages
        ]

    def __len__(self) -> int:
        return -(-self._count // self._stride)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Yields the frames in order; images are decoded on demand."""
        last_ns, position, clock, step_ns = None, -1, ImageClock(), 0
        try:
            with Bag(self._path) as bag:
                for position, message in enumerate(bag.messages(self._topic)):
                    t_ns = clock.time_ns(self._time_ns(message), message.t_ns)
                    step_ns += clock.step_ns
                    late = last_ns is not None and t_ns <= last_ns
                    last_ns = last_ns + 1 if late and last_ns is not None else t_ns
                    index, between = divmod(position, self._stride)
                    if between or index < start:
                        continue
                    error = f"its time {t_ns / NS_PER_S:.3f} s is not later than the previous one" if late else None
                    frame = self._frame(index, last_ns, message, error)
                    yield replace(frame, note=_step_note(step_ns)) if step_ns else frame
                    step_ns = 0
            if position + 1 < self._count:
                raise BagError(f"{self._path}: {self._topic} ends after {position + 1} of {self._count} images")
        except BagError as error:
            yield RecordedFrame(position // self._stride + 1, (last_ns or 0) + 1, None, str(error))

    def _frame(self, index: int, t_ns: int, message: BagMessage, error: str | None) -> RecordedFrame:
        image = None
        if error is None:
            try:
                image = _pixels(message)
            except ValueError as unfit:
                error = str(unfit)
        return RecordedFrame(index, t_ns, image, error and f"{self._path}: {self._topic}: image {index}: {error}")

    def timed(self, topic: str, *types: str) -> list[tuple[int, Any]]:
        """Messages of another topic of these types, with times in the images' clock. Raises DatasetError."""
        try:
            with Bag(self._path) as bag:
                bag.find(topic, *types)
                return [(self._time_ns(message), message.content) for message in bag.messages(topic)]
        except BagError as error:
            raise DatasetError(str(error)) from None

    def truth_poses(self) -> Floats | None:
        """(N, 3, 4) camera poses at the frames from the truth topic; nan outside its times."""
        if not self._topics.truth:
            return None
        try:
            with Bag(self._path) as bag:
                messages = bag.messages(self._topic)
                times = [self._time_ns(m) for i, m in enumerate(messages) if i % self._stride == 0]
                frame = _image_frame(bag, self._topic)
                truth = [(self._time_ns(message), message.content) for message in bag.messages(self._topics.truth)]
                return truth_rows(times, truth, StaticFrames(bag), frame, self.camera.ground)
        except ValueError as error:
            raise DatasetError(f"{self._path}: {self._topics.truth}: {error}") from None


class ImageClock:
    """Image times across steps of their clock: uptime before NTP, a clock that is set, a first stamp of zero.

    If stamps and receive times advance by more than a second apart, the stamps' clock was set, and the receive times
    are used for that step. A pause, over which both advance, stays.
    """

    def __init__(self) -> None:
        self._shift_ns = 0
        self.step_ns = 0  # by which the stamps' clock was set before the last image
        self._last: tuple[int, int] | None = None  # stamp and receive time

    def time_ns(self, stamp_ns: int, recorded_ns: int) -> int:
        """The time of the next image in the clock of the first."""
        self.step_ns = 0
        if self._last is not None:
            by_stamps, by_recording = stamp_ns - self._last[0], recorded_ns - self._last[1]
            if abs(by_stamps - by_recording) > MAX_CLOCK_ERROR_NS and by_recording >= 0:
                self.step_ns = by_stamps - by_recording
                self._shift_ns -= self.step_ns
        self._last = stamp_ns, recorded_ns
        return stamp_ns + self._shift_ns


def _step_note(step_ns: int) -> str:
    return f"the clock of the stamps was set by {step_ns / NS_PER_S:+.3f} s; the times continue by the receive times"


def _image_topic(bag: Bag, topics: BagTopics) -> str:
    if topics.image:
        return bag.find(topics.image, *IMAGES)
    found = bag.of_type(*IMAGES)
    if len(found) != 1:
        reason = "has no images" if not found else f"has {len(found)} image topics; name one (--topic)"
        raise BagError(f"{bag.path}: {reason}. {bag.listing(*IMAGES)}")
    return found[0]


def _camera(bag: Bag, topics: BagTopics) -> BagCamera:
    image_topic = _image_topic(bag, topics)
    topic, frame = _info_topic(bag, topics, image_topic), _image_frame(bag, image_topic)
    try:
        found = lens(next(bag.messages(topic)).content, is_rectified(image_topic))
    except ValueError as error:
        raise BagError(f"{bag.path}: {topic}: {error}; give a camera file (--camera FILE)") from None
    try:
        mount = StaticFrames(bag).mount(frame)
    except ValueError as error:
        raise BagError(f"{bag.path}: {error}; give a camera file (--camera FILE)") from None
    return BagCamera(topic, frame, found, mount)


def _info_topic(bag: Bag, topics: BagTopics, image_topic: str) -> str:
    """The CameraInfo next to the images, as in image_transport: /camera/image_raw/compressed, /camera/camera_info."""
    if topics.camera_info:
        return bag.find(topics.camera_info, CAMERA_INFO)
    found = bag.of_type(CAMERA_INFO)
    space = image_topic
    while space:
        space = space.rpartition("/")[0]
        if f"{space}/camera_info" in found:
            return f"{space}/camera_info"
    if len(found) != 1:
        reason = "no CameraInfo" if not found else f"{len(found)} topics of CameraInfo"
        raise BagError(
            f"{bag.path}: {reason} for {image_topic}; name one (--camera-info-topic), or give a camera file "
            f"(--camera FILE). {bag.listing(CAMERA_INFO)}"
        )
    return found[0]


def _image_frame(bag: Bag, topic: str) -> str:
    return str(next(bag.messages(topic)).content.header.frame_id)


def _first_image(bag: Bag, topic: str) -> NDArray[np.uint8]:
    reason = ""
    for message in bag.messages(topic):
        try:
            return _pixels(message)
        except ValueError as error:
            reason = reason or str(error)
    raise BagError(f"{bag.path}: no readable image on {topic} ({reason})")


def _pixels(message: BagMessage) -> NDArray[np.uint8]:
    content = message.content
    if not hasattr(content, "format"):
        return pixels(content)
    return demosaiced(str(content.format), decode_image(bytes(content.data)))
