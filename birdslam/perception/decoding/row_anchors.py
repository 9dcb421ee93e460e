"""Decoder of lane lines by rows: a distribution over columns for each line and row (Ultra-Fast-Lane-Detection)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.perception.decoding.segmentation import Segmentation
from birdslam.perception.manifest import Input, ManifestMismatch, RowAnchors
from birdslam.perception.views import View

MIN_POINTS = 2  # of a line
LINE_WIDTH_REL = 0.006  # of a drawn line, in image widths: a painted line about 15 m ahead


class RowAnchorsDecoder:
    """Reads columns by rows (see `manifest.RowAnchors`)."""

    def __init__(self, table: RowAnchors, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the output's shape contradicts the manifest."""
        self.table, self.input = table, input
        stated = (1, table.columns + 1, len(table.rows), table.lines)
        if tuple(shapes[table.output]) != stated:
            raise ManifestMismatch("segmenter.output", f"{table.output} of shape {stated}", shapes[table.output])

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Segmentation:
        """The lines of one run, drawn into the lane mask; the road mask is empty."""
        lane = np.zeros((view.image_height_px, view.image_width_px), np.uint8)
        width_px = max(1, round(LINE_WIDTH_REL * view.image_width_px))
        for points in self.points_px(tensors[self.table.output][0], view):
            cv2.polylines(lane, [np.round(points).astype(np.int32)], False, 1, width_px)
        return Segmentation(road=np.zeros(lane.shape, dtype=bool), lane=lane > 0)

    def merge(self, parts: Sequence[Segmentation], views: Sequence[View]) -> Segmentation:
        """A segmenter has one view."""
        (part,) = parts
        return part

    def points_px(self, logits: Floats32, view: View) -> list[Floats]:
        """Image points (N, 2) of each line found; `logits` (columns + 1, rows, lines).

        The column is the mean of the softmax over all columns but the last, which means that the line is absent.
        """
        columns = logits[:-1].astype(np.float64)
        share = np.exp(columns - columns.max(axis=0))
        at = (share * np.arange(len(columns))[:, None, None]).sum(axis=0) / share.sum(axis=0)
        there = logits.argmax(axis=0) < len(columns)
        x_px = (at / max(len(columns) - 1, 1)) * (self.input.width_px - 1) + 0.5
        y_px = np.array(self.table.rows) * self.input.height_px
        out = []
        for k in range(self.table.lines):
            rows = np.flatnonzero(there[:, k])
            if len(rows) >= MIN_POINTS:
                rows = rows[np.argsort(y_px[rows])]
                points = np.column_stack([x_px[rows, k], y_px[rows]])
                out.append(view.to_image(np.tile(points, 2))[:, :2] - 0.5)  # from pixel edges to pixel centres
        return out
