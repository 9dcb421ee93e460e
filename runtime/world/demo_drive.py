"""Renders the shipped drive and writes it in the format of `DemoRecording`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.runtime.progress import with_progress
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import COLUMNS, LABELS, LINE_COLUMNS, LINE_KINDS, write_drive

if TYPE_CHECKING:
    from birdslam.world.truth import WorldFrame

LINES_TO_M, LINE_STEP_M = 60.0, 2.0  # extent and spacing of the true lines
SAMPLES = 2  # per pixel, horizontally and vertically
CAMERA_KEYS = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "height_m", "pitch_rad", "roll_rad")


def make(directory: Path, frames: int | None, quality: int) -> int:
    """Renders the first `frames` (None: all) with progress on standard error; returns their number.

    `quality` of the WebP images is 1 to 100. Raises DatasetError for values out of range or without the renderer.
    """
    try:
        from birdslam.world.demo_world import CAMERA, FRAMES, RATE_HZ, demo_scenario
        from birdslam.world.scenario import drive
    except ImportError as error:
        raise DatasetError(f"rendering needs the extra `train` (pip install 'birdslam[train]'): {error}") from None
    if not 1 <= quality <= 100:
        raise DatasetError(f"--quality {quality}: expected 1 to 100")
    count = FRAMES if frames is None else frames
    if not 1 <= count <= FRAMES:
        raise DatasetError(f"--frames {count}: expected 1 to {FRAMES}")
    rendered = with_progress(drive(demo_scenario(), CAMERA, count, RATE_HZ, SAMPLES), "demo drive", count)
    write(directory, rendered, CAMERA, RATE_HZ, quality)
    return count


def write(directory: Path, frames: Iterable[WorldFrame], camera: Camera, rate_hz: float, quality: int) -> None:
    """Writes a rendered drive; `quality` of the WebP images is 1 to 100."""
    images: list[bytes] = []
    poses: list[Floats] = []
    ground: list[tuple[float, float, float]] = []
    bodies: list[tuple[float, ...]] = []
    lines: list[Floats] = []
    for frame in frames:
        images.append(_webp(frame.image, quality))
        poses.append(frame.T_world_cam)
        ground.append((frame.camera.height_m, frame.camera.pitch_rad, frame.camera.roll_rad))
        bodies.extend(_rows(frame))
        lines.append(_line_rows(frame))
    from_first = (np.linalg.inv(poses[0]) @ np.array(poses)).astype(np.float64)
    write_drive(
        directory,
        images,
        rate_hz,
        from_first[:, :3],
        np.array(ground),
        np.array(bodies).reshape(-1, len(COLUMNS)),
        np.concatenate(lines),
    )
    (directory / "camera.toml").write_text(_toml(camera), encoding="utf-8")


def _webp(image: NDArray[np.uint8], quality: int) -> bytes:
    ok, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not ok:
        raise DatasetError("this build of OpenCV can't write WebP")
    return data.tobytes()


def _rows(frame: WorldFrame) -> Iterator[tuple[float, ...]]:
    """Yields a row of COLUMNS per body in the frame, with velocities in ego."""
    forward = frame.T_world_cam[:2, 2] / np.linalg.norm(frame.T_world_cam[:2, 2])
    for body in frame.objects:
        along = float(forward @ body.velocity_mps)
        left = float(forward[0] * body.velocity_mps[1] - forward[1] * body.velocity_mps[0])
        T = body.T_ego_object
        yield (
            frame.frame_id, body.object_id, LABELS.index(body.label), T.x_m, T.y_m, T.yaw_rad,
            body.length_m, body.width_m, body.height_m, along, left, body.visible, body.truncated,
            *body.box_px.tolist(),
        )  # fmt: skip


def _line_rows(frame: WorldFrame) -> Floats:
    """Returns rows of LINE_COLUMNS: the points of each line from the ego to LINES_TO_M ahead."""
    rows = [np.zeros((0, len(LINE_COLUMNS)))]
    for lane in frame.lanes:
        x = lane.points_m[:, 0]
        points = lane.points_m[(x > -LINE_STEP_M) & (x < LINES_TO_M)]
        kept = points[:: max(1, round(LINE_STEP_M / _spacing_m(lane.points_m)))]
        known = np.tile([frame.frame_id, lane.lane_id, LINE_KINDS.index(lane.kind)], (len(kept), 1))
        rows.append(np.hstack([known, kept]))
    return np.concatenate(rows)


def _spacing_m(points_m: Floats) -> float:
    return max(float(np.linalg.norm(np.diff(points_m, axis=0), axis=1).mean()), 1e-3)


def _toml(camera: Camera) -> str:
    lines = ["# The camera of a rendered drive. The suspension moves it around this height, pitch and roll"]
    lines += [f"{name} = {getattr(camera, name)}" for name in CAMERA_KEYS]
    return "\n".join(lines) + "\n"
