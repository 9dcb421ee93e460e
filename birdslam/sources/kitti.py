"""KITTI recordings (Geiger et al., 2012 and 2013).

Times, poses and images are matched by image number: a missing number is an unreadable frame. Without times the rate is
10 Hz. KITTI's axes are converted here and in `trajectory.py` only. All errors are DatasetError and name the path.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.trajectory import read_kitti
from birdslam.types import NS_PER_S

KITTI_HEIGHT_M = 1.65  # of KITTI's cameras over the road (Geiger et al. 2013); calibration files lack it
KITTI_RATE_HZ = 10.0
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
IMAGE_NUMBER = re.compile(r"[0-9]{1,12}")
JPEG_BEGIN, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_BEGIN = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Layout:
    """Paths of the parts of a recording; `times` and `truth` may be missing."""

    name: str
    images: Path
    calibration: Path
    key: str  # name of the camera's projection matrix
    times: Path | None = None
    truth: Path | None = None


def find_layout(directory: Path) -> Layout:
    """Finds the layout of a recording from the content of its directory DIR (N: sequence, R: root).

    | layout   | DIR          | images        | calibration             | times                   | truth             |
    |----------|--------------|---------------|-------------------------|-------------------------|-------------------|
    | odometry | sequences/N  | image_0, or 2 | calib.txt               | times.txt               | ../../poses/N.txt |
    | tracking | R/image_02/N | in DIR        | R/calib/N.txt           | -                       | R/pose_cam0/N.txt |
    | raw      | DATE/DRIVE   | image_02/data | ../calib_cam_to_cam.txt | image_02/timestamps.txt | -                 |
    | clip     | any          | image_02      | calib.txt               | times.txt               | pose_cam0.txt     |

    Raises DatasetError.
    """
    if not directory.is_dir():
        raise DatasetError(f"{directory}: {'not a directory' if directory.exists() else 'no such directory'}")
    directory = directory.resolve()
    for index in (0, 2, 1, 3):
        images = directory / f"image_{index}"
        if images.is_dir():
            truth = directory.parent.parent / "poses" / f"{directory.name}.txt"
            times = directory / "times.txt"
            return Layout(directory.name, images, directory / "calib.txt", f"P{index}", times, truth)
    parent = directory.parent
    if parent.name.startswith("image_0") and directory.name.isdigit():
        root, file = parent.parent, f"{directory.name}.txt"
        key = f"P{parent.name[-1]}"
        return Layout(directory.name, directory, root / "calib" / file, key, None, root / "pose_cam0" / file)
    for index in (2, 0, 3, 1):
        images = directory / f"image_0{index}"
        if (images / "data").is_dir():
            calibration = parent / "calib_cam_to_cam.txt"
            return Layout(directory.name, images / "data", calibration, f"P_rect_0{index}", images / "timestamps.txt")
        sequences = sorted(folder.name for folder in images.glob("[0-9]*") if folder.is_dir())
        if sequences:
            raise DatasetError(
                f"{directory}: contains the sequences {', '.join(sequences)}; name one, as in "
                f"kitti:{images / sequences[0]}"
            )
        if images.is_dir():
            truth = directory / "pose_cam0.txt"
            times = directory / "times.txt"
            return Layout(directory.name, images, directory / "calib.txt", f"P{index}", times, truth)
    raise DatasetError(f"{directory}: not a KITTI recording: no image_0, image_2 or image_02 in it")


def find_images(folder: Path) -> dict[int, Path]:
    """The images of a folder by number. Raises DatasetError."""
    images: dict[int, Path] = {}
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        raise DatasetError(f"{folder}: can't be read: {error.strerror}") from None
    for path in paths:
        if path.suffix.lower() in IMAGE_SUFFIXES and IMAGE_NUMBER.fullmatch(path.stem):
            number = int(path.stem)
            if number in images:
                raise DatasetError(f"{folder}: two images with number {number}: {images[number].name}, {path.name}")
            images[number] = path
    if not images:
        raise DatasetError(f"{folder}: no images in it (NNNNNN.png or .jpg)")
    span = max(images) - min(images) + 1
    if 2 * len(images) < span:  # a stray file name must not create a million unreadable frames
        raise DatasetError(f"{folder}: only {len(images)} images for the numbers {min(images)} to {max(images)}")
    return images


def read_image(path: Path) -> NDArray[np.uint8]:
    """The image as stored, 8 bit, grey or BGR. Raises ValueError with the reason, without the path."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(error.strerror) from None
    return decode_image(data)


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decodes a PNG or JPEG file to 8 bit, grey or BGR. Raises ValueError with the reason."""
    if data.startswith(JPEG_BEGIN) and JPEG_END not in data[-32:]:
        raise ValueError("truncated JPEG")  # OpenCV would fill the rest with grey
    image = None
    if not data.startswith(PNG_BEGIN) or _has_whole_chunks(data):
        with suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ValueError(f"damaged or not an image ({len(data)} bytes)")
    return image  # type: ignore[return-value]


def _has_whole_chunks(png: bytes) -> bool:
    """OpenCV allocates what a damaged chunk states, up to 4 GB."""
    at, name = len(PNG_BEGIN), b""
    while at < len(png) and name != b"IEND":
        name = png[at + 4 : at + 8]
        at += 12 + int.from_bytes(png[at : at + 4], "big")  # length, name, content, checksum
    return name == b"IEND" and at <= len(png)


def first_image_size(folder: Path, images: dict[int, Path]) -> tuple[Path, tuple[int, int]]:
    """The first readable image and its (width, height) in pixels. Raises DatasetError if there is none."""
    reason = ""
    for path in images.values():
        try:
            height_px, width_px = read_image(path).shape[:2]
        except ValueError as error:
            reason = reason or f"{path.name}: {error}"
        else:
            return path, (width_px, height_px)
    raise DatasetError(f"{folder}: no readable image ({reason})")


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii", errors="replace").split("\n")
    except OSError as error:
        raise DatasetError(f"{path}: can't be read: {error.strerror}") from None


def read_projection(path: Path, key: str) -> Floats:
    """(3, 4) projection matrix of a KITTI calibration file."""
    lines = _read_lines(path)
    words = next((line.split()[1:] for line in lines if line.split()[:1] in ([f"{key}:"], [key])), None)
    if words is None:
        raise DatasetError(f"{path}: has no {key}")
    try:
        P = np.array([float(word) for word in words])
    except ValueError:
        raise DatasetError(f"{path}: {key} contains a value that is not a number") from None
    if P.size != 12:
        raise DatasetError(f"{path}: {key} has {P.size} numbers, not 12")
    if not np.isfinite(P).all():
        raise DatasetError(f"{path}: {key} has numbers that are not finite")
    P = P.reshape(3, 4)
    if P[0, 0] <= 0.0 or P[1, 1] <= 0.0:
        raise DatasetError(f"{path}: {key} has the focal lengths {P[0, 0]:g}, {P[1, 1]:g} px")
    if np.abs([P[0, 1], P[1, 0], P[2, 0], P[2, 1], P[2, 2] - 1.0]).max() > 1e-6:
        raise DatasetError(f"{path}: {key} is not the projection matrix of a rectified camera")
    return P


def read_times(path: Path) -> list[int]:
    """Times in ns from seconds since the start, or from date and time of day."""
    times: list[int] = []
    for number, line in enumerate(_read_lines(path), start=1):
        if not line.strip():
            continue
        try:
            if "-" in line.strip()[1:] and ":" in line:
                t_ns = int(np.datetime64(line.strip(), "ns").astype(np.int64))
            else:
                t_ns = round(float(line) * NS_PER_S)
        except (ValueError, OverflowError):
            raise DatasetError(f"{path}: line {number} is not a time: {line[:40]!r}") from None
        if times and t_ns <= times[-1]:
            raise DatasetError(f"{path}: line {number} is not later than the previous time")
        times.append(t_ns)
    return times


class KittiRecording(Recording):
    """A KITTI recording in one of the layouts of `find_layout`."""

    def __init__(self, directory: Path, camera: Camera | None = None, stride: int = 1) -> None:
        layout = self._layout = find_layout(directory)
        self._images = find_images(layout.images)
        self.numbers = range(min(self._images), max(self._images) + 1, stride)  # of the images, one per frame
        self.name = layout.name
        self.camera = self._open_camera(camera)
        self._t_ns: list[int] | None = None
        self.rate_hz = KITTI_RATE_HZ / stride
        if layout.times and layout.times.is_file():
            times = read_times(layout.times)
            if len(times) <= self.numbers[-1]:
                raise DatasetError(
                    f"{layout.times}: {len(times)} times, but the images in {layout.images} "
                    f"end at number {max(self._images)}"
                )
            self._t_ns = [times[number] for number in self.numbers]
            if len(self._t_ns) > 1:
                self.rate_hz = NS_PER_S / float(np.median(np.diff(self._t_ns)))

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int]:
        """Size of the first readable image. Raises DatasetError."""
        folder = find_layout(path).images
        return first_image_size(folder, find_images(folder))[1]

    def _open_camera(self, camera: Camera | None) -> Camera:
        """The given camera, or the recording's own; must fit the first readable image."""
        path, (width_px, height_px) = first_image_size(self._layout.images, self._images)
        if camera is not None:
            if (camera.width_px, camera.height_px) != (width_px, height_px):
                raise DatasetError(
                    f"{path}: is {width_px}x{height_px}, but the given camera is {camera.width_px}x{camera.height_px}"
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
        """Yields the frames in order; images are read on demand."""
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
        """The folder of the images; other recorded data (LiDAR) is next to it."""
        return self._layout.images

    def truth_poses(self) -> Floats | None:
        """(N, 3, 4) camera-0 rows of the frames. Raises DatasetError for a damaged or too short file."""
        path = self._layout.truth
        if path is None or not path.is_file():
            return None
        try:
            rows = read_kitti(path)
        except ValueError as error:
            raise DatasetError(str(error)) from None
        if len(rows) <= self.numbers[-1]:
            raise DatasetError(f"{path}: {len(rows)} poses, but the images end at number {max(self._images)}")
        return rows[list(self.numbers)]

    def T_cam0_cam(self) -> Floats:
        """(4, 4) from the calibration; identity without one. Rectified cameras share their axes.

        P = K [I | t] projects points of camera 0, so this camera is at -t.
        """
        out = np.eye(4)
        if self._layout.calibration.is_file():
            P = read_projection(self._layout.calibration, self._layout.key)
            out[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        return out
