"""The source `ros:/TOPIC`: live images of a ROS 2 topic, with the car's own speed and GNSS fixes from other topics.

Without a camera file the camera comes from CameraInfo and /tf_static. The headers' times are converted to
CLOCK_MONOTONIC. A missing image gives a frame without one.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import suppress
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zenoh
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.loops.gnss.files import GNSS_FILE
from birdslam.ros.bag import stamp_ns
from birdslam.ros.frames import TF_STATIC, StaticFrames
from birdslam.ros.message_types import MessageTypes
from birdslam.ros.rmw_zenoh import (
    SENSOR_QOS,
    Publication,
    any_type_key,
    check_topic,
    publication_of,
    publishers_key,
    sequence_of,
    type_of_key,
)
from birdslam.ros.sensor import (
    CAMERA_INFO,
    FIX,
    IMAGES,
    SPEEDS,
    Lens,
    demosaiced,
    fix_row,
    is_rectified,
    lens,
    pixels,
    speed,
)
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.sources import SourceError
from birdslam.runtime.ros.session import ROUTER_S, NoRouter, RosNode
from birdslam.sources.kitti import decode_image
from birdslam.sources.recording import RecordedFrame
from birdslam.sources.speed_file import SIGMA_MPS, YAW_RATE_SIGMA_RADPS
from birdslam.sources.speed_log import MAX_AGE_NS, MAX_READINGS
from birdslam.types import NS_PER_S, SpeedReading

NODE = "birdslam_camera"
TOPIC = "topic:"  # prefix of a topic in results.gnss
GNSS_HEAD = "time_s,latitude_deg,longitude_deg,sigma_m"  # as in loops/gnss/files.py
SAME_CLOCK_NS = NS_PER_S  # max. difference of a header to UTC to count as this computer's clock
CLOCK_FRAMES = 100  # the offset of another clock is the minimum delay of so many frames
RATE_FRAMES = 10  # the frame rate is the median of so many intervals


log = logging.getLogger(__name__)


class Arrived(NamedTuple):
    """A received message, not yet decoded."""

    type_name: str | None
    data: bytes
    t_ns: int  # CLOCK_MONOTONIC


class SenderClock:
    """Converts the times of headers to CLOCK_MONOTONIC.

    Headers in this computer's UTC are converted exactly. The offset of another clock (another computer, a simulation)
    is the minimum delay of the last frames, which preserves intervals and gives no image from the future.
    """

    def __init__(self) -> None:
        self._delays_ns: deque[int] = deque(maxlen=CLOCK_FRAMES)

    def monotonic_ns(self, stamp_ns: int, arrived_ns: int, utc_ns: int) -> int:
        """Converts a stamp; `utc_ns` is UTC at its arrival."""
        if abs(utc_ns - stamp_ns) <= SAME_CLOCK_NS:
            self._delays_ns.clear()
            return min(arrived_ns, arrived_ns - (utc_ns - stamp_ns))
        self._delays_ns.append(arrived_ns - stamp_ns)
        return stamp_ns + min(self._delays_ns)


class RosCamera:
    """A source (nodes/sources.py) of one image topic.

    Raises ConfigurationError for an invalid name; with `must_open` SourceError if no image arrives within
    source.camera_timeout_s, or the image size differs from the camera's.
    """

    live = True

    def __init__(self, configuration: Configuration, must_open: bool = True) -> None:
        source, self._topics, results = configuration.source, configuration.source.topics, configuration.results
        self.name = source.uri
        self._topic = source.uri.partition(":")[2]
        self._config = source
        try:
            self._fixes = results.gnss.removeprefix(TOPIC) if results.gnss.startswith(TOPIC) else ""
            for topic in (self._topic, self._topics.camera_info, self._topics.speed, self._fixes):
                if topic:
                    check_topic(topic)
        except ValueError as error:
            raise ConfigurationError(f"{source.uri}: {error}") from None
        self._gnss = Path(configuration.output) / GNSS_FILE if self._fixes else None
        self._arrived = threading.Condition()
        self._images: deque[Arrived] = deque(maxlen=RATE_FRAMES)
        self._infos: dict[str, Arrived] = {}
        self._transforms: list[Arrived] = []
        self._readings: deque[tuple[int, SpeedReading]] = deque(maxlen=MAX_READINGS)
        self._problem = ""
        self._came = self._lost = self._number = 0  # received images, lost images, number of the newest
        self._closed = False
        self._clock = SenderClock()
        self.rate_hz = source.rate if isinstance(source.rate, float) else 0.0
        self._ros, self._name = configuration.ros, f"{NODE}_{configuration.vehicle}".replace("-", "_")
        self._types = MessageTypes()
        self._asks_camera = configuration.camera is None
        self._node: RosNode | None = None
        if not must_open:
            assert configuration.camera is not None  # found at the first start
            self.camera = configuration.camera
            return
        try:
            self._connect(source.camera_timeout_s)
            self.camera = self._open(configuration.camera)
        except NoRouter as error:
            raise SourceError(f"{self.name}: {error}") from None
        except BaseException:
            self.close()
            raise

    def _connect(self, timeout_s: float) -> None:
        self._node = RosNode(self._ros, self._name, timeout_s)
        self._listen(self._node)

    def _listen(self, node: RosNode) -> None:
        domain = node.domain
        known: set[Publication] = set()

        def publisher_found(token: str) -> None:
            found = publication_of(token)
            if found is None or found in known:
                return
            known.add(found)
            kind = found.type_name.replace("/msg/", "/")
            if found.topic == self._topic and kind not in IMAGES:
                with self._arrived:
                    self._problem = f"{found.topic} is {kind}; expected {' or '.join(IMAGES)}"
                    self._arrived.notify_all()
            node.declare_subscription(found.topic, found.type_name, found.type_hash, SENSOR_QOS)

        listens: list[tuple[str, Callable[[zenoh.Sample], object]]] = [(self._topic, self._image_came)]
        if self._asks_camera:
            listens += [(topic, self._info_came) for topic in self._info_topics()]
            node.subscribe(any_type_key(domain, TF_STATIC), self._transform_came, late=True)
        if self._topics.speed:
            listens.append((self._topics.speed, self._speed_came))
        if self._gnss is not None:
            listens.append((self._fixes, self._fix_came))
        for topic, came in listens:
            node.watch(publishers_key(domain, topic), publisher_found)
            node.subscribe(any_type_key(domain, topic), came)

    def _info_topics(self) -> list[str]:
        """Returns the CameraInfo topics by image_transport's rule: /camera/camera_info for /camera/image_raw."""
        if self._topics.camera_info:
            return [self._topics.camera_info]
        space, found = self._topic, []
        while space := space.rpartition("/")[0]:
            found.append(f"{space}/camera_info")
        return found or ["/camera_info"]

    def _image_came(self, sample: zenoh.Sample) -> None:
        with self._arrived:
            self._count(sample)
            self._images.append(_arrived(sample))
            self._arrived.notify_all()

    def _count(self, sample: zenoh.Sample) -> None:
        """Counts images, and by their numbers the lost ones; the numbers of another sender restart."""
        number = None if sample.attachment is None else sequence_of(sample.attachment.to_bytes())
        if number is not None and 0 < self._number < number:
            self._lost += number - self._number - 1
        self._came, self._number = self._came + 1, number or 0

    def _info_came(self, sample: zenoh.Sample) -> None:
        with self._arrived:
            self._infos[str(sample.key_expr)] = _arrived(sample)
            self._arrived.notify_all()

    def _transform_came(self, sample: zenoh.Sample) -> None:
        with self._arrived:
            self._transforms.append(_arrived(sample))
            self._arrived.notify_all()

    def _speed_came(self, sample: zenoh.Sample) -> None:
        came = _arrived(sample)
        kind = (came.type_name or "").replace("/msg/", "/")
        try:
            if kind not in SPEEDS:
                raise ValueError(f"is {kind or 'no type of ROS'}; expected {' or '.join(SPEEDS)}")
            message = self._types.read(came.data, str(came.type_name))
            t_ns = self._time_ns(message, came, self._clock)
            reading = speed(message, t_ns, SIGMA_MPS, YAW_RATE_SIGMA_RADPS, has_yaw_rate=True)
        except ValueError as error:
            self._problem = f"{self._topics.speed}: {error}"
            return
        with self._arrived:
            self._readings.append((came.t_ns, reading))

    def _fix_came(self, sample: zenoh.Sample) -> None:
        came = _arrived(sample)
        try:
            if (came.type_name or "").replace("/msg/", "/") != FIX:
                raise ValueError(f"is {came.type_name}; expected {FIX}")
            message = self._types.read(came.data, str(came.type_name))
            row = fix_row(message, self._time_ns(message, came, self._clock))
        except ValueError as error:
            self._problem = f"{self._fixes}: {error}"
            return
        if row is not None and self._gnss is not None and self._gnss.parent.is_dir():
            new = not self._gnss.exists()
            with self._gnss.open("a") as file:
                file.write(f"{GNSS_HEAD}\n{row}\n" if new else f"{row}\n")

    def _time_ns(self, message: Any, came: Arrived, clock: SenderClock) -> int:
        return clock.monotonic_ns(stamp_ns(message), came.t_ns, time.time_ns() - (time.monotonic_ns() - came.t_ns))

    def _open(self, given: Camera | None) -> Camera:
        """Waits for images, and for the camera if none was given."""
        limit_s = self._config.camera_timeout_s
        until_s = time.monotonic() + limit_s
        with self._arrived:
            enough = 1 if self.rate_hz else RATE_FRAMES
            self._arrived.wait_for(lambda: len(self._images) >= enough or self._problem, limit_s)
            images, problem = list(self._images), self._problem
        if not images:
            reason = problem or self._absence()
            raise SourceError(f"{self.name}: no image within {limit_s:g} s: {reason}")
        try:
            height_px, width_px = self._pixels(self._read(images[-1]), images[-1]).shape[:2]
        except ValueError as error:
            raise SourceError(f"{self.name}: {error}") from None
        gaps = np.diff([came.t_ns for came in images])
        self.rate_hz = self.rate_hz or (NS_PER_S / float(np.median(gaps)) if gaps.size else 30.0)
        camera = given or self._own_camera(self._read(images[-1]).header.frame_id, until_s)
        if (camera.width_px, camera.height_px) != (width_px, height_px):
            raise SourceError(
                f"{self.name}: the images are {width_px}x{height_px} px, the camera is for "
                f"{camera.width_px}x{camera.height_px}"
            )
        return camera

    def _absence(self) -> str:
        if self._node is None or not self._node.connected:
            return f"ros.router {self._ros.router}: the router is not connected"
        return f"{self._topic} has no publisher in domain {self._node.domain}"

    def _own_camera(self, frame: str, until_s: float) -> Camera:
        def known() -> Camera | None:
            info = next(iter(self._infos.values()), None)
            if info is None:
                return None
            frames = StaticFrames.of(self._read(one) for one in self._transforms)
            mount = frames.mount(frame)
            if mount is None:
                return None
            found: Lens = lens(self._types.read(info.data, "sensor_msgs/msg/CameraInfo"), is_rectified(self._topic))
            return Camera(**found._asdict(), **msgspec.structs.asdict(mount))

        try:
            with self._arrived:
                self._arrived.wait_for(known, max(0.0, until_s - time.monotonic()))
                camera, has_info = known(), bool(self._infos)
        except ValueError as error:
            raise SourceError(f"{self.name}: {error}; name a camera file with --camera FILE") from None
        if camera is None:
            lacks = (
                f"no {TF_STATIC} from base_footprint or base_link to {frame}" if has_info else f"no {CAMERA_INFO} of it"
            )
            raise SourceError(f"{self.name}: {lacks}; name a camera file with --camera FILE")
        return camera

    def _read(self, came: Arrived) -> Any:
        if came.type_name is None:
            raise ValueError("a message without a ROS type")
        return self._types.read(came.data, came.type_name)

    def _pixels(self, message: Any, came: Arrived) -> NDArray[np.uint8]:
        kind = (came.type_name or "").replace("/msg/", "/")
        if kind not in IMAGES:
            raise ValueError(f"{self._topic} is {kind}; expected {' or '.join(IMAGES)}")
        if not hasattr(message, "format"):
            return pixels(message)
        return demosaiced(str(message.format), decode_image(bytes(message.data)))

    def frames(self) -> Generator[RecordedFrame]:
        """Yields images on arrival, and frames without an image while none arrives."""
        last_ns = 0
        timeout_s = max(self._config.reopen_ms / 1e3, 5.0 / self.rate_hz if self.rate_hz else 0.0)
        try:
            for index in islice(count(), self._config.frames):
                if self._node is None:
                    with suppress(NoRouter):
                        self._connect(ROUTER_S)
                with self._arrived:
                    self._arrived.wait_for(lambda: self._closed or self._images, timeout_s)
                    if self._closed:
                        return
                    came = self._images.popleft() if self._images else None
                if came is None:
                    now_ns = max(time.monotonic_ns(), last_ns + 1)
                    last_ns = now_ns
                    reason = self._problem or self._absence()
                    yield RecordedFrame(index, now_ns, None, f"{self.name}: no image for {timeout_s:g} s: {reason}")
                    continue
                frame = self._frame(index, came, last_ns)
                last_ns = frame.t_source_ns
                yield frame
        finally:
            self.close()

    def _frame(self, index: int, came: Arrived, last_ns: int) -> RecordedFrame:
        try:
            message = self._read(came)
            t_ns = self._time_ns(message, came, self._clock)
            if t_ns <= last_ns:
                raise ValueError("its time is not later than the previous one")
            image = self._pixels(message, came)
        except ValueError as error:
            return RecordedFrame(index, max(came.t_ns, last_ns + 1), None, f"{self.name}: image {index}: {error}")
        with self._arrived:
            readings = tuple(reading for arrived_ns, reading in self._readings if arrived_ns > t_ns - MAX_AGE_NS)
        return RecordedFrame(index, t_ns, image, speeds=readings)

    def resume(self, frame_id: int, t_source_ns: int) -> None:
        """Does nothing: a live camera needs no seek."""

    def close(self) -> None:
        """Closes the node."""
        with self._arrived:
            if self._lost and not self._closed:
                log.warning("%s: %d images received, %d lost in transit", self.name, self._came, self._lost)
            self._closed = True
            self._arrived.notify_all()
        if self._node is not None:
            self._node.close()


def _arrived(sample: zenoh.Sample) -> Arrived:
    return Arrived(type_of_key(str(sample.key_expr)), sample.payload.to_bytes(), time.monotonic_ns())
