"""Random photometric effects from light to image bytes: weather, exposure, blur, noise, tone, compression."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.world.rendering.light import SKY_SLOTS
from birdslam.world.rendering.textures import GRAIN, noise_bank


@dataclass(frozen=True)
class Lens:
    """Photometric parameters of a camera."""

    exposure: float  # relative to the metered exposure
    gamma: float
    contrast: float
    tint: tuple[float, float, float]  # of blue, green, red
    blur_px: float
    noise: float
    shot: float
    vignette: float
    bloom: float
    saturation: float
    quality: int  # of JPEG, 0: none
    sharpen: float
    flare: float = 0.0  # veiling glare as a fraction of the mean light
    whole: float = 0.0  # weight of the upper image, sky and walls, in metering
    fixed: float = 0.0  # light that becomes middle grey without metering, at maximum gain


def draw_sky(rng: np.random.Generator) -> Floats:
    """A random sky (see `light`): noon or low sun, deep or pale shade, overcast, haze, wet road."""
    u = rng.random(24)
    sky = np.zeros(SKY_SLOTS)
    overcast = u[0] < 0.28
    elevation = math.radians(8.0 + 60.0 * u[1] ** 1.3)
    azimuth = 2.0 * math.pi * u[2]
    sky[0:3] = math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)
    warm = max(0.0, 1.0 - elevation / 0.5)
    power = 3.0 + 5.0 * u[3]
    sky[3:6] = power * np.array([1.0, 0.95 - 0.2 * warm, 0.88 - 0.42 * warm])
    blue = 0.35 + 0.65 * u[4]
    base = 0.8 + 0.5 * u[5]
    sky[6:9] = base * np.array([1.0 - 0.5 * blue, 1.0 - 0.25 * blue, 1.05])
    sky[9:12] = base * (1.3 + 1.3 * u[6]) * np.array([0.97, 0.99, 1.0])
    sky[17] = u[7] * 0.8
    if overcast:
        sky[3:6] *= 0.25 * u[8] if u[8] > 0.4 else 0.0
        sky[6:9] = sky[9:12] = base * (1.4 + u[6]) * np.array([0.96, 0.98, 1.0])
        sky[17] = 0.2 * u[7]
    elif u[21] < 0.6:  # a dark blue sky gives at most a sixth of the sun's light: deep shade
        sky[6:12] *= 0.25 + 0.45 * u[22]
    sky[12:15] = sky[9:12] * 0.75
    sky[15] = math.exp(math.log(120.0) + u[9] * math.log(60.0)) if u[10] < 0.35 else 4000.0
    sky[16] = 0.25 + 0.75 * u[11] if u[12] < (0.35 if overcast else 0.07) else 0.0
    sky[18], sky[19] = u[13], 2.0 * u[14] * (not overcast)
    sky[20], sky[21] = u[15], 0.5 + 0.55 * u[16]
    sky[22], sky[23] = u[17], u[18]
    sky[24], sky[25] = 0.4 * u[19] ** 2, u[20]
    return sky


def draw_lens(rng: np.random.Generator) -> Lens:
    """A random camera: good, dark, overexposed, soft, noisy or grey."""
    u = rng.random(20)
    return Lens(
        exposure=math.exp(rng.normal(0.0, 0.48)),
        gamma=1.0 / ((1.7 if u[15] < 0.7 else 1.2) + 0.9 * u[0]),  # some cameras are nearly linear
        contrast=0.75 + 0.85 * u[1],
        tint=(0.88 + 0.24 * u[2], 1.0, 0.88 + 0.24 * u[3]),
        blur_px=0.25 + 1.3 * u[4] ** 3,
        noise=0.001 + 0.014 * u[5] ** 3,
        shot=0.022 * u[6] ** 2,
        vignette=0.45 * u[7] ** 2,
        bloom=0.25 * u[8] ** 3,
        saturation=0.0 if u[9] < 0.33 else 0.3 + 0.8 * u[10],
        quality=int(35 + 62 * u[11]) if u[12] < 0.5 else 0,
        sharpen=0.9 * u[13] if u[14] < 0.35 else 0.0,
        flare=0.06 * u[18] ** 1.5,
        whole=u[17] if u[16] < 0.4 else 0.0,
    )


def metered(light: Floats32, whole: float) -> float:
    """The light that becomes middle grey: of the lower image without its brightest pixels, or of the whole image."""
    height, width = light.shape[:2]
    if height <= 8:
        return 1.0
    green = light[::3, ::3, 1]
    lower = np.sort(light[height // 3 :: 3, ::3, 1], axis=None)[: int(0.9 * (height // 3) * width // 3)].mean()
    # Clipped pixels saturate in the meter
    everything = np.minimum(green, 4.0 * max(float(green.mean()), 1e-3)).mean() if whole > 0.0 else 0.0
    return float((1.0 - whole) * lower + whole * everything)


@njit(cache=True, nogil=True, error_model="numpy")
def _expose(image, bank, i, j, k, shot, noise, coloured, table, out):  # type: ignore[no-untyped-def]
    """Adds grain from `bank` (256, 256), offset by row i and column j, to the image (H, W, 3); applies `table`."""
    zero, one, half, rest = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(0.85)
    for row in range(image.shape[0]):
        r0 = (row + i) & 255
        r1 = (r0 + k) & 255
        for column in range(image.shape[1]):
            c0 = (column + j) & 255
            first, third = bank[r0, c0], bank[r1, (c0 * 3 + k) & 255]
            second = half * first + rest * third
            for channel in range(3):
                grain = first if channel == 0 or not coloured else (second if channel == 1 else third)
                value = image[row, column, channel]
                value += (math.sqrt(max(value, zero)) * shot + noise) * grain
                out[row, column, channel] = table[int(min(max(value, zero), one) * np.float32(1024.0))]


def develop(light: Floats32, lens: Lens, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Converts linear BGR light (H, W, 3) to the camera's image."""
    height, width = light.shape[:2]
    middle = lens.fixed or metered(light, lens.whole)
    image = light * np.float32(0.2 * lens.exposure / max(middle, 1e-3))
    image *= np.array(lens.tint, np.float32)
    if lens.bloom > 0.02:
        small = cv2.resize(np.minimum(image, 6.0), (width // 4, height // 4), interpolation=cv2.INTER_AREA)
        glow = cv2.resize(cv2.GaussianBlur(np.maximum(small - 0.7, 0.0), (0, 0), width / 80.0), (width, height))
        image += np.float32(lens.bloom) * glow
    if lens.flare > 0.0:
        image += np.float32(lens.flare) * np.minimum(image, np.float32(4.0)).mean()
    if lens.vignette > 0.03:
        x = np.linspace(-1.0, 1.0, width, dtype=np.float32)
        y = np.linspace(-height / width, height / width, height, dtype=np.float32)
        image *= (1.0 - np.float32(lens.vignette) * (x[None, :] ** 2 + y[:, None] ** 2))[..., None]
    if lens.blur_px > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), lens.blur_px)  # type: ignore[assignment]
    if lens.saturation < 1e-6:
        image = np.repeat(image @ np.array([0.114, 0.587, 0.299], np.float32), 3, axis=1).reshape(image.shape)
    bank = noise_bank()[GRAIN, 0]
    i, j, k = (int(v) for v in rng.integers(0, 256, 3))
    # An S-shaped tone curve that clips, as cameras do
    levels = np.linspace(0.0, 1.0, 1025)
    curve = np.power(np.clip(levels, 0.0, 1.0), lens.gamma)
    curve = 0.5 + (curve - 0.5) * lens.contrast + 0.05 * (lens.contrast - 1.0)
    table = np.clip(255.0 * curve, 0.0, 255.0).astype(np.uint8)
    out = np.empty(image.shape, np.uint8)
    coloured = lens.saturation > 0.0
    _expose(image, bank, i, j, k, np.float32(lens.shot), np.float32(lens.noise), coloured, table, out)
    if lens.saturation > 0.0 and abs(lens.saturation - 1.0) > 0.02:
        grey = cv2.cvtColor(out, cv2.COLOR_BGR2GRAY)[..., None].astype(np.float32)
        out = np.clip(grey + (out - grey) * lens.saturation, 0, 255).astype(np.uint8)
    if lens.sharpen > 0.0:
        soft = cv2.GaussianBlur(out, (0, 0), 1.0)
        out = cv2.addWeighted(out, 1.0 + lens.sharpen, soft, -lens.sharpen, 0.0)  # type: ignore[assignment]
    if lens.quality:
        ok, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, lens.quality])
        if not ok:
            raise ValueError(f"an image of {width}x{height} can't be compressed")
        out = cv2.imdecode(data, cv2.IMREAD_COLOR)  # type: ignore[assignment]
    return out
