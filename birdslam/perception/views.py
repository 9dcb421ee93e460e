"""Views of an image in the network's input: the visible part of the image and its position in the input."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.perception.manifest import FitPad, Input, Tiles


@dataclass(frozen=True)
class View:
    """A column of the image, x0_px to x1_px over the full height, and its rectangle in the network's input.

    Coordinates refer to pixel edges, not centres: the image spans (0, 0) to (width, height).
    """

    image_width_px: int
    image_height_px: int
    x0_px: int
    x1_px: int
    left_px: int  # of the rectangle, in the input
    top_px: int
    width_px: int
    height_px: int

    @property
    def ratio(self) -> Floats:
        """(2,): input pixels per image pixel, along x and y."""
        return np.array([self.width_px / (self.x1_px - self.x0_px), self.height_px / self.image_height_px])

    def crop(self, plane: Floats32, input: Input) -> Floats32:
        """This view's rectangle (h, w), not copied, of a map (H, W) over the whole input at any resolution."""
        fy, fx = plane.shape[0] / input.height_px, plane.shape[1] / input.width_px
        rows = slice(round(self.top_px * fy), max(round((self.top_px + self.height_px) * fy), 1))
        columns = slice(round(self.left_px * fx), max(round((self.left_px + self.width_px) * fx), 1))
        return plane[rows, columns]

    def to_image(self, boxes_px: Floats) -> Floats:
        """Transforms boxes (N, 4) from the input to the image."""
        corners = boxes_px.reshape(-1, 2, 2) - [self.left_px, self.top_px]
        return (corners / self.ratio + [self.x0_px, 0.0]).reshape(-1, 4)

    def to_network(self, boxes_px: Floats) -> Floats:
        """Transforms boxes (N, 4) from the image to the input."""
        corners = boxes_px.reshape(-1, 2, 2) - [self.x0_px, 0.0]
        return (corners * self.ratio + [self.left_px, self.top_px]).reshape(-1, 4)


def make_views(width_px: int, height_px: int, input: Input, tiles: Tiles | None) -> tuple[View, ...]:
    """The views that cover an image, left to right: one, or the columns of `tiles`, all of equal width."""
    columns, overlap = (tiles.columns, tiles.overlap) if tiles is not None else (1, 0.0)
    for count in range(1, columns + 1):
        tile_px = min(width_px, math.ceil(width_px / (count - (count - 1) * overlap)))
        if tile_px * input.height_px <= height_px * input.width_px:
            break  # narrow enough to fill the input's height
    left_px, top_px, inner_width_px, inner_height_px = _placement(tile_px, height_px, input)
    views = []
    for index in range(count):
        x0_px = round(index * (width_px - tile_px) / (count - 1)) if count > 1 else 0
        views.append(
            View(width_px, height_px, x0_px, x0_px + tile_px, left_px, top_px, inner_width_px, inner_height_px)
        )
    return tuple(views)


def _placement(width_px: int, height_px: int, input: Input) -> tuple[int, int, int, int]:
    if not isinstance(input.resize, FitPad):
        return 0, 0, input.width_px, input.height_px
    ratio = min(input.width_px / width_px, input.height_px / height_px)
    inner_width_px = min(input.width_px, max(1, round(width_px * ratio)))
    inner_height_px = min(input.height_px, max(1, round(height_px * ratio)))
    if input.resize.align == "centre":
        left_px, top_px = (input.width_px - inner_width_px) // 2, (input.height_px - inner_height_px) // 2
    else:
        left_px, top_px = 0, 0
    return left_px, top_px, inner_width_px, inner_height_px


class Preparation:
    """Fills the network's input tensor from an image; the buffers are allocated once."""

    def __init__(self, input: Input) -> None:
        self.input = input
        planes = (1, 3, input.height_px, input.width_px)
        self.tensor = np.zeros(planes if input.layout == "NCHW" else (1, *planes[2:], 3), dtype=np.float32)
        # A (3, H, W) view of the tensor for either layout
        self._planes = self.tensor[0] if input.layout == "NCHW" else np.moveaxis(self.tensor[0], -1, 0)
        self._gain = [np.float32(input.scale / s) for s in input.std]
        self._offset = [np.float32(-m / s) for m, s in zip(input.mean, input.std, strict=True)]
        self._order = (0, 1, 2) if input.colour == "BGR" else (2, 1, 0)
        self._canvases: dict[int, NDArray[np.uint8]] = {}
        self._placed: dict[int, tuple[int, int, int, int]] = {}

    def fill(self, image: NDArray[np.uint8], view: View) -> None:
        """Writes the view of a grey (H, W) or BGR (H, W, 3) image into `tensor`."""
        canvas = self._canvas(image.ndim, view)
        rows = slice(view.top_px, view.top_px + view.height_px)
        columns = slice(view.left_px, view.left_px + view.width_px)
        source = image[:, view.x0_px : view.x1_px]
        canvas[rows, columns] = cv2.resize(source, (view.width_px, view.height_px), interpolation=cv2.INTER_LINEAR)
        for plane, gain, offset, channel in zip(self._planes, self._gain, self._offset, self._order, strict=True):
            np.multiply(canvas if image.ndim == 2 else canvas[..., channel], gain, out=plane)
            if offset:
                plane += offset

    def _canvas(self, ndim: int, view: View) -> NDArray[np.uint8]:
        """The padded image at the input's size; a moved rectangle gets new padding."""
        size = (self.input.height_px, self.input.width_px)
        if ndim not in self._canvases:
            self._canvases[ndim] = np.empty(size if ndim == 2 else (*size, 3), dtype=np.uint8)
        placed = (view.left_px, view.top_px, view.width_px, view.height_px)
        if self._placed.get(ndim) != placed and isinstance(self.input.resize, FitPad):
            self._canvases[ndim][:] = self.input.resize.pad_value
        self._placed[ndim] = placed
        return self._canvases[ndim]
