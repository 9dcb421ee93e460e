"""Standstill detection from the image of the near road.

Unmoved corners are no proof, since drops on the windscreen do not move either. While the car moves, the image of the
near road changes with time, even behind drops; at a standstill it changes only by noise, independent of time. So the
change over a second is compared with that over a tenth of it, and with the contrast of the image.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera
from birdslam.odometry.median import quantile
from birdslam.types import NS_PER_S

Floats = NDArray[np.float64]
Grey = NDArray[np.float32]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_NEAR_M = 20.0  # maximum distance of the near road
_CELLS_PER_RAD = 180.0  # 0.3 degrees per cell, to average the noise of pixels
_CONTRAST_RAD = 0.05  # window of the contrast
_MIN_CELLS = 200  # of the near road outside vehicles: 4 by 4 degrees
_QUANTILE = 0.75  # of the changes: drops and the bonnet may hide most of the road
_NORMAL_QUANTILE = 1.15  # _QUANTILE of the absolute values of a normal distribution, in sigmas
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)  # suppresses gradients and edges
_ROUNDING_GREY = 0.29  # 1-sigma of the rounding of grey levels
_TIME_TOLERANCE = 0.9  # minimum ratio of a time lag to its nominal value


class StillnessConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the detection of an unchanged near road."""

    long_s: Positive = 1.0  # the long lag, over which the image must not change
    short_s: Positive = 0.1  # the short lag, over which it changes by noise
    growth: Positive = 2.5  # change over the long lag to that over the short one, above which the car moves
    contrast_share: Positive = 0.15  # change over contrast, above which there is no proof of a standstill


@dataclass(frozen=True)
class _Sample:
    t_ns: int
    cells: Grey  # (rows, columns) mean brightness
    shown: Bools  # (rows, columns) visible road outside vehicles


class NearRoadStillness:
    """State: images of the near road over the long lag. Reader: `Odometry`, before a zero-velocity update."""

    def __init__(self, camera: Camera, config: StillnessConfig) -> None:
        self.config = config
        self._cell_px = max(1.0, camera.fx_px / _CELLS_PER_RAD)
        rows = np.arange(camera.height_px, dtype=np.float64)
        rays = rays_cam(camera, np.column_stack([np.full(len(rows), camera.cx_px), rows]))
        near = np.flatnonzero(rays @ camera.ground.normal_cam < -camera.height_m / _NEAR_M)
        self._top_px = int(near[0]) if len(near) else camera.height_px
        height_px = camera.height_px - self._top_px
        self._size = (round(camera.width_px / self._cell_px), round(height_px / self._cell_px))
        self._samples: deque[_Sample] = deque()
        self._newest: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)  # its part with the near road

    def reset(self) -> None:
        """Drops the past images, for example after a change of the exposure."""
        self._samples.clear()

    def update(self, grey: NDArray[np.uint8], t_ns: int, boxes_px: Floats) -> None:
        """Adds an image (H, W); `boxes_px` (N, 4) are vehicles."""
        samples, cfg = self._samples, self.config
        if samples and t_ns <= samples[-1].t_ns:
            samples.clear()
        if min(self._size) < 2:
            return
        self._newest = grey[self._top_px :]
        area = cv2.resize(self._newest.astype(np.float32), self._size, interpolation=cv2.INTER_AREA)
        cells = np.asarray(area, np.float32)
        shown = np.ones(cells.shape, bool)
        for x1, y1, x2, y2 in (boxes_px - np.tile([0.0, self._top_px], 2)) / self._cell_px:
            shown[max(int(y1) - 1, 0) : max(int(y2) + 2, 0), max(int(x1) - 1, 0) : max(int(x2) + 2, 0)] = False
        newest_replaced = len(samples) > 1 and t_ns - samples[-2].t_ns < _TIME_TOLERANCE * cfg.short_s * NS_PER_S
        if newest_replaced:  # keep samples at the short lag, and the newest image
            samples.pop()
        samples.append(_Sample(t_ns, cells, shown))
        while len(samples) > 2 and t_ns - samples[1].t_ns >= _TIME_TOLERANCE * cfg.long_s * NS_PER_S:
            samples.popleft()

    @property
    def changes(self) -> tuple[float, float, float] | None:
        """Change over the long lag and over the short one, and contrast, in grey levels.

        None if the lag is too short or too little road is visible.
        """
        samples, cfg = self._samples, self.config
        if len(samples) < 3 or samples[-1].t_ns - samples[0].t_ns < _TIME_TOLERANCE * cfg.long_s * NS_PER_S:
            return None
        long = _change(samples[0], samples[-1])
        kept = list(samples)
        if kept[-1].t_ns - kept[-2].t_ns < _TIME_TOLERANCE * cfg.short_s * NS_PER_S:
            kept.pop()
        short = [c for c in map(_change, kept, kept[1:]) if c is not None]
        if long is None or not short:
            return None
        newest = samples[-1]
        side = 2 * round(0.5 * _CONTRAST_RAD * _CELLS_PER_RAD) + 1
        contrast = np.abs(newest.cells - cv2.blur(newest.cells, (side, side)))[newest.shown]
        return long, quantile(np.array(short), 0.5), quantile(contrast.astype(np.float64), _QUANTILE)

    @property
    def is_contradicted(self) -> bool:
        """Whether the near road changed by more than noise, slowly or between two images."""
        changes, cfg = self.changes, self.config
        if changes is None:
            return False
        long, short, contrast = changes
        is_image_changed = long > cfg.contrast_share * contrast and long > cfg.growth * self._noise_of_cells()
        return bool(is_image_changed or long >= cfg.growth * max(short, _ROUNDING_GREY))

    def _noise_of_cells(self) -> float:
        """Change of the cells' brightness due to image noise (Immerkaer 1996), in grey levels.

        It is overestimated, since the grain of the road counts as noise.
        """
        by_pixel = np.abs(cv2.filter2D(self._newest, cv2.CV_32F, _NOISE_KERNEL)).ravel().astype(np.float64)
        sigma_grey = 1.4826 / 6.0 * quantile(by_pixel, 0.5)
        return _NORMAL_QUANTILE * math.hypot(sigma_grey, _ROUNDING_GREY) * math.sqrt(2.0) / self._cell_px

    @property
    def is_proven(self) -> bool:
        """Whether the near road shows a standstill over the long lag."""
        changes, cfg = self.changes, self.config
        if changes is None:
            return False
        long, short, contrast = changes
        max_change = cfg.contrast_share * contrast
        # Subtract the noise, at max_change `max_change`: on a grainy road, all is noise
        noise = min(short, self._noise_of_cells(), max_change)
        return long < cfg.growth * max(short, _ROUNDING_GREY) and long**2 - noise**2 < max_change**2


def _change(then: _Sample, now: _Sample) -> float | None:
    """Change of the image in grey levels, without a change of the overall brightness; None if too little is visible."""
    shown = then.shown & now.shown
    if shown.sum() < _MIN_CELLS:
        return None
    by_cell = (now.cells - then.cells)[shown].astype(np.float64)
    return quantile(np.abs(by_cell - quantile(by_cell, 0.5)), _QUANTILE)
