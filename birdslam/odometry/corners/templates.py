"""Templates of tracked corners: the image patch in which a corner was first seen.

Optical flow from image to image adds its error to each track; an alignment with the first patch does not (Shi and
Tomasi 1994). A patch is warped by translation and scale, since a corner's image grows as the camera approaches:
    I(px + s g) = a T(g) + b,    g over the patch
One step of inverse compositional Gauss-Newton (Baker and Matthews 2004) for all corners, with contrast a and brightness
b eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32, Image, Ints

_HALF_PX = 7  # half the side of a patch
_MAX_SCALE = 1.5  # a patch that has grown by more is replaced: the samples would be too sparse
_MAX_SHIFT_PX = 2.0  # of an alignment, from the optical flow
_MIN_CONTRAST = 0.3  # of a patch, relative to its template
_MIN_CORRELATION = 0.8  # of an aligned patch
_DAMPING = 1.0  # information that a patch without texture gets
_NOISE_GREY2 = 1.0  # variance of a patch by noise


def _grid(half_px: int) -> tuple[Floats32, Floats32]:
    v, u = np.mgrid[-half_px : half_px + 1, -half_px : half_px + 1]
    return u.ravel().astype(np.float32), v.ravel().astype(np.float32)


_U, _V = _grid(_HALF_PX)
_WEIGHT = np.exp(-(_U**2 + _V**2) / (2.0 * (0.6 * _HALF_PX) ** 2))
_WEIGHT /= _WEIGHT.sum()


@dataclass(frozen=True)
class Alignment:
    """Corners aligned with their templates."""

    px: Floats  # (N, 2)
    scale: Floats  # (N,) of the patch, relative to its template
    good: Bools  # (N,) whether the patch looks like its template


class CornerTemplates:
    """The templates of the N corners of the reference image, by ascending id."""

    def __init__(self) -> None:
        self._ids: Ints = np.zeros(0, np.int64)
        self._scale: Floats = np.zeros(0)
        self._slot: Ints = np.zeros(0, np.int64)  # (N,) of each corner in the arrays below, which are never moved
        self._patch: Floats32 = np.zeros((0, len(_U)), np.float32)
        self._gain: Floats32 = np.zeros((0, 3, len(_U)), np.float32)  # from differences to (u, v, log scale)

    def align(self, image: Image, ids: Ints, px: Floats) -> Alignment:
        """Aligns corners of the reference image, `ids` (N,), from their positions (N, 2) by optical flow."""
        if not len(ids):
            return Alignment(px, np.zeros(0), np.zeros(0, bool))
        at = np.searchsorted(self._ids, ids)
        slot, warp = self._slot[at], np.column_stack([px, self._scale[at]]).astype(np.float32)
        patch = self._patch[slot]
        now, correlation = _matched(_sample(image, warp), patch)
        step = (self._gain[slot] @ (now - patch)[:, :, None])[..., 0]
        scale = warp[:, 2] * np.exp(-step[:, 2])
        aligned = px - scale[:, None] * step[:, :2]
        good = (np.abs(aligned - px).max(axis=1) < _MAX_SHIFT_PX) & (correlation > _MIN_CORRELATION)
        return Alignment(aligned, scale.astype(np.float64), good)

    def update(self, image: Image, ids: Ints, px: Floats, scale: Floats) -> None:
        """Changes the reference to `image` with corners `ids` (N,), px (N, 2), of which the first (M,) were aligned.

        `scale` (M,) is that of the alignments, nan for a corner that gets a new template.
        """
        kept = (scale < _MAX_SCALE) & (scale > 1.0 / _MAX_SCALE)
        fresh = np.concatenate([~kept, np.ones(len(ids) - len(scale), bool)])
        slot, scales = np.zeros(len(ids), np.int64), np.ones(len(ids))
        slot[~fresh] = self._slot[np.searchsorted(self._ids, ids[~fresh])]
        scales[~fresh] = scale[kept]
        self._reserve(len(ids))
        free = np.ones(len(self._patch), bool)
        free[slot[~fresh]] = False
        slot[fresh] = np.flatnonzero(free)[: fresh.sum()]
        if fresh.any():
            self._patch[slot[fresh]], self._gain[slot[fresh]] = _templates(image, px[fresh])
        self._ids, self._scale, self._slot = ids, scales, slot

    def _reserve(self, count: int) -> None:
        more = count - len(self._patch)
        if more > 0:
            self._patch = np.concatenate([self._patch, np.zeros((more, *self._patch.shape[1:]), np.float32)])
            self._gain = np.concatenate([self._gain, np.zeros((more, *self._gain.shape[1:]), np.float32)])


def _sample(image: Image, warp: Floats32, grid_u: Floats32 = _U, grid_v: Floats32 = _V) -> Floats32:
    """(N, S) grey values of the patches at `warp` (N, 3): u, v, scale."""
    u = warp[:, :1] + warp[:, 2:] * grid_u
    v = warp[:, 1:2] + warp[:, 2:] * grid_v
    out: Floats32 = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    return out


def _centred(patch: Floats32) -> Floats32:
    """The patches (N, S) without their means."""
    out: Floats32 = patch - (patch @ _WEIGHT)[:, None]
    return out


def _matched(now: Floats32, patch: Floats32) -> tuple[Floats32, Floats32]:
    """The patches `now` (N, S), centred and with the contrast of the templates `patch`, and their correlations (N,)."""
    now = _centred(now)
    both, own, old = (now * patch) @ _WEIGHT, (now * now) @ _WEIGHT, (patch * patch) @ _WEIGHT
    contrast = np.maximum((both + _NOISE_GREY2) / (old + _NOISE_GREY2), _MIN_CONTRAST)
    return now / contrast[:, None], both / np.sqrt((own + _NOISE_GREY2) * (old + _NOISE_GREY2))


def _templates(image: Image, px: Floats) -> tuple[Floats32, Floats32]:
    """The patches (N, S) at `px` (N, 2), centred, and the gains (N, 3, S) of their alignment."""
    side = 2 * _HALF_PX + 3
    warp = np.column_stack([px, np.ones(len(px))]).astype(np.float32)
    around = _sample(image, warp, *_grid(_HALF_PX + 1)).reshape(-1, side, side)
    patch, along_u, along_v = (
        a.reshape(len(px), -1)
        for a in (
            around[:, 1:-1, 1:-1],
            0.5 * (around[:, 1:-1, 2:] - around[:, 1:-1, :-2]),
            0.5 * (around[:, 2:, 1:-1] - around[:, :-2, 1:-1]),
        )
    )
    J = np.empty((len(px), 5, len(_U)), np.float32)
    patch = _centred(patch)
    J[:, 0], J[:, 1], J[:, 2], J[:, 3], J[:, 4] = along_u, along_v, along_u * _U + along_v * _V, 1.0, patch
    Jw = J * (_WEIGHT * len(_WEIGHT))
    H = (Jw @ J.transpose(0, 2, 1)).astype(np.float64) + _DAMPING * np.eye(5)
    return patch, np.linalg.inv(H)[:, :3].astype(np.float32) @ Jw
