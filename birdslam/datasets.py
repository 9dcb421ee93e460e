"""Recorded drives as frames: KITTI odometry, tracking, raw drives and clips, and video files; and camera files.

`kitti:DIR` takes each layout of `kitti.py`. Times, poses and images belong together by the image's number: a number
missing in the middle is an unreadable frame, never a shift. Where no times are given the drive is at KITTI's 10 Hz;
KITTI's cameras stand KITTI_HEIGHT_M (1.65 m) over the road. Foreign axes are turned into ours here and in
`trajectory.py`, nowhere else.
"""

from __future__ import annotations

import math
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.camera import Camera
from birdslam.kitti import (
    KITTI_HEIGHT_M,
    KITTI_RATE_HZ,
    NS_PER_S,
    DatasetError,
    find_images,
    find_layout,
    read_image,
    read_projection,
    read_times,
)
from birdslam.trajectory import read_kitti

__all__ = [
    "DatasetError",
    "KittiRecording",
    "RecordedFrame",
    "Recording",
    "VideoRecording",
    "load_camera",
    "open_recording",
    "read_speeds",
]


@dataclass(frozen=True)
class RecordedFrame:
    """One frame; `image` (H, W) grey or (H, W, 3) BGR as stored, None where it is unreadable and `error` says why."""

    index: int  # 0, 1, 2, ... of this recording, whatever its stride
    t_source_ns: int  # the recording's own clock
    image: NDArray[np.uint8] | None
    error: str | None = None


class Recording(ABC):
    """A recorded drive of one camera. `rate_hz` is nominal, after the stride; frames are not yet undistorted."""

    name: str
    camera: Camera
    rate_hz: float

    @abstractmethod
    def __len__(self) -> int:
        """Frames in the recording, unreadable ones counted."""

    @abstractmethod
    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, from index `start` on; an unreadable one has no image, and the iteration goes on."""

    def truth_poses(self) -> NDArray[np.float64] | None:
        """(N, 3, 4) poses of camera 0 as KITTI rows in metres, one a frame; None where there are none."""
        return None

    def T_cam0_cam(self) -> NDArray[np.float64]:
        """(4, 4) this camera in the axes of camera 0, whose poses the truth gives: the lever arm between the two."""
        return np.eye(4)


def open_recording(uri: str, camera: Camera | None = None, stride: int = 1) -> Recording:
    """Open `kitti:DIR`, `video:FILE` or `demo`, the drive that ships with birdslam, every `stride`-th frame of it.

    `camera` goes before the recording's own calibration.

    Raises DatasetError where it can't be used.
    """
    scheme, _, rest = uri.partition(":")
    if stride < 1:
        raise DatasetError(f"{uri}: the stride must be 1 or more, got {stride}")
    if scheme == "demo" and not rest:
        from birdslam.demo_drive import DemoRecording  # only now: it is a Recording of this module

        return DemoRecording(camera, stride)
    if not rest or scheme not in ("kitti", "video"):
        raise DatasetError(f"{uri}: no recording; expected kitti:DIR, video:FILE or demo")
    path = Path(rest).expanduser()
    return KittiRecording(path, camera, stride) if scheme == "kitti" else VideoRecording(path, camera, stride)


def load_camera(path: Path) -> Camera:
    """The camera of a TOML file whose keys are the fields of `Camera`. Raises DatasetError naming file and key."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Camera)
    except OSError as error:
        raise DatasetError(f"camera file {path}: can't be read: {error.strerror}") from None
    except (ValueError, msgspec.ValidationError) as error:  # ValueError: no UTF-8, or no TOML
        raise DatasetError(f"camera file {path}: {error}") from None


def read_speeds(path: Path) -> NDArray[np.float64]:
    """(N, 2) of a text file: time in s by the recording's clock, speed in m/s; by commas or blanks, `#` comments."""
    rows: list[tuple[float, float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            t_s, speed_mps = (float(word) for word in words)
        except ValueError:
            raise DatasetError(f"{path}: line {number} is no time in s and speed in m/s: {line[:40]!r}") from None
        if not (math.isfinite(t_s) and 0.0 <= speed_mps < 150.0):
            raise DatasetError(f"{path}: line {number}: {speed_mps:g} m/s at {t_s:g} s is no speed of a car")
        if rows and t_s <= rows[-1][0]:
            raise DatasetError(f"{path}: line {number} is not later than the time before it")
        rows.append((t_s, speed_mps))
    if len(rows) < 2:
        raise DatasetError(f"{path}: holds {len(rows)} speeds, 2 are needed")
    return np.array(rows)


class KittiRecording(Recording):
    """A KITTI recording in one of the layouts of this module's table."""

    def __init__(self, directory: Path, camera: Camera | None = None, stride: int = 1) -> None:
        layout = self._layout = find_layout(directory)
        self._images = find_images(layout.images)
        self.numbers = range(min(self._images), max(self._images) + 1, stride)  # of the images, one a frame
        self.name = layout.name
        self.camera = self._open_camera(camera)
        self._t_ns: list[int] | None = None
        self.rate_hz = KITTI_RATE_HZ / stride
        if layout.times and layout.times.is_file():
            times = read_times(layout.times)
            if len(times) <= self.numbers[-1]:
                raise DatasetError(
                    f"{layout.times}: {len(times)} times, but the images in {layout.images} "
                    f"go on to number {max(self._images)}"
                )
            self._t_ns = [times[number] for number in self.numbers]
            if len(self._t_ns) > 1:
                self.rate_hz = NS_PER_S / float(np.median(np.diff(self._t_ns)))

    def _open_camera(self, camera: Camera | None) -> Camera:
        """The camera given, or the recording's own; either must fit the first image that can be read."""
        reason = ""
        for path in self._images.values():
            try:
                height_px, width_px = read_image(path).shape[:2]
                break
            except ValueError as error:
                reason = reason or f"{path.name}: {error}"
        else:
            raise DatasetError(f"{self._layout.images}: none of its images can be read ({reason})")
        if camera is not None:
            if (camera.width_px, camera.height_px) != (width_px, height_px):
                raise DatasetError(
                    f"{path}: is {width_px}x{height_px}, but the camera given is {camera.width_px}x{camera.height_px}"
                )
            return camera
        (fx, _, cx, _), (_, fy, cy, _), _ = read_projection(self._layout.calibration, self._layout.key).tolist()
        try:
            return Camera(width_px, height_px, fx, fy, cx, cy, height_m=KITTI_HEIGHT_M)
        except ValueError as error:
            raise DatasetError(f"{self._layout.calibration}: {self._layout.key}: {error}") from None

    def __len__(self) -> int:
        return len(self.numbers)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, read when asked for."""
        for index, number in enumerate(self.numbers[start:], start):
            t_ns = self._t_ns[index] if self._t_ns else round(number / KITTI_RATE_HZ * NS_PER_S)
            try:
                yield RecordedFrame(index, t_ns, self._read(number))
            except ValueError as error:
                yield RecordedFrame(index, t_ns, None, str(error))

    def _read(self, number: int) -> NDArray[np.uint8]:
        path = self._images.get(number)
        if path is None:
            raise ValueError(f"{self._layout.images}: image number {number} is missing")
        try:
            image = read_image(path)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        size = (image.shape[1], image.shape[0])
        if size != (self.camera.width_px, self.camera.height_px):
            raise ValueError(
                f"{path}: is {size[0]}x{size[1]}, not {self.camera.width_px}x{self.camera.height_px} as the camera"
            )
        return image

    @property
    def directory(self) -> Path:
        """The folder of the images; what else was recorded (LiDAR) stands beside it."""
        return self._layout.images

    def truth_poses(self) -> NDArray[np.float64] | None:
        """(N, 3, 4) camera-0 rows of the frames. Raises DatasetError where the file is torn or too short."""
        path = self._layout.truth
        if path is None or not path.is_file():
            return None
        try:
            rows = read_kitti(path)
        except ValueError as error:
            raise DatasetError(str(error)) from None
        if len(rows) <= self.numbers[-1]:
            raise DatasetError(f"{path}: {len(rows)} poses, but the images go on to number {max(self._images)}")
        return rows[list(self.numbers)]

    def T_cam0_cam(self) -> NDArray[np.float64]:
        """(4, 4) from the calibration (rectified cameras share their axes); identity where there is none.

        P = K [I | t] takes points of camera 0, so this camera stands at -t.
        """
        out = np.eye(4)
        if self._layout.calibration.is_file():
            P = read_projection(self._layout.calibration, self._layout.key)
            out[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        return out


class VideoRecording(Recording):
    """A video file, through OpenCV; `len` is what its container declares (0 where it declares nothing)."""

    def __init__(self, path: Path, camera: Camera | None, stride: int = 1) -> None:
        if camera is None:
            raise DatasetError(f"video:{path}: a video knows nothing of its camera: a camera file is needed")
        if not path.is_file():
            raise DatasetError(f"{path}: {'is no file' if path.exists() else 'no such file'}")
        self._path, self.camera, self._stride, self.name = path, camera, stride, path.stem
        capture = self._open()
        fps, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        size = (round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
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

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise DatasetError(f"{self._path}: is no video that OpenCV can open")
        return capture

    def __len__(self) -> int:
        return -(-self._declared // self._stride)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, its time from the container; a file cut off ends with one unreadable frame."""
        capture = self._open()
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
