"""The car's own bonnet along the lower edge of the image: what is below its edge is no road.

It mirrors the sky and the houses, so that its inside changes from image to image; its edge does not. The mean of some
images between which the car has driven keeps an edge that stands and loses the road's. Where such an edge, more level
than steep, crosses most of the image's columns in one curve, a bonnet begins there, or a dashboard, or a black border.
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

_SHRUNK = 2  # the edge is looked for in images of half the size
_ROUNDS = 4  # of the fit, each with the edges that are near the curve of the one before
_LEAST_COLUMNS = 8  # for a fit
_DEEPEST = 0.1  # of the image's height: an edge farther from the median row is another one
_LEVEL = 0.4  # the slope's change across over the slope downwards: of lines of the lane it is more
_MARGIN_PX = 6  # above the edge, for the smoothing of what is compared


class BonnetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When an edge counts as one. By judgement, tried on the built-in world's bonnets; KITTI's cameras see none."""

    step_m: Positive = 0.5  # driven from one image that is learned to the next
    images: Annotated[int, msgspec.Meta(ge=3)] = 6  # of the mean; the edge is told from half of them on
    edge_grey: Positive = 4.0  # per pixel; an edge that stands has at least this in the mean
    changes: Share = 0.4  # of an edge's strength, by which it may differ from image to image
    begins_at: Share = 0.5  # of the columns that have such an edge
    ends_at: Share = 0.1  # of the columns, below which there is none any more
    smooth_px: Positive = 8.0  # by which the edge may be off its curve


class Bonnet:
    """State: the mean of the vertical slopes and of their change. Reader: `RoadScale`, for what it compares."""

    def __init__(self, config: BonnetConfig) -> None:
        self.config = config
        self._mean: Grey | None = None
        self._change: Grey | None = None
        self._images = 0
        self._since_m = np.inf
        self.rows: Ints | None = None  # (W,) the first row that shows bonnet; None: there is none

    def learn(self, grey: NDArray[np.uint8], top_px: int, driven_m: float) -> bool:
        """(H, W) grey, `driven_m` after the image before; of the rows from `top_px` on. Whether it has come or gone."""
        cfg = self.config
        self._since_m += driven_m
        if self._since_m < cfg.step_m:
            return False
        self._since_m = 0.0
        small = cv2.resize(grey[top_px:], None, fx=1 / _SHRUNK, fy=1 / _SHRUNK, interpolation=cv2.INTER_AREA)
        slope = np.asarray(cv2.Sobel(small, cv2.CV_32F, 0, 1, ksize=3, scale=0.125), np.float32)
        self._images += 1
        share = max(1.0 / self._images, 1.0 / cfg.images)
        if self._mean is None or self._change is None:
            self._mean, self._change = slope.copy(), np.zeros_like(slope)
            return False
        cv2.accumulateWeighted(np.abs(slope - self._mean), self._change, share)
        cv2.accumulateWeighted(slope, self._mean, share)
        if 2 * self._images < cfg.images:
            return False
        before, self.rows = self.rows, self._edge(top_px, *grey.shape)
        return (before is None) != (self.rows is None)

    @property
    def begun(self) -> bool:
        """Whether an image was ever learned."""
        return self._images > 0

    @property
    def present(self) -> bool:
        """Whether there is one."""
        return self.rows is not None

    def above(self, px: Ints) -> Ints:
        """Those of the pixels (N, 2) that lie above it."""
        return px if self.rows is None else px[px[:, 1] < self.rows[px[:, 0]]]

    def _edge(self, top_px: int, height: int, width: int) -> Ints | None:
        """(W,) the curve that most columns agree on, less a margin."""
        cfg = self.config
        found, row = max((self._level_edge(sign) for sign in (1.0, -1.0)), key=lambda edge: int(edge[0].sum()))
        columns = np.arange(len(row))
        x = columns / len(columns) - 0.5
        powers = np.stack([x * x, x, np.ones(len(x))])
        near = found.copy()
        if found.any():
            near &= np.abs(row - np.median(row[found])) * _SHRUNK < _DEEPEST * height
        for _ in range(_ROUNDS):
            if near.sum() < _LEAST_COLUMNS:
                return None
            curve = _parabola(x[near], row[near]) @ powers
            near = found & (np.abs(row - curve) * _SHRUNK < cfg.smooth_px)
        share = float(near.mean())
        if np.ptp(curve) * _SHRUNK > 1.5 * _DEEPEST * height or share < (
            cfg.ends_at if self.present else cfg.begins_at
        ):
            return None
        fine = np.interp(np.arange(width), _SHRUNK * (columns + 0.5), curve)
        return np.clip(top_px + _SHRUNK * fine - _MARGIN_PX, 0, height).astype(np.int64)

    def _level_edge(self, sign: float) -> tuple[Bools, Ints]:
        """Of each column, whether an edge stands there that brightens downwards times `sign`, and its lowest row."""
        cfg, mean, change = self.config, self._mean, self._change
        assert mean is not None
        assert change is not None
        across = np.abs(cv2.Scharr(mean, cv2.CV_32F, 1, 0, scale=1.0 / 32.0))
        strength = sign * mean
        stands = (strength > cfg.edge_grey) & (change < cfg.changes * strength) & (across < _LEVEL * strength)
        row = len(stands) - 1 - stands[::-1].argmax(axis=0)
        return stands[row, np.arange(len(row))], row


def _parabola(x: NDArray[np.float64], y: Ints) -> NDArray[np.float64]:
    """(3,) highest power first, of least squares through points (N,), |x| <= 0.5; numpy.polyfit takes far longer."""
    A = np.stack([x * x, x, np.ones(len(x))])
    out: NDArray[np.float64] = np.linalg.solve(A @ A.T, A @ y)
    return out
