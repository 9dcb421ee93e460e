"""The scene of the fault suite's software camera: an endless street between house fronts, at constant speed.

Each pixel is the mean of the surface that it covers, so that the far road does not flicker. The mean of a rectangle of
texture is four look-ups in its integral image.
"""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Ints

WIDTH_PX, HEIGHT_PX, F_PX, HEIGHT_M = 480, 160, 260.0, 1.65
LOOP_FRAMES, TEXELS, TEXELS_PER_M = 128, 2048, 24.0
FRAME_M = TEXELS / LOOP_FRAMES / TEXELS_PER_M  # driven from one frame to the next
FRONT_AT_M, FRONT_HIGH_M = 7.0, 6.0  # house fronts: lateral distance and height
SKY = 200
GRAIN_TEXELS = (1, 3, 9, 27)  # sizes of the grain of asphalt and plaster
MEAN, CONTRAST = 128.0, 40.0


class Texture:
    """A tileable square of TEXELS with the mean over any rectangle."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        total = np.zeros((TEXELS, TEXELS))
        for size in GRAIN_TEXELS:
            noise = random.standard_normal((TEXELS, TEXELS), dtype=np.float32)
            around = 4 * size
            grain = cv2.GaussianBlur(np.pad(noise, around, mode="wrap"), (0, 0), size)[around:-around, around:-around]
            total += grain / grain.std()
        texture = np.clip(MEAN + CONTRAST * total / total.std(), 0.0, 255.0)
        self._mean = texture.mean()
        self._sums = np.zeros((TEXELS + 1, TEXELS + 1))  # [i, j]: over the first i rows and j columns, minus the mean
        self._sums[1:, 1:] = (texture - self._mean).cumsum(0).cumsum(1)

    def mean(self, y0: Floats, y1: Floats, x0: Floats, x1: Floats) -> Floats:
        """Mean (K, P) over each rectangle from y0 (K,) to y1 and from x0 (P,) to x1, in texels of the tiled texture."""
        places = [_place(x) for x in (x0, x1)]
        first, last = min(j.min() for _, j, _ in places), max(j.max() for _, j, _ in places) + 2
        band = self._rows(y1, first, last) - self._rows(y0, first, last)
        turn = self._rows(y1, TEXELS, TEXELS + 1) - self._rows(y0, TEXELS, TEXELS + 1)
        left, right = (
            (1.0 - f) * band[:, j - first] + f * band[:, j + 1 - first] + turns * turn for turns, j, f in places
        )
        mean: Floats = self._mean + (right - left) / ((y1 - y0)[:, None] * (x1 - x0))
        return mean

    def _rows(self, y: Floats, first: int, last: int) -> Floats:
        """Sums (K, last - first) over the rows up to each y (K,), up to these columns."""
        turns, i, f = (each[:, None] for each in _place(y))
        sums = self._sums[:, first:last]
        rows: Floats = (1.0 - f) * sums[i[:, 0]] + f * sums[i[:, 0] + 1] + turns * sums[-1]
        return rows


texture = functools.cache(Texture)  # by the seed


def _place(at: Floats) -> tuple[Floats, Ints, Floats]:
    """The number of whole tiles, the texel in the tile, and the fraction of that texel."""
    turns, at = np.divmod(at, TEXELS)
    i = np.minimum(at.astype(np.int64), TEXELS - 1)  # rounding may give a whole tile
    return turns, i, at - i


@functools.cache
def street_loop() -> NDArray[np.uint8]:
    """Images (LOOP_FRAMES, HEIGHT_PX, WIDTH_PX), read-only: a closed loop with steps of FRAME_M."""
    u_px, v_px = np.arange(WIDTH_PX) - WIDTH_PX / 2, np.arange(HEIGHT_PX) - HEIGHT_PX / 2
    out = np.full((LOOP_FRAMES, HEIGHT_PX, WIDTH_PX), SKY, dtype=np.uint8)
    driven_m = np.arange(LOOP_FRAMES, dtype=np.float64) * FRAME_M

    def draw(rows: Any, columns: Any, surface: Texture, depth_m: list[float], across_m: list[Floats]) -> None:
        """Draws pixels of one depth in all frames; `depth_m` and `across_m` are the edges of each pixel's footprint."""
        y, x = (TEXELS_PER_M * (at_m + driven_m) for at_m in depth_m), (TEXELS_PER_M * at_m for at_m in across_m)
        shade = surface.mean(*y, *x)
        out[:, rows, columns] = np.clip(shade + 0.5, 0.0, 255.0).astype(np.uint8)

    road, fronts = texture(5), texture(7)
    for row in np.flatnonzero(v_px > 1.0):
        below_px = v_px[row]
        m_per_px = HEIGHT_M / below_px
        depth_m = [F_PX * HEIGHT_M / (below_px + half) for half in (0.5, -0.5)]
        draw(row, slice(None), road, depth_m, [(u_px + half) * m_per_px for half in (-0.5, 0.5)])
    for column in np.flatnonzero(np.abs(u_px) > 3.0):  # in front of the road
        away_px = abs(u_px[column])
        m_per_px = FRONT_AT_M / away_px
        high_m = HEIGHT_M - v_px * m_per_px
        rows = np.flatnonzero((high_m > 0.0) & (high_m < FRONT_HIGH_M))
        other_side_m = TEXELS / 2 / TEXELS_PER_M if u_px[column] > 0.0 else 0.0
        depth_m = [F_PX * FRONT_AT_M / (away_px + half) for half in (0.5, -0.5)]
        draw(rows, column, fronts, depth_m, [high_m[rows] + other_side_m + half * m_per_px for half in (-0.5, 0.5)])
    out.setflags(write=False)  # cached and shared
    return out
