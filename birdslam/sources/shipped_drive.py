"""The drive that ships with birdslam: rendered in the built-in world, with its truth; read with OpenCV and numpy alone.

One file, `drive.npz`: every image as WebP, and what was true when it was taken.
`world/demo_world.py` says what happens in it; `birdslam demo-drive make` renders it again.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.sources.camera_file import load_camera
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.types import NS_PER_S, Ground

DIRECTORY = Path(__file__).parent / "drives" / "shipped"
NAME = "demo"
LABELS = ("car", "van", "truck", "bus", "cyclist", "pedestrian")
# Columns of the file's `bodies`, one row for each body in the image of each frame
COLUMNS = ("frame", "body", "label", "x_m", "y_m", "yaw_rad", "length_m", "width_m", "height_m", "vx_mps", "vy_mps",
           "visible", "truncated", "x1_px", "y1_px", "x2_px", "y2_px")  # fmt: skip
# Columns of `lines`, which a drive may have: points of the painted lines and of the road's edges in ego
LINE_COLUMNS = ("frame", "line", "kind", "x_m", "y_m")
LINE_KINDS = ("solid", "dashed", "dotted", "double", "double_dashed", "kerb")
_ARRAYS = ("images", "ends", "rate_hz", "poses", "ground", "bodies")


@dataclass(frozen=True)
class TrueBody:
    """A vehicle or person in one frame of the drive: its footprint's centre in ego, its size, what is seen of it."""

    body: int  # the same through the whole drive
    label: str  # of LABELS
    T_ego_body: SE2
    length_m: float
    width_m: float
    height_m: float
    velocity_mps: tuple[float, float]  # over the ground, in ego's axes
    visible: float  # share of its projection inside the image that nothing occludes
    truncated: float  # share of its box that lies outside the image
    box_px: tuple[float, float, float, float]  # of the whole body, clipped to the image


@dataclass(frozen=True)
class TrueLine:
    """A painted line, or the road's edge (`kerb`), in one frame of the drive: also where it is hidden, or has gaps."""

    line: int  # the same through the whole drive
    kind: str  # of LINE_KINDS
    points_m: Floats  # (N, 2) in ego


class DemoRecording(Recording):
    """The shipped drive, or another of its kind in `directory`. Raises DatasetError where it can't be read."""

    def __init__(self, directory: Path = DIRECTORY, camera: Camera | None = None, stride: int = 1) -> None:
        self.name = NAME if directory == DIRECTORY else directory.name
        path = directory / "drive.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                images, ends, rate_hz, self._poses, self._ground, self._bodies = (file[name] for name in _ARRAYS)
                self._lines = file.get("lines")
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise DatasetError(f"{path}: is no drive of the built-in world: {error}") from None
        if not (len(ends) == len(self._poses) == len(self._ground) > 0 and int(ends[-1]) == len(images)):
            raise DatasetError(f"{path}: its images, poses and ground planes do not belong together")
        self.camera = camera or load_camera(directory / "camera.toml")
        self._images, self._starts, self._ends = images, np.concatenate([[0], ends[:-1]]), ends
        self._path, self._stride, self._source_hz = path, stride, float(rate_hz)
        self.rate_hz = self._source_hz / stride

    def __len__(self) -> int:
        return -(-len(self._ends) // self._stride)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Every frame in order, decoded when asked for."""
        for index in range(start, len(self)):
            number = index * self._stride
            t_ns = round(number * NS_PER_S / self._source_hz)
            image = cv2.imdecode(self._images[self._starts[number] : self._ends[number]], cv2.IMREAD_COLOR)
            if image is None:
                yield RecordedFrame(index, t_ns, None, f"{self._path}: image {number} can't be decoded")
            else:
                yield RecordedFrame(index, t_ns, image)  # type: ignore[arg-type]

    def truth_poses(self) -> Floats:
        """(N, 3, 4) rows of the camera against its first pose, in camera axes."""
        return self._poses[:: self._stride].astype(np.float64)

    def truth_ground(self, index: int) -> Ground:
        """The camera over the road in a frame: its springs move it."""
        height_m, pitch_rad, roll_rad = (float(v) for v in self._ground[index * self._stride])
        return Ground(height_m=height_m, pitch_rad=pitch_rad, roll_rad=roll_rad)

    def truth_bodies(self, index: int) -> tuple[TrueBody, ...]:
        """Every body whose box reaches into the image of a frame, occluded ones too."""
        out = []
        for row in self._bodies[self._bodies[:, 0] == index * self._stride].astype(np.float64).tolist():
            _, body, label, x, y, yaw, length, width, height, vx, vy, visible, truncated, *box = row
            out.append(
                TrueBody(
                    int(body), LABELS[int(label)], SE2(x, y, yaw), length, width, height, (vx, vy), visible, truncated,
                    (box[0], box[1], box[2], box[3]),
                )
            )  # fmt: skip
        return tuple(out)

    @property
    def has_lines(self) -> bool:
        """Whether the drive knows its true lines: the shipped one does not."""
        return self._lines is not None

    def truth_lines(self, index: int) -> tuple[TrueLine, ...]:
        """Every line around the ego in a frame. Raises DatasetError where the drive has none."""
        if self._lines is None:
            raise DatasetError(f"{self._path}: has no true lines: render it again (`python -m perf roads --keep DIR`)")
        rows = self._lines[self._lines[:, 0] == index * self._stride].astype(np.float64)
        return tuple(
            TrueLine(int(line), LINE_KINDS[int(kind)], rows[(rows[:, 1] == line) & (rows[:, 2] == kind), 3:])
            for line, kind in np.unique(rows[:, 1:3], axis=0)
        )


def write_drive(
    directory: Path,
    images: list[bytes],
    rate_hz: float,
    poses: Floats,
    ground: Floats,
    bodies: Floats,
    lines: Floats | None = None,
) -> None:
    """Write `drive.npz`: WebP images, (N, 3, 4) poses, (N, 3) height, pitch, roll, rows of COLUMNS, LINE_COLUMNS."""
    directory.mkdir(parents=True, exist_ok=True)
    joined = np.frombuffer(b"".join(images), np.uint8)
    ends = np.cumsum([len(image) for image in images], dtype=np.int64)
    with (directory / "drive.npz").open("wb") as file:
        arrays: Any = {"poses": poses, "ground": ground, "bodies": bodies.astype(np.float32)}
        if lines is not None:
            arrays["lines"] = lines.astype(np.float32)
        np.savez_compressed(file, images=joined, ends=ends, rate_hz=np.float64(rate_hz), **arrays)
