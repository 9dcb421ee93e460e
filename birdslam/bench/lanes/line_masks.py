"""Painted lines in single images against lines by hand, as TuSimple has them: lateral error in pixels and F1.

A folder holds pairs image_N.jpg, lines_N.png; in a mask each line has one grey value, through gaps and vehicles.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.figures import mean, number
from birdslam.bench.lanes.image_masks import Pair, numbered_pairs
from birdslam.bench.lanes.kitti_road import Still
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.lanes.outline import line_px
from birdslam.types import LineKind

NEAR_PX, MIN_NEAR_RATIO = 20.0, 0.85  # a line is found if so many of its rows are so near (TuSimple)
ROW_STEP_PX = 10
HORIZON_M = 200.0  # the benchmark asks for all rows of a line, so lines are extended past their known range
# TuSimple does not state its camera: focal length of other dashcams, horizon from the true lines of six images, height
# from US lanes of 3.66 m
FOCAL_PX, HORIZON_PX, HEIGHT_M = 1000.0, 230.0, 1.6


class LineMaskScore(msgspec.Struct, frozen=True, kw_only=True):
    """One image: its lines, those that were found, and the mean error of these in pixels along the rows."""

    image: str
    true: int
    found: int
    right: int
    error_px: float | None


class LineMasksReport(msgspec.Struct, frozen=True, kw_only=True):
    """All images of a folder."""

    images: int
    f1: float
    error_px: float | None
    by_image: tuple[LineMaskScore, ...]


def find_pairs(folder: Path) -> list[Pair]:
    """Images with their masks. Raises DatasetError where there are none, or one has no mask."""
    return numbered_pairs(folder, "jpg", "lines")


def camera_of(image: NDArray[np.uint8]) -> Camera:
    """The assumed camera for an image of this size."""
    height_px, width_px = image.shape[:2]
    return Camera(
        width_px=width_px,
        height_px=height_px,
        fx_px=FOCAL_PX,
        fy_px=FOCAL_PX,
        cx_px=0.5 * width_px,
        cy_px=0.5 * height_px,
        height_m=HEIGHT_M,
        pitch_rad=float(np.arctan((0.5 * height_px - HORIZON_PX) / FOCAL_PX)),
    )


def score_lines(name: str, camera: Camera, still: Still, mask: NDArray[np.uint8]) -> LineMaskScore:
    """Painted lines against a mask (H, W, 3)."""
    values = mask[:, :, 0]
    rows = np.arange(0, len(values), ROW_STEP_PX)
    true = [_columns(values == value, rows) for value in np.unique(values) if value]
    found = []
    for line in still.lines:
        if line.kind is not LineKind.EDGE:
            column, row = line_px(camera, still.ground, msgspec.structs.replace(line, to_m=HORIZON_M)).T
            order = np.argsort(row)
            found.append(np.interp(rows, row[order], column[order], left=np.nan, right=np.nan))
    pairs = sorted(
        (float(np.mean(gap[np.isfinite(t)] < NEAR_PX)), k, j)
        for k, t in enumerate(true)
        for j, f in enumerate(found)
        for gap in [np.abs(np.nan_to_num(f, nan=np.inf) - t)]
    )
    taken: dict[int, int] = {}
    for share, k, j in reversed(pairs):
        if share >= MIN_NEAR_RATIO and k not in taken and j not in taken.values():
            taken[k] = j
    errors = [np.nanmean(np.abs(found[j] - true[k])) for k, j in taken.items()]
    return LineMaskScore(image=name, true=len(true), found=len(found), right=len(taken), error_px=mean(errors))


def _columns(line: NDArray[np.bool_], rows: NDArray[np.int64]) -> Floats:
    """(R,) middle of a line in each row, NaN where it is not."""
    count = line[rows].sum(axis=1)
    total = (line[rows] * np.arange(line.shape[1])).sum(axis=1)
    out: Floats = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return out


def report_of(scores: list[LineMaskScore]) -> LineMasksReport:
    """The scores of a folder's images together."""
    right, lines = sum(s.right for s in scores), sum(s.true + s.found for s in scores)
    return LineMasksReport(
        images=len(scores),
        f1=2.0 * right / lines if lines else 0.0,
        error_px=mean([s.error_px for s in scores]),
        by_image=tuple(scores),
    )


def text_of(report: LineMasksReport) -> str:
    """Lines for a terminal."""
    out = [
        f"{s.image:16} {s.right} of {s.true} lines, {s.found} found, mean error {number(s.error_px, 1)} px"
        for s in report.by_image
    ]
    out.append(f"{report.images} images: F1 at 20 px {report.f1:.2f}, mean error {number(report.error_px, 1)} px")
    return "\n".join(out)
