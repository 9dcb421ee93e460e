"""Decoder of segmentation outputs to masks of the image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32
from birdslam.perception.manifest import ClassMap, ClassMaps, Input, ManifestMismatch, Meaning
from birdslam.perception.views import View


@dataclass(frozen=True)
class Segmentation:
    """Masks (H, W) bool of the undistorted image; all false for a meaning that the network lacks."""

    road: Bools
    lane: Bools

    def above(self, edge_px: Floats) -> Segmentation:
        """Clears the masks below an edge (N, 2) from left to right."""
        height, width = self.road.shape
        last = np.interp(np.arange(width), *edge_px.T)
        over = np.arange(height)[:, None] < last
        return Segmentation(self.road & over, self.lane & over)


class ClassMapsDecoder:
    """Reads class channels (see `manifest.ClassMaps`)."""

    def __init__(self, table: ClassMaps, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if an output's shape isn't what the manifest makes of it."""
        self.table, self.input = table, input
        for index, entry in enumerate(table.maps):
            shape = shapes[entry.output]
            if len(shape) != 4 or shape[0] != 1:
                stated = f"{entry.output} of shape (1, channels, h, w)"
                raise ManifestMismatch(f"segmenter.maps[{index}].output", stated, shape)
            if shape[1] != entry.channels:
                has = f"{shape[1]} in {entry.output} {shape}"
                raise ManifestMismatch(f"segmenter.maps[{index}].channels", entry.channels, has)

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Segmentation:
        """The masks of one run over the whole image."""
        masks = {entry.meaning: self._mask(tensors[entry.output][0], entry, view) for entry in self.table.maps}
        meanings: tuple[Meaning, ...] = ("road", "lane")
        empty = np.zeros((view.image_height_px, view.image_width_px), dtype=bool)
        return Segmentation(**{meaning: masks.get(meaning, empty) for meaning in meanings})

    def merge(self, parts: Sequence[Segmentation], views: Sequence[View]) -> Segmentation:
        """A segmenter has one view."""
        (part,) = parts
        return part

    def _mask(self, scores: Floats32, entry: ClassMap, view: View) -> Bools:
        """Mask (H, W): the pixels where the channel's margin over its threshold, resized to the image, is positive.

        Resizing the margin rather than the mask keeps the border smooth at the image's resolution.
        """
        chosen = entry.chosen
        channel = scores[chosen[0]] if len(chosen) == 1 else scores[list(chosen)].max(axis=0)
        if entry.rule == "above":
            margin = channel - np.float32(entry.level)
        elif entry.channels == 2:
            margin = channel - scores[1 - chosen[0]]
        else:
            margin = channel - np.delete(scores, chosen, axis=0).max(axis=0)
        size = (view.image_width_px, view.image_height_px)
        return cv2.resize(view.crop(margin, self.input), size, interpolation=cv2.INTER_LINEAR) > 0.0
