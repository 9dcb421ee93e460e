"""Lens distortion from vertical edges in the world: houses, poles and signs (plumb lines; Brown 1971).

Without distortion they are straight lines through one vanishing point; distortion tilts them by position. This shows
the distortion and whether the lens is a fisheye, but the focal length of a fisheye only. The upper half of the image
is used, since vehicles and people taper upwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.lens import WIDE_DEG

Floats = NDArray[np.float64]

MAX_IMAGES = 30  # number of a drive's images used for vertical edges
_MAX_WIDTH_PX = 800  # max. image width for the edge detection
_MIN_LENGTH, _MAX_SLOPE = 0.03, 0.35  # of an edge: in image widths, and its slope against the columns
_MIN_EDGES, _BLOCKS = 100, 6  # total number; parts of the drive for the sigma
_SLOPE_SCALE = 0.02  # scale of the robust weight of an edge's slope
_SIGMA_TREND = 0.004  # 1-sigma of the mean trend of slopes over the image: inclined walls and trees
_TILT_SIGMA = 0.05  # prior of the camera's pitch and roll
_ITERATIONS = 12  # of reweighting
_BENDS = np.arange(-1.5, 0.51, 0.05)
_VIEWS_DEG = np.arange(60.0, 161.0, 2.5)
_MIN_GAIN_SIGMAS = 2.0  # min. sigmas by which a fisheye fits better
_MAX_ANGLE_RAD = 1.45  # max. angle from the axis


@dataclass(frozen=True)
class LensByVerticalEdges:
    """Lens estimate from vertical edges, lengths in image widths.

    Pinhole with one radial term: radius = r (1 + bend r^2), that is k1 over the square of the focal length; with its
    1-sigma. `fisheye_focal` is the focal length of an equidistant lens if it fits better and is wider than pinholes
    are, else None: higher terms of a pinhole's distortion look like a narrow fisheye.
    """

    bend: float
    bend_sigma: float
    fisheye_focal: float | None
    edges: int


def find_vertical_edges(image: NDArray[np.uint8]) -> Floats:
    """(N, 2, 2) upper and lower ends, from the image centre in widths, of near-vertical edges in the upper half."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _MAX_WIDTH_PX / grey.shape[1])
    if scale < 1.0:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    height_px, width_px = grey.shape
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 2, 2)) if found is None else np.asarray(found, np.float64).reshape(-1, 2, 2)
    ends = (ends - 0.5 * (np.array([width_px, height_px]) - 1.0)) / width_px
    ends = np.take_along_axis(ends, np.argsort(ends[..., 1], axis=1)[..., None], axis=1)
    across, down = (ends[:, 1] - ends[:, 0]).T
    is_vertical = (np.hypot(across, down) > _MIN_LENGTH) & (np.abs(across) < _MAX_SLOPE * down)
    out: Floats = ends[is_vertical & (ends[..., 1].sum(axis=1) < 0.0)]
    return out


def lens_by_vertical_edges(images: Sequence[Floats]) -> LensByVerticalEdges | None:
    """The lens from the edges (N, 2, 2) of each image of a drive, in order; None with too few edges."""
    edges = np.concatenate([np.zeros((0, 2, 2)), *images])
    if len(edges) < _MIN_EDGES:
        return None
    block = np.repeat(np.arange(len(images)) * _BLOCKS // len(images), [len(image) for image in images])
    by_bend = np.array([_costs(edges, block, _pinhole(bend)) for bend in _BENDS])
    focal = 0.5 / (0.5 * np.radians(_VIEWS_DEG))
    by_view = np.array([_costs(edges, block, _fisheye(f)) for f in focal])
    bend = _parabola_minimum(_BENDS, by_bend.sum(axis=1))
    without = np.array([_parabola_minimum(_BENDS, np.delete(by_bend, k, axis=1).sum(axis=1)) for k in range(_BLOCKS)])
    spread = math.sqrt((_BLOCKS - 1) / _BLOCKS * float(np.square(without - without.mean()).sum()))
    at = int(by_view.sum(axis=1).argmin())
    gain = by_bend[int(by_bend.sum(axis=1).argmin())] - by_view[at]  # (_BLOCKS,)
    sure = float(gain.sum()) > _MIN_GAIN_SIGMAS * math.sqrt(_BLOCKS) * float(gain.std(ddof=1))
    view = _parabola_minimum(_VIEWS_DEG, by_view.sum(axis=1))
    return LensByVerticalEdges(
        bend=bend,
        bend_sigma=math.hypot(spread, _SIGMA_TREND / _slope_per_bend(edges)),
        fisheye_focal=0.5 / (0.5 * math.radians(view)) if sure and view >= WIDE_DEG else None,
        edges=len(edges),
    )


def _pinhole(bend: float) -> Callable[[Floats], Floats]:
    """Returns the function from image radii to undistorted radii."""

    def straight(radius: Floats) -> Floats:
        found = radius
        for _ in range(20):
            found = radius / np.maximum(1.0 + bend * np.square(found), 0.3)
        return found

    return straight


def _fisheye(focal: float) -> Callable[[Floats], Floats]:
    return lambda radius: focal * np.tan(np.minimum(radius / focal, _MAX_ANGLE_RAD))


def _costs(edges: Floats, block: NDArray[np.int64], straight: Callable[[Floats], Floats]) -> Floats:
    """(_BLOCKS,) cost of the slopes of the undistorted edges at the best tilt of the camera.

    To first order roll tilts all vertical edges, and pitch tilts them in proportion to their column.
    """
    radius = np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-9)
    ends = edges * (straight(radius) / radius)
    across, down = (ends[:, 1] - ends[:, 0]).T
    slope = across / np.maximum(down, 1e-9)
    A = np.column_stack([np.ones(len(ends)), ends[..., 0].mean(axis=1)])
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    weight = length
    for _ in range(_ITERATIONS):
        information = (A * weight[:, None]).T @ A / _SLOPE_SCALE**2 + np.eye(2) / _TILT_SIGMA**2
        tilt = np.linalg.solve(information, (A * weight[:, None]).T @ slope / _SLOPE_SCALE**2)
        excess = np.square((slope - A @ tilt) / _SLOPE_SCALE)
        weight = length / np.square(1.0 + excess)  # Geman-McClure
    return np.asarray(np.bincount(block, length * excess / (1.0 + excess), _BLOCKS), np.float64)


def _parabola_minimum(values: Floats, costs: Floats) -> float:
    """Minimum of the parabola through the lowest cost and its neighbours."""
    at = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    before, here, after = costs[at - 1 : at + 2]
    bent = before - 2.0 * here + after
    off = 0.5 * (before - after) / bent if bent > 0.0 else 0.0
    return float(values[at] + np.clip(off, -1.0, 1.0) * (values[1] - values[0]))


def _slope_per_bend(edges: Floats) -> float:
    """1-sigma over the edges of the slope per unit of bend that no tilt explains."""
    x, y = edges.mean(axis=1).T
    A = np.column_stack([np.ones(len(x)), x])
    slope = 2.0 * x * y
    return max(float(np.std(slope - A @ np.linalg.lstsq(A, slope, rcond=None)[0])), 1e-6)
