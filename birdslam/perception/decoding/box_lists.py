"""Decoders of box lists: SSD's shifted priors, and boxes that the network decodes itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from birdslam.geometry.arrays import Floats, Floats32, Ints
from birdslam.perception.decoding.detection import (
    MAX_CANDIDATES,
    Candidates,
    Detections,
    candidates_in_image,
    merge_views,
    rival_groups,
)
from birdslam.perception.manifest import BoxList, Input, ManifestMismatch, Scoring, Ssd
from birdslam.perception.views import View

MAX_LOG = 20.0  # of a size relative to its prior, and of a logit: avoids overflow


class _ListDecoder:
    """Selects candidates from boxes (N, 4) and scores (N, classes): each class above the threshold is one."""

    def __init__(self, table: Ssd | BoxList, input: Input) -> None:
        self._detector = table
        self._input_px = np.array([input.width_px, input.height_px], dtype=np.float64)
        self._groups = rival_groups(table.classes, table.labels, table.rivals)
        self._wanted = np.array(sorted(table.labels))

    def chosen(self, numbers: Floats32, scoring: Scoring) -> tuple[Ints, Ints, Floats]:
        """Rows, classes and scores of the best candidates; `numbers` (N, classes)."""
        scores = _scores(numbers, scoring)[:, self._wanted]
        rows, columns = np.nonzero(scores >= self._detector.score_threshold)
        found = scores[rows, columns]
        best = np.argsort(-found, kind="stable")[:MAX_CANDIDATES]
        return rows[best], self._wanted[columns[best]], found[best]

    def merge(self, parts: Sequence[Candidates], views: Sequence[View]) -> Detections:
        """Merges the boxes of all views of one image."""
        return merge_views(parts, views, self._groups, self._detector)


class SsdDecoder(_ListDecoder):
    """Reads SSD outputs (see `manifest.Ssd`)."""

    def __init__(self, table: Ssd, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the outputs' shapes contradict the manifest."""
        super().__init__(table, input)
        self.table = table
        priors = shapes[table.priors]
        if len(priors) != 2 or priors[1] != 4:
            raise ManifestMismatch("detector.priors", f"{table.priors} of shape (N, 4)", priors)
        for key, output, channels in (("locations", table.locations, 4), ("scores", table.scores, table.classes)):
            if shapes[output] != (1, priors[0], channels):
                raise ManifestMismatch(
                    f"detector.{key}", f"{output} of shape {(1, priors[0], channels)}", shapes[output]
                )

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Candidates:
        """The boxes of one run above the score threshold, clipped to the image."""
        rows, classes, scores = self.chosen(tensors[self.table.scores][0], self.table.scoring)
        priors = tensors[self.table.priors][rows].astype(np.float64)
        shifts = tensors[self.table.locations][0, rows] * np.array(self.table.variances)
        size = priors[:, 2:] - priors[:, :2]
        centre = (priors[:, :2] + priors[:, 2:]) / 2.0 + shifts[:, :2] * size
        half = size * np.exp(np.clip(shifts[:, 2:], -MAX_LOG, MAX_LOG)) / 2.0
        boxes = np.hstack([centre - half, centre + half]) * np.tile(self._input_px, 2)
        return candidates_in_image(boxes, scores, classes, view)


class BoxListDecoder(_ListDecoder):
    """Reads decoded boxes with a score for each class (see `manifest.BoxList`)."""

    def __init__(self, table: BoxList, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the outputs' shapes contradict the manifest."""
        super().__init__(table, input)
        self.table = table
        wanted = {table.boxes: 4, table.scores: table.classes} if table.scores else {table.boxes: 4 + table.classes}
        counts = set()
        for output, channels in wanted.items():
            shape = shapes[output]
            axis = 2 if table.layout == "boxes" else 1
            if len(shape) != 3 or shape[0] != 1 or shape[axis] != channels:
                stated = f"(1, N, {channels})" if axis == 2 else f"(1, {channels}, N)"
                raise ManifestMismatch(
                    "detector.boxes" if output == table.boxes else "detector.scores", f"{output} {stated}", shape
                )
            counts.add(shape[3 - axis])
        if len(counts) != 1:
            raise ManifestMismatch("detector.scores", f"as many as {table.boxes} has boxes", shapes[table.scores])

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Candidates:
        """The boxes of one run above the score threshold, clipped to the image."""
        table = self.table
        boxes = self._rows(tensors[table.boxes])
        numbers = self._rows(tensors[table.scores]) if table.scores else boxes[:, 4:]
        rows, classes, scores = self.chosen(numbers, table.scoring)
        found = boxes[rows, :4].astype(np.float64)
        if table.form == "centre_size":
            half = np.maximum(found[:, 2:], 0.0) / 2.0
            found = np.hstack([found[:, :2] - half, found[:, :2] + half])
        if table.unit == "fractions":
            found = found * np.tile(self._input_px, 2)
        return candidates_in_image(found, scores, classes, view)

    def _rows(self, tensor: Floats32) -> Floats32:
        return tensor[0] if self.table.layout == "boxes" else tensor[0].T


def _scores(numbers: Floats32, scoring: Scoring) -> Floats:
    values = numbers.astype(np.float64)
    if scoring == "sigmoid":
        return 1.0 / (1.0 + np.exp(-np.clip(values, -MAX_LOG, MAX_LOG)))
    if scoring == "softmax":
        powers = np.exp(values - values.max(axis=1, keepdims=True))
        out: Floats = powers / powers.sum(axis=1, keepdims=True)
        return out
    return values
