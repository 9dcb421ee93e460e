"""Simulates video compression of dashboard cameras (MPEG-4, H.264): motion-compensated blocks, coarse residuals.

OpenCV's writers have no bit rate setting. The artefacts on the road are the same: smooth asphalt moves with its block
or freezes until the next intra-coded image.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats32, Image

BLOCK_PX, DCT_PX = 16, 8
GROUP = 12  # images per group of pictures; the first is intra-coded
DEADZONE = 1.0 / 6.0  # rounding offset, as in P images of H.264's reference encoder
STILL_BONUS_GREY = 1.0  # per pixel; a block without motion costs no bits


class VideoEncoder:
    """`code` encodes and decodes the images of a video in order, all of one size.

    `step` is the quantiser's, in grey levels of the orthonormal DCT (H.264's QP 28 is 16, QP 34 is 32).
    """

    def __init__(self, step: float = 24.0) -> None:
        self._step = step
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._shown: list[Floats32] = []  # planes of the previous decoded image
        self._count = 0

    def code(self, image: Image) -> Image:
        """(H, W) grey or (H, W, 3) BGR uint8."""
        height, width = image.shape[:2]
        unit = 2 * BLOCK_PX
        padded = cv2.copyMakeBorder(image, 0, -height % unit, 0, -width % unit, cv2.BORDER_REPLICATE)
        planes = _planes(np.asarray(padded, np.uint8))
        alone = self._count % GROUP == 0
        moves = np.zeros((*padded.shape[:2], 2), np.float32) if alone else self._moves(planes[0])
        for k, plane in enumerate(planes):
            guess = np.full_like(plane, 128.0) if alone else _moved(self._shown[k], moves)
            residual = _coarse(plane - guess, self._step, 0.5 if alone else DEADZONE)
            planes[k] = np.clip(guess + residual, 0.0, 255.0)
        self._shown, self._count = planes, self._count + 1
        return np.ascontiguousarray(_image(planes)[:height, :width])

    def _moves(self, luma: Floats32) -> Floats32:
        """Source position (H, W, 2) of each pixel's block in the previous image."""
        before, now = self._shown[0].astype(np.uint8), luma.astype(np.uint8)
        flow = self._flow.calc(now, before, None)  # type: ignore[call-overload]
        rows, columns = luma.shape[0] // BLOCK_PX, luma.shape[1] // BLOCK_PX
        blocks = flow.reshape(rows, BLOCK_PX, columns, BLOCK_PX, 2).mean(axis=(1, 3))
        whole = _spread(np.round(4.0 * blocks) / 4.0)  # quarters of a pixel
        still = _per_block(np.abs(self._shown[0] - luma)) - STILL_BONUS_GREY <= _per_block(
            np.abs(_moved(self._shown[0], whole) - luma)
        )
        whole[_spread(still)] = 0.0
        return whole


def _per_block(plane: Floats32) -> Floats32:
    rows, columns = plane.shape[0] // BLOCK_PX, plane.shape[1] // BLOCK_PX
    out: Floats32 = plane.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3))
    return out


def _spread(blocks: NDArray) -> NDArray:
    """Repeats the value of each block for its pixels."""
    return np.repeat(np.repeat(blocks, BLOCK_PX, axis=0), BLOCK_PX, axis=1)


def _moved(before: Floats32, moves: Floats32) -> Floats32:
    """Motion-compensates a plane, which may have half the size of `moves`."""
    size = (before.shape[1], before.shape[0])
    share = size[0] / moves.shape[1]
    scaled = moves if share == 1.0 else cv2.resize(moves, size, interpolation=cv2.INTER_NEAREST) * share
    y, x = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float32)
    map_x, map_y = x + scaled[..., 0], y + scaled[..., 1]
    return np.asarray(cv2.remap(before, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _dct_matrix() -> Floats32:
    k, n = np.mgrid[0:DCT_PX, 0:DCT_PX]
    matrix = np.sqrt(2.0 / DCT_PX) * np.cos(np.pi * (2 * n + 1) * k / (2 * DCT_PX))
    matrix[0] /= np.sqrt(2.0)
    return matrix.astype(np.float32)


_DCT = _dct_matrix()


def _coarse(residual: Floats32, step: float, rounding: float) -> Floats32:
    """The residual with its DCT quantized to multiples of the step."""
    rows, columns = residual.shape[0] // DCT_PX, residual.shape[1] // DCT_PX
    blocks = residual.reshape(rows, DCT_PX, columns, DCT_PX).transpose(0, 2, 1, 3)
    levels = _DCT @ blocks @ _DCT.T / step
    levels = np.sign(levels) * np.floor(np.abs(levels) + rounding)
    out: Floats32 = (_DCT.T @ (levels * step) @ _DCT).transpose(0, 2, 1, 3).reshape(residual.shape).astype(np.float32)
    return out


def _planes(image: Image) -> list[Floats32]:
    """Luma, and for a colour image the two chroma planes at half the size."""
    if image.ndim == 2:
        return [image.astype(np.float32)]
    y, cr, cb = cv2.split(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb))
    half = (image.shape[1] // 2, image.shape[0] // 2)
    small = [cv2.resize(plane, half, interpolation=cv2.INTER_AREA) for plane in (cr, cb)]
    return [plane.astype(np.float32) for plane in (y, *small)]


def _image(planes: list[Floats32]) -> Image:
    if len(planes) == 1:
        return np.round(planes[0]).astype(np.uint8)
    size = (planes[0].shape[1], planes[0].shape[0])
    full = [planes[0], *(cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR) for plane in planes[1:])]
    out: Image = cv2.cvtColor(np.round(np.stack(full, axis=-1)).astype(np.uint8), cv2.COLOR_YCrCb2BGR)  # type: ignore[assignment]
    return out
