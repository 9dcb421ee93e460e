"""The car's bonnet along the lower edge of the image: below its edge there is no road.

It mirrors sky and houses, so that its inside changes from image to image, but its edge does not: the mean gradient of
images between which the car has driven keeps a fixed edge and averages the road out. A bonnet (or a dashboard, or a
black border) begins where such an edge, nearer to level than to vertical, crosses most columns along one curve.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Grey = NDArray[np.float32]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]

_DOWNSCALE = 2  # the edge is detected in images of half the size
_FIT_ITERATIONS = 4  # of the fit, each with the edges near the last curve
_MIN_COLUMNS = 8  # for a fit
_MAX_OFFSET = 0.1  # from the median row, of the image's height: an edge farther off is another one
_MAX_ACROSS = 0.4  # gradient of the slope across over the slope downwards: lane lines have more
_MARGIN_PX = 6  # above the edge, for the smoothing of the road's image


class BonnetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When an edge is a bonnet's. By judgement, tried on the built-in world's bonnets; KITTI's cameras see none."""

    step_m: Positive = 0.5  # driven from one image of the mean to the next
    images: Annotated[int, msgspec.Meta(ge=3)] = 6  # of the mean; the edge is detected from half of them on
    edge_grey: Positive = 4.0  # per pixel, of a fixed edge in the mean
    changes: Share = 0.4  # of the edge's strength, its mean deviation from image to image
    on_threshold: Share = 0.5  # of the columns with such an edge, for a bonnet to be there
    off_threshold: Share = 0.1  # ... below which it is gone
    smooth_px: Positive = 8.0  # distance of an edge from its curve


class Bonnet:
    """State: mean and mean deviation of the vertical gradients. Reader: `RoadScale`, for the pixels it aligns."""

    def __init__(self, config: BonnetConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._deviation: Grey | None = None
        self._images = 0
        self._driven_m = np.inf
        self.rows: Ints | None = None  # (W,) the first row that shows bonnet; None: there is none

    def update(self, grey: NDArray[np.uint8], top_px: int, driven_m: float) -> bool:
        """Takes (H, W) grey, `driven_m` after the image before, rows from `top_px` on; whether it has come or gone."""
        cfg = self.config
        self._driven_m += driven_m
        if self._driven_m < cfg.step_m:
            return False
        self._driven_m = 0.0
        small = cv2.resize(grey[top_px:], None, fx=1 / _DOWNSCALE, fy=1 / _DOWNSCALE, interpolation=cv2.INTER_AREA)
        slope = np.asarray(cv2.Sobel(small, cv2.CV_32F, 0, 1, ksize=3, scale=0.125), np.float32)
        self._images += 1
        share = max(1.0 / self._images, 1.0 / cfg.images)
        if self._mean is None or self._deviation is None:
            self._mean, self._deviation = slope.copy(), np.zeros_like(slope)
            return False
        cv2.accumulateWeighted(np.abs(slope - self._mean), self._deviation, share)
        cv2.accumulateWeighted(slope, self._mean, share)
        if 2 * self._images < cfg.images:
            return False
        before, self.rows = self.rows, self._edge(top_px, *grey.shape)
        return (before is None) != (self.rows is None)

    @property
    def initialised(self) -> bool:
        """Whether an image was ever taken."""
        return self._images > 0

    @property
    def present(self) -> bool:
        """Whether there is one."""
        return self.rows is not None

    def above(self, px: Ints) -> Ints:
        """The pixels, of (N, 2), that lie above it."""
        return px if self.rows is None else px[px[:, 1] < self.rows[px[:, 0]]]

    def _edge(self, top_px: int, height: int, width: int) -> Ints | None:
        """(W,) rows of the curve that most columns agree on, less a margin; None: no bonnet."""
        cfg = self.config
        found, row = max((self._level_edge(sign) for sign in (1.0, -1.0)), key=lambda edge: int(edge[0].sum()))
        columns = np.arange(len(row))
        x = columns / len(columns) - 0.5
        powers = np.stack([x * x, x, np.ones(len(x))])
        near = found.copy()
        if found.any():
            near &= np.abs(row - np.median(row[found])) * _DOWNSCALE < _MAX_OFFSET * height
        for _ in range(_FIT_ITERATIONS):
            if near.sum() < _MIN_COLUMNS:
                return None
            curve = _parabola(x[near], row[near]) @ powers
            near = found & (np.abs(row - curve) * _DOWNSCALE < cfg.smooth_px)
        share = float(near.mean())
        if np.ptp(curve) * _DOWNSCALE > 1.5 * _MAX_OFFSET * height or share < (
            cfg.off_threshold if self.present else cfg.on_threshold
        ):
            return None
        fine = np.interp(np.arange(width), _DOWNSCALE * (columns + 0.5), curve)
        return np.clip(top_px + _DOWNSCALE * fine - _MARGIN_PX, 0, height).astype(np.int64)

    def _level_edge(self, sign: float) -> tuple[Bools, Ints]:
        """Of each column, whether there is a fixed edge, brighter below times `sign`, and its lowest row."""
        cfg, mean, deviation = self.config, self._mean, self._deviation
        assert mean is not None
        assert deviation is not None
        across = np.abs(cv2.Scharr(mean, cv2.CV_32F, 1, 0, scale=1.0 / 32.0))
        strength = sign * mean
        fixed = (strength > cfg.edge_grey) & (deviation < cfg.changes * strength) & (across < _MAX_ACROSS * strength)
        row = len(fixed) - 1 - fixed[::-1].argmax(axis=0)
        return fixed[row, np.arange(len(row))], row


def _parabola(x: NDArray[np.float64], y: Ints) -> NDArray[np.float64]:
    """(3,) coefficients, highest power first, by least squares, |x| <= 0.5; numpy.polyfit takes far longer."""
    A = np.stack([x * x, x, np.ones(len(x))])
    out: NDArray[np.float64] = np.linalg.solve(A @ A.T, A @ y)
    return out
