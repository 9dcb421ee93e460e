"""Decoder of CenterNet: each peak of the heat map is an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats32
from birdslam.perception.decoding.detection import (
    MAX_CANDIDATES,
    Candidates,
    Detections,
    candidates_in_image,
    merge_views,
    rival_groups,
)
from birdslam.perception.manifest import CenterNet, Input, ManifestMismatch
from birdslam.perception.views import View

MAX_LOGIT = 60.0  # beyond it the sigmoid is 1 in floating point


class CenterNetDecoder:
    """Reads CenterNet outputs (see `manifest.CenterNet`)."""

    def __init__(self, table: CenterNet, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the outputs' shapes contradict the manifest."""
        self.table = table
        heat = shapes[table.heat_map]
        if len(heat) != 4 or heat[0] != 1:
            raise ManifestMismatch("detector.heat_map", f"{table.heat_map} of shape (1, classes, h, w)", heat)
        if heat[1] != table.classes:
            raise ManifestMismatch("detector.classes", table.classes, f"{heat[1]} in {table.heat_map} {heat}")
        for key, output in (("sizes", table.sizes), ("offsets", table.offsets)):
            if output and shapes[output] != (1, 2, *heat[2:]):
                raise ManifestMismatch(f"detector.{key}", f"{output} of shape {(1, 2, *heat[2:])}", shapes[output])
        self._cell_px = np.array([input.width_px / heat[3], input.height_px / heat[2]])
        self._groups = rival_groups(table.classes, table.labels, table.rivals)
        self._wanted = np.array(sorted(table.labels))

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Candidates:
        """The peaks of one run above the score threshold, as boxes clipped to the image."""
        table = self.table
        heat = tensors[table.heat_map][0, self._wanted]
        if table.heat == "logits":
            heat = 1.0 / (1.0 + np.exp(-np.clip(heat, -MAX_LOGIT, MAX_LOGIT)))
        around = np.stack([cv2.dilate(plane, np.ones((3, 3), np.uint8)) for plane in heat])
        planes, rows, columns = np.nonzero((heat >= table.score_threshold) & (heat == around))
        scores = heat[planes, rows, columns].astype(np.float64)
        best = np.argsort(-scores, kind="stable")[:MAX_CANDIDATES]
        planes, rows, columns, scores = planes[best], rows[best], columns[best], scores[best]
        centre = np.column_stack([columns, rows]).astype(np.float64)
        if table.offsets:
            centre += tensors[table.offsets][0][:, rows, columns].T
        half = np.maximum(tensors[table.sizes][0][:, rows, columns].T.astype(np.float64), 0.0) / 2.0
        if table.size_unit == "cells":
            half = half * self._cell_px
        centre = centre * self._cell_px
        return candidates_in_image(np.hstack([centre - half, centre + half]), scores, self._wanted[planes], view)

    def merge(self, parts: Sequence[Candidates], views: Sequence[View]) -> Detections:
        """Merges the boxes of all views of one image."""
        return merge_views(parts, views, self._groups, self.table)
