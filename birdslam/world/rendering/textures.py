"""Natural textures from a seed: tileable 1/f noise with coarser levels, cracks, and masks of foliage."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32

SIZE_PX = 256
LEVELS = 7
CLOUD, GRAIN, CRACK, CLUMP = range(4)  # channels of `noise_bank`
MASK_PX = 128
MASKS = 24


def _coloured(rng: np.random.Generator, exponent: float, size_px: int = SIZE_PX) -> Floats:
    """Tileable noise of zero mean and unit deviation whose amplitude falls as 1 / f^exponent."""
    f = np.hypot(np.fft.fftfreq(size_px)[:, None], np.fft.fftfreq(size_px)[None, :])
    f[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((size_px, size_px))) / f**exponent
    spectrum[0, 0] = 0.0
    out = np.fft.ifft2(spectrum).real
    result: Floats = out / out.std()
    return result


@cache
def noise_bank() -> Floats32:
    """(4 channels, LEVELS, SIZE_PX, SIZE_PX): level l, half as fine as l - 1, fills the first SIZE_PX >> l rows."""
    rng = np.random.default_rng(20260101)
    cloud = _coloured(rng, 1.1)
    grain = _coloured(rng, 0.25)
    winding = _coloured(rng, 1.6)
    # Cracks follow the zero crossings of smooth noise
    crack = np.exp(-np.square(winding / 0.022)) * (_coloured(rng, 1.3) > 0.35)
    clump = np.abs(_coloured(rng, 0.8)) - 0.8
    bank = np.zeros((4, LEVELS, SIZE_PX, SIZE_PX), np.float32)
    for channel, texture in enumerate((cloud, grain, crack, clump)):
        level = texture.astype(np.float32)
        for index in range(LEVELS):
            bank[channel, index, : len(level), : len(level)] = level
            level = level.reshape(len(level) // 2, 2, len(level) // 2, 2).mean(axis=(1, 3))
    return bank


@cache
def foliage_masks() -> NDArray[np.uint8]:
    """Masks (MASKS, MASK_PX, MASK_PX): 0 is a gap, else brightness of leaves (1-255); row 0 is the top of the crown."""
    rng = np.random.default_rng(20260102)
    y, x = np.mgrid[-1 : 1 : MASK_PX * 1j, -1 : 1 : MASK_PX * 1j]
    out = np.zeros((MASKS, MASK_PX, MASK_PX), np.uint8)
    for index in range(MASKS):
        lumps = _coloured(rng, 1.1, MASK_PX)
        leaves = _coloured(rng, 0.55, MASK_PX)
        kind = index % 3
        if kind == 0:  # a crown
            inside = 1.0 - np.hypot(x, y * rng.uniform(0.95, 1.15)) ** 2
        elif kind == 1:  # a bush or a hedge: flat bottom
            inside = 1.0 - np.abs(x) ** 4 - np.clip(-y, 0, 1) ** 3
        else:  # a conifer
            inside = 0.62 * (y + 1.0) - np.abs(x) * 1.15 + 0.1 * np.sin(y * rng.uniform(18, 30))
        gaps = inside * 1.5 + 0.38 * lumps + 0.32 * leaves - rng.uniform(0.2, 0.6)
        light = 0.52 + 0.16 * lumps + 0.2 * leaves - 0.28 * y * 0.8
        out[index] = np.where(gaps > 0.0, np.clip(255.0 * light, 1.0, 255.0), 0.0).astype(np.uint8)
    return out


@cache
def pictures() -> Floats32:
    """(16, 64, 64, 3): posters, wall art, lettering and shop signs, random shapes; linear light, 0-1."""
    rng = np.random.default_rng(20260103)
    out = np.zeros((16, 64, 64, 3), np.float32)
    for index in range(16):
        canvas = np.tile(rng.uniform(40, 220, 3), (64, 64, 1)).astype(np.uint8)
        for _ in range(int(rng.integers(3, 9))):
            colour = tuple(float(c) for c in rng.uniform(10, 235, 3))
            a, b = rng.integers(0, 64, (2, 2)).tolist()
            match int(rng.integers(0, 4)):
                case 0:
                    cv2.rectangle(canvas, a, b, colour, int(rng.choice([-1, 1, 3])))
                case 1:
                    cv2.circle(canvas, a, int(rng.integers(3, 22)), colour, int(rng.choice([-1, 2])))
                case 2:
                    cv2.line(canvas, a, b, colour, int(rng.integers(1, 7)))
                case _:
                    letters = "".join(chr(int(c)) for c in rng.integers(65, 91, 4))
                    cv2.putText(canvas, letters, (int(rng.integers(0, 24)), b[1]), 5, 0.9, colour, 1, cv2.LINE_AA)
        out[index] = (cv2.GaussianBlur(canvas, (3, 3), 0) / 255.0) ** 1.8
    return out
