"""Images with known camera poses and the points that they share, as COLMAP, nerfstudio, TUM and KITTI store them.

The points are corners that were tracked through the images, triangulated from the given poses.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.trajectory import Transform, inverse, kitti_row, tum_row

Image = NDArray[np.uint8]

_PIXEL_CENTRE = 0.5  # COLMAP's and nerfstudio's first pixel has its centre at (0.5, 0.5), OpenCV's at (0, 0)
_MAX_ERROR_RAD = 0.003  # RMS of the reprojection, at which a point is an outlier
_MIN_ANGLE_RAD = 0.02  # between the rays of a point
_MIN_VIEWS = 3
_MIN_DEPTH_M = 0.1
_STEPS = 3  # of Gauss-Newton
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes x right, y up, z back


@dataclass(frozen=True)
class PosedImage:
    """An exported image: file name, time, pose in a world with z up, and its tracked corners."""

    name: str
    t_ns: int
    T_world_cam: Transform
    ids: NDArray[np.int64]  # (N,) of the corners
    px: Floats  # (N, 2)


@dataclass(frozen=True)
class Point:
    """A triangulated corner: position in world (m), BGR colour, RMS reprojection (px), and (image, corner) indices."""

    p_world: Floats
    colour: tuple[int, int, int]
    error_px: float
    track: tuple[tuple[int, int], ...]


class PosedImages:
    """The exported images of one undistorted pinhole camera, and the corners that were tracked through them."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.images: list[PosedImage] = []
        self._colours: dict[int, tuple[int, int, int]] = {}  # BGR, by corner

    def add(self, posed: PosedImage, image: Image) -> None:
        """Adds an image (H, W, 3) BGR or (H, W), for the colours of its corners."""
        last = np.array(image.shape[1::-1]) - 1
        for corner, (u, v) in zip(posed.ids.tolist(), np.rint(posed.px).astype(int).clip(0, last), strict=True):
            if corner not in self._colours:
                blue, green, red = np.broadcast_to(image[v, u], 3).tolist()
                self._colours[corner] = blue, green, red
        self.images.append(posed)

    def points(self) -> list[Point]:
        """Triangulates the corners of three or more images by least squares; outliers are left out."""
        seen: dict[int, list[tuple[int, int]]] = {}
        for k, image in enumerate(self.images):
            for row, corner in enumerate(image.ids.tolist()):
                seen.setdefault(corner, []).append((k, row))
        found = (self._point(corner, track) for corner, track in seen.items() if len(track) >= _MIN_VIEWS)
        return [point for point in found if point is not None]

    def _point(self, corner: int, track: Sequence[tuple[int, int]]) -> Point | None:
        poses = np.stack([self.images[k].T_world_cam for k, _ in track])
        px = np.stack([self.images[k].px[row] for k, row in track])
        rays = np.einsum("nij,nj->ni", poses[:, :3, :3], np.column_stack([self.camera.to_xy(px), np.ones(len(px))]))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        if float(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))) < _MIN_ANGLE_RAD:
            return None
        # The point nearest to all rays, then Gauss-Newton on the reprojection
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        p = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, poses[:, :3, 3]))
        focal = np.array([self.camera.fx_px, self.camera.fy_px])
        R, rms_px = np.swapaxes(poses[:, :3, :3], 1, 2), np.inf
        for step in range(_STEPS + 1):
            q = np.einsum("nij,nj->ni", R, p - poses[:, :3, 3])
            if (q[:, 2] < _MIN_DEPTH_M).any():
                return None
            by_z = 1.0 / q[:, 2]
            xy = q[:, :2] * by_z[:, None]
            error = (xy - self.camera.to_xy(px)) * focal
            if step == _STEPS:
                rms_px = float(np.sqrt((error**2).sum(axis=1).mean()))
                break
            J = (R[:, :2] - xy[:, :, None] * R[:, 2:]) * by_z[:, None, None] * focal[:, None]
            p = p - np.linalg.lstsq(J.reshape(-1, 3), error.ravel(), rcond=None)[0]
        if rms_px > _MAX_ERROR_RAD * self.camera.fx_px:
            return None
        return Point(p, self._colours[corner], rms_px, tuple(track))

    # --- formats ---

    def write_colmap(self, directory: Path) -> int:
        """Writes COLMAP's text model to DIRECTORY/sparse/0; returns the number of points."""
        model = directory / "sparse" / "0"
        model.mkdir(parents=True, exist_ok=True)
        points, cam = self.points(), self.camera
        point_of = {at: number for number, point in enumerate(points, start=1) for at in point.track}
        numbers = cam.fx_px, cam.fy_px, cam.cx_px + _PIXEL_CENTRE, cam.cy_px + _PIXEL_CENTRE
        _write_lines(
            model / "cameras.txt",
            [
                "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
                f"1 PINHOLE {cam.width_px} {cam.height_px} {_row(numbers)}",
            ],
        )
        lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
        for k, image in enumerate(self.images):
            _, x, y, z, *quaternion = tum_row(0, inverse(image.T_world_cam)).split()
            lines.append(" ".join([str(k + 1), quaternion[3], *quaternion[:3], x, y, z, "1", image.name]))
            lines.append(
                " ".join(
                    f"{u + _PIXEL_CENTRE:.3f} {v + _PIXEL_CENTRE:.3f} {point_of.get((k, row), -1)}"
                    for row, (u, v) in enumerate(image.px.tolist())
                )
            )
        _write_lines(model / "images.txt", lines)
        lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
        for number, point in enumerate(points, start=1):
            blue, green, red = point.colour
            track = " ".join(f"{k + 1} {row}" for k, row in point.track)
            lines.append(f"{number} {_row(point.p_world)} {red} {green} {blue} {point.error_px:.4f} {track}")
        _write_lines(model / "points3D.txt", lines)
        return len(points)

    def write_nerfstudio(self, directory: Path) -> int:
        """Writes transforms.json and sparse_pc.ply; returns the number of points."""
        points, cam = self.points(), self.camera
        frames = [
            {
                "file_path": f"images/{image.name}",
                "transform_matrix": (image.T_world_cam @ _OPENGL_AXES).tolist(),
            }
            for image in self.images
        ]
        content = {
            "camera_model": "OPENCV",
            "w": cam.width_px,
            "h": cam.height_px,
            "fl_x": cam.fx_px,
            "fl_y": cam.fy_px,
            "cx": cam.cx_px + _PIXEL_CENTRE,
            "cy": cam.cy_px + _PIXEL_CENTRE,
            **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
            "ply_file_path": "sparse_pc.ply",
            "frames": frames,
        }
        (directory / "transforms.json").write_text(json.dumps(content, indent=2) + "\n", encoding="ascii")
        head = [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(points)}",
            *(f"property float {axis}" for axis in "xyz"),
        ]
        head += [*(f"property uchar {colour}" for colour in ("red", "green", "blue")), "end_header"]
        rows = (f"{_row(point.p_world)} {_row(reversed(point.colour))}" for point in points)
        _write_lines(directory / "sparse_pc.ply", [*head, *rows])
        return len(points)


def write_image(path: Path, image: Image) -> None:
    """Writes an image file. Raises OSError."""
    if not cv2.imwrite(str(path), image):
        raise OSError(f"{path}: can't be written")


def write_tum(path: Path, times_ns: Sequence[int], poses: Sequence[Transform]) -> None:
    """Writes camera poses `T_world_cam` (4, 4) as TUM lines."""
    _write_lines(path, [tum_row(t_ns, pose) for t_ns, pose in zip(times_ns, poses, strict=True)])


def write_kitti(path: Path, times_ns: Sequence[int], poses: Sequence[Transform]) -> None:
    """Writes camera poses as KITTI rows, in the axes of the first camera; without times."""
    _write_lines(path, [kitti_row(inverse(poses[0]) @ pose) for pose in poses])


def _row(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
