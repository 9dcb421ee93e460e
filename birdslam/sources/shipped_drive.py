"""The drive that ships with birdslam: rendered in the built-in world, with ground truth.

`drive.npz` has the images as WebP and the truth of each. `world/demo_world.py` defines it; `birdslam demo-drive make`
renders it again.
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
# Columns of `bodies`, one row per body in the image of each frame
COLUMNS = ("frame", "body", "label", "x_m", "y_m", "yaw_rad", "length_m", "width_m", "height_m", "vx_mps", "vy_mps",
           "visible", "truncated", "x1_px", "y1_px", "x2_px", "y2_px")  # fmt: skip
# Columns of the optional `lines`: points of painted lines and road edges in ego
LINE_COLUMNS = ("frame", "line", "kind", "x_m", "y_m")
LINE_KINDS = ("solid", "dashed", "dotted", "double", "double_dashed", "kerb")
_ARRAYS = ("images", "ends", "rate_hz", "poses", "ground", "bodies")


@dataclass(frozen=True)
class TrueBody:
    """A vehicle or person in one frame of the drive: footprint centre in ego, size and visibility."""

    body: int  # persistent over the drive
    label: str  # of LABELS
    T_ego_body: SE2
    length_m: float
    width_m: float
    height_m: float
    velocity_mps: tuple[float, float]  # over the ground, in ego axes
    visible: float  # visible share of its projection in the image
    truncated: float  # share of its box outside the image
    box_px: tuple[float, float, float, float]  # of the whole body, clipped to the image


@dataclass(frozen=True)
class TrueLine:
    """A painted line or road edge (`kerb`) in one frame of the drive, hidden parts and gaps included."""

    line: int  # persistent over the drive
    kind: str  # of LINE_KINDS
    points_m: Floats  # (N, 2) in ego


class DemoRecording(Recording):
    """The shipped drive, or another one in `directory`. Raises DatasetError if it can't be read."""

    def __init__(self, directory: Path = DIRECTORY, camera: Camera | None = None, stride: int = 1) -> None:
        self.name = NAME if directory == DIRECTORY else directory.name
        path = directory / "drive.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                images, ends, rate_hz, self._poses, self._ground, self._bodies = (file[name] for name in _ARRAYS)
                self._lines = file.get("lines")
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise DatasetError(f"{path}: not a drive of the built-in world: {error}") from None
        if not (len(ends) == len(self._poses) == len(self._ground) > 0 and int(ends[-1]) == len(images)):
            raise DatasetError(f"{path}: numbers of images, poses and ground planes differ")
        self.camera = camera or load_camera(directory / "camera.toml")
        self._images, self._starts, self._ends = images, np.concatenate([[0], ends[:-1]]), ends
        self._path, self._stride, self._source_hz = path, stride, float(rate_hz)
        self.rate_hz = self._source_hz / stride

    def __len__(self) -> int:
        return -(-len(self._ends) // self._stride)

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Yields the frames in order; images are decoded on demand."""
        for index in range(start, len(self)):
            number = index * self._stride
            t_ns = round(number * NS_PER_S / self._source_hz)
            image = cv2.imdecode(self._images[self._starts[number] : self._ends[number]], cv2.IMREAD_COLOR)
            if image is None:
                yield RecordedFrame(index, t_ns, None, f"{self._path}: image {number} can't be decoded")
            else:
                yield RecordedFrame(index, t_ns, image)  # type: ignore[arg-type]

    def truth_poses(self) -> Floats:
        """(N, 3, 4) camera poses relative to the first, in camera axes."""
        return self._poses[:: self._stride].astype(np.float64)

    def truth_ground(self, index: int) -> Ground:
        """The camera over the road in a frame, moved by the car's suspension."""
        height_m, pitch_rad, roll_rad = (float(v) for v in self._ground[index * self._stride])
        return Ground(height_m=height_m, pitch_rad=pitch_rad, roll_rad=roll_rad)

    def truth_bodies(self, index: int) -> tuple[TrueBody, ...]:
        """All bodies with a box in the image of a frame, occluded ones too."""
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
        """Whether the drive has true lines; the shipped one has none."""
        return self._lines is not None

    def truth_lines(self, index: int) -> tuple[TrueLine, ...]:
        """All lines around the ego in a frame. Raises DatasetError if the drive has none."""
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
    """Writes `drive.npz`: WebP images, (N, 3, 4) poses, (N, 3) height, pitch, roll, rows of COLUMNS, LINE_COLUMNS."""
    directory.mkdir(parents=True, exist_ok=True)
    joined = np.frombuffer(b"".join(images), np.uint8)
    ends = np.cumsum([len(image) for image in images], dtype=np.int64)
    with (directory / "drive.npz").open("wb") as file:
        arrays: Any = {"poses": poses, "ground": ground, "bodies": bodies.astype(np.float32)}
        if lines is not None:
            arrays["lines"] = lines.astype(np.float32)
        np.savez_compressed(file, images=joined, ends=ends, rate_hz=np.float64(rate_hz), **arrays)
