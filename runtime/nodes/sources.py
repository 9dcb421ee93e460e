"""Sources of frames: opening by URI, pacing, reading ahead, and conversion to `Frame`."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Protocol

from birdslam.geometry.camera import Camera, Undistorter
from birdslam.ros.bag import BagTopics
from birdslam.runtime.configuration import Configuration, ConfigurationError, SourceConfig
from birdslam.runtime.schemes import all_schemes, recorded_schemes
from birdslam.sources.detection_file import check_detections
from birdslam.sources.odometry_file import check_odometry
from birdslam.sources.opening import open_address
from birdslam.sources.recording import RecordedFrame, Recording, undistorted
from birdslam.sources.schemes import KITTI, Scheme, parse, scheme_at, scheme_of, written
from birdslam.sources.speed_file import of_sequence
from birdslam.sources.speed_log import shifted
from birdslam.types import Frame, Status

REFUSALS = {  # key -> why a live camera may refuse it
    "speed": "a speed file is for recordings; a live car publishes its speed on the bus",
    "odometry": "an odometry file is for recordings",
    "detections": "a file of boxes is for recordings",
}

log = logging.getLogger(__name__)


class SourceError(RuntimeError):
    """A camera or stream can't be opened or delivers no more frames; the message names it."""


class Source(Protocol):
    """Frames of one camera. A `live` source stamps them with CLOCK_MONOTONIC and doesn't wait for its reader."""

    name: str
    camera: Camera
    rate_hz: float
    live: bool

    def frames(self) -> Generator[RecordedFrame]: ...

    def resume(self, frame_id: int, t_source_ns: int) -> None:
        """Sets the next frame to `frame_id`; called before `frames` after a restart of capture."""

    def close(self) -> None:
        """Releases the camera."""


def open_source(configuration: Configuration, must_open: bool = True) -> Source:
    """Opens the configured source; without `must_open` a live camera may be disconnected.

    Raises ConfigurationError or DatasetError for an invalid source, SourceError if a camera does not open.
    """
    source = configuration.source
    if not source.uri:
        raise ConfigurationError(f"no source: give --source {written(all_schemes())}")
    scheme, address = parsed(source.uri)
    if scheme.live:
        return _open_camera(scheme, configuration, must_open)
    speeds = Path(source.speed).expanduser() if source.speed else None
    recording = open_address(scheme, address, configuration.camera, source.stride, speeds, source.topics)
    _check_beside(recording, source)
    return RecordedSource(recording, source)


def recording_uri(text: str) -> str:
    """Returns the URI of a recording, given a URI or a path; a directory of no other kind is KITTI's.

    Raises ConfigurationError for a live camera and for an unknown scheme.
    """
    if scheme_of(text, all_schemes()) is None and (":" not in text or Path(text).expanduser().exists()):
        found = scheme_at(Path(text).expanduser(), all_schemes()) or KITTI
        return f"{found.name}:{text}"
    scheme, _ = parsed(text)
    if scheme.live:
        raise ConfigurationError(f"{text}: is a live camera; expected one of {written(recorded_schemes())}")
    return text


def open_recorded(
    uri: str,
    camera: Camera | None = None,
    stride: int = 1,
    topics: BagTopics = BagTopics(),  # noqa: B008
) -> Recording:
    """Opens a `recording_uri` without the car's speed. Raises ConfigurationError or DatasetError."""
    scheme, address = parsed(uri)
    return open_address(scheme, address, camera, stride, None, topics)


def parsed(uri: str) -> tuple[Scheme, str]:
    """Returns the scheme and the address of a source. Raises ConfigurationError with the known schemes."""
    try:
        return parse(uri, all_schemes())
    except ValueError as error:
        raise ConfigurationError(str(error)) from None


def _open_camera(scheme: Scheme, configuration: Configuration, must_open: bool) -> Source:
    source = configuration.source
    if configuration.camera is None and scheme.camera == "nothing":
        raise ConfigurationError(f"{source.uri}: a live camera needs a camera file (--camera FILE)")
    for key, reason in REFUSALS.items():
        if key in scheme.refused and getattr(source, key):
            raise ConfigurationError(f"{source.uri}: {reason}")
    if source.rate == "max":
        raise ConfigurationError(f'{source.uri}: rate "max" is for recordings; a live camera has its own')
    camera: Source = scheme.load()(configuration, must_open)
    return camera


def _check_beside(recording: Recording, source: SourceConfig) -> None:
    """Raises ConfigurationError or DatasetError if a file of odometry or boxes does not match the recording."""
    for file in filter(None, (source.odometry, source.detections)):
        if source.loop:
            raise ConfigurationError(f"{file}: covers one pass through the recording; remove source.loop")
    if source.odometry:
        check_odometry(recording, of_sequence(Path(source.odometry).expanduser(), recording.name), source.stride)
    if source.detections:
        path = of_sequence(Path(source.detections).expanduser(), recording.name)
        log.warning("%s", check_detections(recording, path, source.stride))


class RecordedSource:
    """A recording, played once or in a loop with increasing time stamps."""

    live = False

    def __init__(self, recording: Recording, config: SourceConfig) -> None:
        self.recording = recording
        self.name = recording.name
        self.camera = recording.camera
        self.rate_hz = recording.rate_hz
        self._config = config
        self._start = 0
        self._resume_ns = 0

    def resume(self, frame_id: int, t_source_ns: int) -> None:
        """Continues at this frame of the recording; in a loop also at this time."""
        self._start, self._resume_ns = frame_id, t_source_ns

    def close(self) -> None:
        """Does nothing: the files are open only while frames are read."""

    def frames(self) -> Generator[RecordedFrame]:
        """Yields every frame in order, with increasing time stamps."""
        left = self._config.frames
        with contextlib.closing(self._passes()) as passes:
            yield from islice(passes, left if left is None else max(0, left - self._start))

    def _passes(self) -> Generator[RecordedFrame]:
        loops, start = (
            divmod(self._start, len(self.recording)) if self._config.loop and self._start else (0, self._start)
        )
        shift_ns: int | None = None if loops else 0
        while True:
            first_ns = last_ns = None
            for frame in self.recording.frames_with_speeds(start):
                if shift_ns is None:
                    shift_ns = self._resume_ns - frame.t_source_ns
                first_ns = frame.t_source_ns if first_ns is None else first_ns
                last_ns = frame.t_source_ns
                speeds = tuple(shifted(reading, shift_ns) for reading in frame.speeds) if shift_ns else frame.speeds
                yield replace(frame, t_source_ns=frame.t_source_ns + shift_ns, speeds=speeds)
            if not self._config.loop or first_ns is None or last_ns is None or shift_ns is None:
                return
            if start:  # the next pass starts at frame 0, which is earlier than this pass's first frame
                first_ns, start = next(iter(self.recording.frames())).t_source_ns, 0
            shift_ns += last_ns - first_ns + round(1e9 / self.rate_hz)


def to_frame(
    undistort: Undistorter, frame_id: int, recorded: RecordedFrame, t_capture_ns: int, t_utc_ns: int = 0
) -> Frame:
    """Undistorts a frame; an unreadable one gets a status instead of an image. Used live and offline."""
    image, error = undistorted(undistort, recorded)
    if image is None:
        log.warning("frame %d is unreadable: %s", frame_id, error)
    if recorded.note:
        log.warning("frame %d: %s", frame_id, recorded.note)
    status = (Status.FRAME_UNREADABLE,) if image is None else ()
    return Frame(frame_id, recorded.t_source_ns, t_capture_ns, t_utc_ns, image, status, recorded.speeds)


def offline_frames(source: Source) -> Iterator[Frame]:
    """Yields all frames of a recording for one process; the capture time is the source time."""
    undistort = Undistorter(source.camera)
    for frame_id, recorded in enumerate(source.frames()):
        yield to_frame(undistort, frame_id, recorded, recorded.t_source_ns)


class Pacer:
    """Due times of a recording's frames on CLOCK_MONOTONIC, relative to the first frame, so that they do not drift."""

    def __init__(self, rate: float | str | None) -> None:
        self._rate = rate
        self._start_ns: int | None = None
        self._first_source_ns = 0

    def due_ns(self, frame_id: int, t_source_ns: int, now_ns: int) -> int:
        """Returns the due time of a frame; the first one is due now."""
        if self._rate == "max":
            return now_ns
        if self._start_ns is None:
            self._start_ns, self._first_source_ns, self._first_frame = now_ns, t_source_ns, frame_id
        if isinstance(self._rate, str) or self._rate is None:
            return self._start_ns + t_source_ns - self._first_source_ns
        return self._start_ns + round((frame_id - self._first_frame) * 1e9 / self._rate)


class ReadAhead:
    """Reads a source in a thread, with a queue of `capacity` frames.

    A full queue drops the oldest frame of a live source, counted in `dropped`; a recording waits instead. Frames are
    numbered from `first_frame` on, including the dropped ones.
    """

    def __init__(self, source: Source, capacity: int, first_frame: int = 0) -> None:
        self.dropped = 0
        self._first_frame = first_frame
        self.read = 0
        self._source = source
        self._capacity = capacity
        self._waiting: deque[tuple[int, RecordedFrame]] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self._closed = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="read-ahead", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            with contextlib.closing(self._source.frames()) as frames:
                for frame_id, recorded in enumerate(frames, self._first_frame):
                    with self._changed:
                        self.read += 1
                        if self._source.live and len(self._waiting) == self._capacity:
                            self._waiting.popleft()
                            self.dropped += 1
                        self._changed.wait_for(lambda: self._closed or len(self._waiting) < self._capacity)
                        if self._closed:
                            return
                        self._waiting.append((frame_id, recorded))
                        self._changed.notify_all()
        except Exception as error:  # handed to the reader, who raises it
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def next(self, timeout_s: float) -> tuple[int, RecordedFrame] | None:
        """Returns the next frame and its number; None if none arrived in time.

        Raises EndOfSource at the end, and any exception of the source.
        """
        with self._changed:
            self._changed.wait_for(lambda: bool(self._waiting) or self._ended, timeout_s)
            if self._waiting:
                item = self._waiting.popleft()
                self._changed.notify_all()
                return item
            if not self._ended:
                return None
        if self._error is not None:
            raise self._error
        raise EndOfSource

    def close(self, timeout_s: float = 1.0) -> None:
        """Ends the thread; one that is blocked in a camera driver ends with the process."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(timeout_s)


class EndOfSource(Exception):
    """The source has no further frame."""
