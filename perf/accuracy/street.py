"""What the software camera of the fault suite shows: a street without end, between house fronts, at constant speed.

Each pixel is the mean of the surface that it covers, as a lens gives it: the far road must not flicker, or the odometry
would be judged by motions that are in no street. The mean of a rectangle of texture is four look-ups in its integral.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH_PX, HEIGHT_PX, F_PX, HEIGHT_M = 480, 160, 260.0, 1.65
LOOP_FRAMES, TEXELS, TEXELS_PER_M = 128, 2048, 24.0
FRAME_M = TEXELS / LOOP_FRAMES / TEXELS_PER_M  # driven from one frame to the next
FRONT_AT_M, FRONT_HIGH_M = 7.0, 6.0  # the house fronts: to either side of the camera, and over the road
SKY = 200
GRAIN_TEXELS = (1, 3, 9, 27)  # asphalt and plaster have grain of every size
MEAN, CONTRAST = 128.0, 40.0

Floats = NDArray[np.float64]


class Texture:
    """A square of TEXELS whose edges meet, to be asked for the mean over any rectangle."""

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
        self._sums = np.zeros((TEXELS + 1, TEXELS + 1))  # [i, j]: over the first i rows and j columns, less the mean
        self._sums[1:, 1:] = (texture - self._mean).cumsum(0).cumsum(1)

    def _integral(self, y: Floats, x: Floats) -> Floats:
        """Over all up to (y, x), in texels, of the texture laid side by side without end."""
        turns_y, y = np.divmod(y, TEXELS)
        turns_x, x = np.divmod(x, TEXELS)
        i, j = (np.minimum(at.astype(np.int64), TEXELS - 1) for at in (y, x))  # a turn less a rounding error is a turn
        fy, fx = y - i, x - j
        sums = self._sums
        upper = (1.0 - fx) * sums[i, j] + fx * sums[i, j + 1]
        lower = (1.0 - fx) * sums[i + 1, j] + fx * sums[i + 1, j + 1]
        rows = (1.0 - fx) * sums[-1, j] + fx * sums[-1, j + 1]  # of a whole turn in y; in x and y together it is 0
        columns = (1.0 - fy) * sums[i, -1] + fy * sums[i + 1, -1]
        whole: Floats = (1.0 - fy) * upper + fy * lower + turns_y * rows + turns_x * columns
        return whole

    def mean(self, y0: Floats, y1: Floats, x0: Floats, x1: Floats) -> Floats:
        """Over each rectangle, in texels."""
        total = self._integral(y1, x1) - self._integral(y0, x1) - self._integral(y1, x0) + self._integral(y0, x0)
        mean: Floats = self._mean + total / ((y1 - y0) * (x1 - x0))
        return mean


@functools.cache
def street_loop() -> NDArray[np.uint8]:
    """(LOOP_FRAMES, HEIGHT_PX, WIDTH_PX), read-only: FRAME_M further from each to the next, and from the last to the
    first.
    """
    u, v = np.meshgrid(np.arange(WIDTH_PX) - WIDTH_PX / 2, np.arange(HEIGHT_PX) - HEIGHT_PX / 2)
    out = np.full((LOOP_FRAMES, HEIGHT_PX, WIDTH_PX), SKY, dtype=np.uint8)

    below = v > 1.0
    road_px, depth_m = v[below], F_PX * HEIGHT_M / v[below]
    road_depth_m = F_PX * HEIGHT_M / (road_px + 0.5), F_PX * HEIGHT_M / (road_px - 0.5)
    road_side_m = (u[below] - 0.5) * depth_m / F_PX, (u[below] + 0.5) * depth_m / F_PX

    away_px = np.maximum(np.abs(u), 1.0)
    front_m = F_PX * FRONT_AT_M / away_px
    high_m = HEIGHT_M - v * front_m / F_PX
    front = (away_px > 3.0) & (high_m > 0.0) & (high_m < FRONT_HIGH_M)
    front_depth_m = F_PX * FRONT_AT_M / (away_px[front] + 0.5), F_PX * FRONT_AT_M / (away_px[front] - 0.5)
    other_side_m = np.where(u[front] > 0.0, TEXELS / 2 / TEXELS_PER_M, 0.0)
    front_high_m = tuple(high_m[front] + other_side_m + half * front_m[front] / F_PX for half in (-0.5, 0.5))

    surfaces = (
        (Texture(5), below, road_depth_m, road_side_m),
        (Texture(7), front, front_depth_m, front_high_m),  # before the road behind it
    )
    for texture, seen, (near_m, far_m), (left_m, right_m) in surfaces:
        left, right = TEXELS_PER_M * left_m, TEXELS_PER_M * right_m
        for number in range(LOOP_FRAMES):
            driven_m = number * FRAME_M
            shade = texture.mean(TEXELS_PER_M * (near_m + driven_m), TEXELS_PER_M * (far_m + driven_m), left, right)
            out[number][seen] = np.clip(shade + 0.5, 0.0, 255.0).astype(np.uint8)
    out.setflags(write=False)  # it is rendered once for all who ask
    return out
