"""Lens from vertical edges in the world: houses, poles and signs (plumb lines; Brown 1971).

Without distortion they are straight lines through one vanishing point; distortion tilts them by their position. This
gives the distortion, and whether the lens is a fisheye, but no focal length except that of a fisheye. Only the upper
half of an image is used, since vehicles and people taper upwards.
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

UPRIGHT_IMAGES = 30  # of a drive, in which upright lines are looked for
_WIDTH_PX = 800  # of the image in which edges are looked for, at the most
_MIN_LENGTH, _MAX_LEAN = 0.03, 0.35  # of an edge: in widths, and its slope against the image's columns
_MIN_EDGES, _BLOCKS = 100, 6  # in all; of the drive, for the sigma
_LEAN = 0.02  # 1-sigma of an edge's slope, beyond which it weighs less
_LEAN_ERROR = 0.004  # of the slopes' mean trend over the image: walls and trees that lean; by judgement
_TILT_SIGMA = 0.05  # of the camera's pitch and roll beforehand
_ROUNDS = 12  # of reweighting
_BENDS = np.arange(-1.5, 0.51, 0.05)
_VIEWS_DEG = np.arange(60.0, 161.0, 2.5)
_SURE = 2.0  # sigmas by which a fisheye must fit better
_WIDEST_RAD = 1.45  # from the axis


@dataclass(frozen=True)
class LensByUprights:
    """What upright edges say of a lens, lengths in image widths.

    Of a pinhole with one radial term: radius = r (1 + bend r^2), which is k1 over the square of the focal length; with
    its 1-sigma. `fisheye_focal` is the focal length of an equidistant lens where such a one fits better and
    sees farther than pinholes do, else None: higher terms of a pinhole's distortion look like a narrower fisheye.
    """

    bend: float
    bend_sigma: float
    fisheye_focal: float | None
    edges: int


def upright_edges(image: NDArray[np.uint8]) -> Floats:
    """(N, 2, 2) upper and lower ends, from the image's middle in widths, of nearly upright edges in its upper half."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _WIDTH_PX / grey.shape[1])
    if scale < 1.0:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    height_px, width_px = grey.shape
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 2, 2)) if found is None else np.asarray(found, np.float64).reshape(-1, 2, 2)
    ends = (ends - 0.5 * (np.array([width_px, height_px]) - 1.0)) / width_px
    ends = np.take_along_axis(ends, np.argsort(ends[..., 1], axis=1)[..., None], axis=1)
    across, down = (ends[:, 1] - ends[:, 0]).T
    upright = (np.hypot(across, down) > _MIN_LENGTH) & (np.abs(across) < _MAX_LEAN * down)
    out: Floats = ends[upright & (ends[..., 1].sum(axis=1) < 0.0)]
    return out


def lens_by_uprights(images: Sequence[Floats]) -> LensByUprights | None:
    """The lens by the edges (N, 2, 2) of each of a drive's images, in their order; None where there are too few."""
    edges = np.concatenate([np.zeros((0, 2, 2)), *images])
    if len(edges) < _MIN_EDGES:
        return None
    block = np.repeat(np.arange(len(images)) * _BLOCKS // len(images), [len(image) for image in images])
    by_bend = np.array([_costs(edges, block, _pinhole(bend)) for bend in _BENDS])
    focal = 0.5 / (0.5 * np.radians(_VIEWS_DEG))
    by_view = np.array([_costs(edges, block, _fisheye(f)) for f in focal])
    bend = _lowest(_BENDS, by_bend.sum(axis=1))
    without = np.array([_lowest(_BENDS, np.delete(by_bend, k, axis=1).sum(axis=1)) for k in range(_BLOCKS)])
    spread = math.sqrt((_BLOCKS - 1) / _BLOCKS * float(np.square(without - without.mean()).sum()))
    at = int(by_view.sum(axis=1).argmin())
    gain = by_bend[int(by_bend.sum(axis=1).argmin())] - by_view[at]  # (_BLOCKS,)
    sure = float(gain.sum()) > _SURE * math.sqrt(_BLOCKS) * float(gain.std(ddof=1))
    view = _lowest(_VIEWS_DEG, by_view.sum(axis=1))
    return LensByUprights(
        bend=bend,
        bend_sigma=math.hypot(spread, _LEAN_ERROR / _leverage(edges)),
        fisheye_focal=0.5 / (0.5 * math.radians(view)) if sure and view >= WIDE_DEG else None,
        edges=len(edges),
    )


def _pinhole(bend: float) -> Callable[[Floats], Floats]:
    """From radii in the image to those without distortion."""

    def straight(radius: Floats) -> Floats:
        found = radius
        for _ in range(20):
            found = radius / np.maximum(1.0 + bend * np.square(found), 0.3)
        return found

    return straight


def _fisheye(focal: float) -> Callable[[Floats], Floats]:
    return lambda radius: focal * np.tan(np.minimum(radius / focal, _WIDEST_RAD))


def _costs(edges: Floats, block: NDArray[np.int64], straight: Callable[[Floats], Floats]) -> Floats:
    """(_BLOCKS,) how badly the edges stand upright without the distortion, by the camera's tilt that suits them best.

    Of a camera that is tilted a little an upright edge leans by its roll, and by its pitch times where it lies across.
    """
    radius = np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-9)
    ends = edges * (straight(radius) / radius)
    across, down = (ends[:, 1] - ends[:, 0]).T
    lean = across / np.maximum(down, 1e-9)
    A = np.column_stack([np.ones(len(ends)), ends[..., 0].mean(axis=1)])
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    weight = length
    for _ in range(_ROUNDS):
        information = (A * weight[:, None]).T @ A / _LEAN**2 + np.eye(2) / _TILT_SIGMA**2
        tilt = np.linalg.solve(information, (A * weight[:, None]).T @ lean / _LEAN**2)
        excess = np.square((lean - A @ tilt) / _LEAN)
        weight = length / np.square(1.0 + excess)  # Geman and McClure's
    return np.asarray(np.bincount(block, length * excess / (1.0 + excess), _BLOCKS), np.float64)


def _lowest(values: Floats, costs: Floats) -> float:
    """Where a parabola through the lowest of the costs and its neighbours is lowest."""
    at = int(np.clip(costs.argmin(), 1, len(costs) - 2))
    before, here, after = costs[at - 1 : at + 2]
    bent = before - 2.0 * here + after
    off = 0.5 * (before - after) / bent if bent > 0.0 else 0.0
    return float(values[at] + np.clip(off, -1.0, 1.0) * (values[1] - values[0]))


def _leverage(edges: Floats) -> float:
    """1-sigma, over the edges, of the lean by a bend of 1 that no tilt explains."""
    x, y = edges.mean(axis=1).T
    A = np.column_stack([np.ones(len(x)), x])
    lean = 2.0 * x * y
    return max(float(np.std(lean - A @ np.linalg.lstsq(A, lean, rcond=None)[0])), 1e-6)
