"""Camera intrinsics without the mounting, and their calibration from images of a chessboard.

All errors are DatasetError with the file and the reason. `camera.Camera` checks the values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.sources.kitti import read_image
from birdslam.sources.recording import DatasetError

Floats = NDArray[np.float64]

MIN_BOARDS = 6
MAX_REPROJECTION_PX = 1.0  # max. RMS error: above it the lens model does not fit
MAX_SIGMA_FOCAL_REL = 0.02
MIN_TILT_DEG = 10.0  # min. angle between two boards: equal tilts do not determine the focal length


class Intrinsics(msgspec.Struct, frozen=True, kw_only=True):
    """A camera without its mounting; `width_px` is None if the file does not state it."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False  # `distortion` is of the equidistant model (`Camera`)
    width_px: int | None = None
    height_px: int | None = None
    source: str = ""
    reprojection_px: float | None = None  # RMS of a chessboard's corners
    sigma_focal_px: float | None = None
    distortion_sigma: float = 0.0  # 1-sigma of k1; 0: it was measured
    left_out: tuple[str, ...] = ()  # unused images with the reason

    def for_size(self, width_px: int, height_px: int) -> Intrinsics:
        """Scales to another image size of the same aspect ratio; unchanged for another one.

        Pixel centres have whole coordinates, so the image's edge is at -0.5.
        """
        if self.width_px is None or self.height_px is None:
            return self
        scale = width_px / self.width_px
        if width_px == self.width_px or abs(self.height_px * scale - height_px) >= 1.0:
            return self
        return msgspec.structs.replace(
            self,
            fx_px=self.fx_px * scale,
            fy_px=self.fy_px * scale,
            cx_px=(self.cx_px + 0.5) * scale - 0.5,
            cy_px=(self.cy_px + 0.5) * scale - 0.5,
            width_px=width_px,
            height_px=height_px,
            source=f"{self.source}, scaled from {self.width_px}x{self.height_px}",
        )


def from_chessboard(folder: Path, columns: int, rows: int, square_m: float) -> Intrinsics:
    """`cv2.calibrateCamera` from all images of a folder with a board of `columns` x `rows` inner corners."""
    if columns < 3 or rows < 3 or not 0.0 < square_m < 10.0:
        raise DatasetError(f"chessboard of {columns}x{rows} inner corners, {square_m} m per square: invalid")
    if not folder.is_dir():
        raise DatasetError(f"{folder}: {'not a directory' if folder.exists() else 'no such directory'}")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        raise DatasetError(f"{folder}: no images (.png or .jpg)")
    corners, size, left_out = _find_corners(folder, paths, columns, rows)
    board = np.zeros((columns * rows, 3), np.float32)
    board[:, :2] = np.mgrid[0:columns, 0:rows].T.reshape(-1, 2) * square_m
    rms, K, distortion, turns, _, sigma, _, _ = cv2.calibrateCameraExtended(
        [board] * len(corners), corners, size, np.eye(3), np.zeros(5)
    )
    sigma_focal_px = float(np.max(sigma[:2]))
    if not np.isfinite(rms) or rms > MAX_REPROJECTION_PX:
        raise DatasetError(
            f"{folder}: the corners have an RMS error of {rms:.2f} px, more than "
            f"{MAX_REPROJECTION_PX} px: blurred images, a bent board, or a board without {columns}x{rows} inner "
            f"corners{_format_left_out(left_out)}"
        )
    _check_tilts(folder, turns, float(K[0, 0]), sigma_focal_px, left_out)
    return Intrinsics(
        fx_px=float(K[0, 0]),
        fy_px=float(K[1, 1]),
        cx_px=float(K[0, 2]),
        cy_px=float(K[1, 2]),
        distortion=tuple(np.ravel(distortion).tolist()),
        width_px=size[0],
        height_px=size[1],
        source=f"{len(corners)} chessboards in {folder}",
        reprojection_px=float(rms),
        sigma_focal_px=sigma_focal_px,
        left_out=tuple(left_out),
    )


def _find_corners(
    folder: Path, paths: list[Path], columns: int, rows: int
) -> tuple[list[NDArray[np.float32]], tuple[int, int], list[str]]:
    """Inner corners (columns * rows, 1, 2) in px of each image with the board, and the most common image size in px.

    Images of another size, unreadable ones and those without the board are left out; returns names and reasons.
    """
    images, left_out = _grey_images(paths)
    sizes = Counter(image.shape for image in images.values())
    if not sizes:
        raise DatasetError(f"{folder}: no readable image ({'; '.join(left_out)})")
    height_px, width_px = sizes.most_common(1)[0][0]
    corners: list[NDArray[np.float32]] = []
    for name, grey in images.items():
        if grey.shape != (height_px, width_px):
            left_out.append(f"{name}: is {grey.shape[1]}x{grey.shape[0]}, but most are {width_px}x{height_px}")
            continue
        found, at = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
        if found:
            corners.append(np.asarray(at, np.float32).reshape(-1, 1, 2))
        else:
            left_out.append(f"{name}: has no board of {columns}x{rows} inner corners")
    if len(corners) < MIN_BOARDS:
        raise DatasetError(
            f"{folder}: the board of {columns}x{rows} inner corners was found in {len(corners)} of {len(paths)} "
            f"images, {MIN_BOARDS} needed{_format_left_out(left_out)}"
        )
    return corners, (width_px, height_px), left_out


def _grey_images(paths: list[Path]) -> tuple[dict[str, NDArray[np.uint8]], list[str]]:
    """Images by name, and the unreadable ones with the reason."""
    images: dict[str, NDArray[np.uint8]] = {}
    unread = []
    for path in paths:
        try:
            image = read_image(path)
        except ValueError as error:
            unread.append(f"{path.name}: {error}")
            continue
        images[path.name] = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return images, unread


def _format_left_out(left_out: Sequence[str]) -> str:
    return f"; left out: {'; '.join(left_out)}" if left_out else ""


def _check_tilts(
    folder: Path, turns: Sequence[Any], focal_px: float, sigma_focal_px: float, left_out: Sequence[str]
) -> None:
    """Raises DatasetError if the boards' rotation vectors are too similar to determine the focal length."""
    normals = np.array([cv2.Rodrigues(np.asarray(turn))[0][:, 2] for turn in turns])
    tilt_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    if tilt_deg < MIN_TILT_DEG or sigma_focal_px > MAX_SIGMA_FOCAL_REL * focal_px:
        raise DatasetError(
            f"{folder}: the boards differ by {tilt_deg:.0f} degrees of tilt; the focal length {focal_px:.0f} px has a "
            f"1-sigma of {sigma_focal_px:.1f} px; tilt the board more "
            f"({MIN_TILT_DEG:g} degrees){_format_left_out(left_out)}"
        )
