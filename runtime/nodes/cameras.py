"""Live cameras through OpenCV: of this computer (V4L2) and of the network (RTSP)."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Generator
from itertools import count, islice
from pathlib import Path

import cv2
import numpy as np

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.sources import SourceError
from birdslam.sources.recording import RecordedFrame

LIVE_RATE_HZ = 30.0  # of a camera that does not report its rate


class LiveCamera(ABC):
    """A source (nodes/sources.py) whose frames are stamped with CLOCK_MONOTONIC on arrival."""

    live = True

    def __init__(self, configuration: Configuration, must_open: bool = True) -> None:
        """Raises SourceError if the camera does not open, unless `must_open` is False."""
        assert configuration.camera is not None  # checked by `open_source`
        config = configuration.source
        self.name = self._uri = config.uri
        self.camera = configuration.camera
        self.rate_hz = config.rate if isinstance(config.rate, float) else LIVE_RATE_HZ
        self._config = config
        self._closing = threading.Event()
        self._capture: cv2.VideoCapture | None = None
        try:
            self._capture = self._open()
        except SourceError:
            if must_open:
                raise

    @abstractmethod
    def _connect(self) -> cv2.VideoCapture:
        """Returns the capture with image size and rate requested; `_open` checks whether it opened."""

    def _open(self) -> cv2.VideoCapture:
        capture = self._connect()
        if not capture.isOpened():
            raise SourceError(f"{self._uri}: does not open as a camera or video stream")
        size = tuple(int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if size != (self.camera.width_px, self.camera.height_px):
            capture.release()
            raise SourceError(
                f"{self._uri}: delivers {size[0]}x{size[1]} px, the camera file is for "
                f"{self.camera.width_px}x{self.camera.height_px}"
            )
        self.rate_hz = capture.get(cv2.CAP_PROP_FPS) or self.rate_hz
        return capture

    def frames(self) -> Generator[RecordedFrame]:
        """Yields frames stamped with CLOCK_MONOTONIC; frames without an image while the camera is disconnected."""
        try:
            for index in islice(count(), self._config.frames):
                if self._capture is None or not self._capture.grab():
                    self._reopen()
                    yield RecordedFrame(index, time.monotonic_ns(), None, f"{self._uri}: delivers no frame")
                    continue
                t_ns = time.monotonic_ns()
                ok, image = self._capture.retrieve()
                if ok:
                    yield RecordedFrame(index, t_ns, np.asarray(image, dtype=np.uint8), None)
                else:
                    yield RecordedFrame(index, t_ns, None, f"{self._uri}: frame {index} does not decode")
        finally:
            self.close()

    def _reopen(self) -> None:
        """Tries once to reopen the camera; pauses after a failure, which limits how often the loss is reported."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
        try:
            self._capture = self._open()
        except SourceError:
            self._closing.wait(self._config.reopen_ms / 1e3)

    def resume(self, frame_id: int, t_source_ns: int) -> None:  # noqa: B027  # optional hook
        """Does nothing: a live camera needs no seek."""

    def close(self) -> None:
        """Releases the camera."""
        self._closing.set()
        if self._capture is not None:
            self._capture.release()


class DeviceCamera(LiveCamera):
    """`v4l2:/dev/videoN`."""

    def _connect(self) -> cv2.VideoCapture:
        address = self._uri.partition(":")[2]
        if not Path(address).exists():
            raise SourceError(f"{self._uri}: no such device: {address}")
        capture = cv2.VideoCapture(address, cv2.CAP_V4L2)
        if capture.isOpened():
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height_px)
            if isinstance(self._config.rate, float):
                capture.set(cv2.CAP_PROP_FPS, self._config.rate)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # deliver the newest image
        return capture


class NetworkCamera(LiveCamera):
    """`rtsp://HOST/PATH`, read by FFmpeg."""

    def _connect(self) -> cv2.VideoCapture:
        timeout_ms = round(self._config.camera_timeout_s * 1e3)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms]
        return cv2.VideoCapture(self._uri, cv2.CAP_FFMPEG, limits)
