"""Video files as recorded drives, through OpenCV."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2

from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.types import NS_PER_S


class VideoRecording(Recording):
    """A video file, through OpenCV; `len` is what its container declares (0 where it declares nothing)."""

    def __init__(self, path: Path, camera: Camera | None, stride: int = 1) -> None:
        if camera is None:
            raise DatasetError(f"video:{path}: a video knows nothing of its camera: a camera file is needed")
        self._path, self.camera, self._stride, self.name = path, camera, stride, path.stem
        capture = _capture(path)
        fps, count, size = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT), _size(capture)
        capture.release()
        if not (math.isfinite(fps) and 0.0 < fps <= 1000.0):
            raise DatasetError(f"{path}: its container states no usable frame rate ({fps:g})")
        if size != (camera.width_px, camera.height_px):
            raise DatasetError(
                f"{path}: is {size[0]}x{size[1]}, but the camera given is {camera.width_px}x{camera.height_px}"
            )
        self._period_ns = round(NS_PER_S / fps)
        self._declared = max(int(count), 0)
        self.rate_hz = fps / stride

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int]:
        """As the container declares. Raises DatasetError where OpenCV can't open it."""
        capture = _capture(path)
        size = _size(capture)
        capture.release()
        return size

    def __len__(self) -> int:
        return -(-self._declared // self._stride)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, its time from the container; a file cut off ends with one unreadable frame."""
        capture = _capture(self._path)
        try:
            position, index, t_ns = 0, 0, -self._period_ns
            while capture.grab():
                stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                t_ns = stamp_ns if stamp_ns > t_ns else t_ns + self._period_ns  # containers without times give zeros
                if position % self._stride == 0 and index < start:
                    index += 1
                elif position % self._stride == 0:
                    ok, image = capture.retrieve()
                    error = None if ok else f"{self._path}: frame {position} can't be decoded"
                    yield RecordedFrame(index, t_ns, image if ok else None, error)  # type: ignore[arg-type]
                    index += 1
                position += 1
            if position < 0.99 * self._declared - 1.0:  # some containers miscount by a frame
                error = f"{self._path}: ends after {position} of {self._declared} frames: cut off"
                yield RecordedFrame(index, t_ns + self._period_ns, None, error)
        finally:
            capture.release()


def _capture(path: Path) -> cv2.VideoCapture:
    """The film, opened. Raises DatasetError."""
    if not path.is_file():
        raise DatasetError(f"{path}: {'is no file' if path.exists() else 'no such file'}")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DatasetError(f"{path}: is no video that OpenCV can open")
    return capture


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
