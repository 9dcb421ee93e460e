"""Decoder of the multi-task network: boxes with 3-D bodies, masks, and a depth map.

Depths are canonical, z * (0.58 * width / fx), for a focal length of `CANONICAL_FOCAL_REL` times the image width, so one
network serves many cameras; `in_metres` converts them to the camera's focal length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats, Floats32, Ints
from birdslam.perception.boxes3d import Boxes3d
from birdslam.perception.decoding.depth import DepthMap
from birdslam.perception.decoding.detection import Detections, edge_sigma, move_edges_outward, suppress
from birdslam.perception.decoding.segmentation import Segmentation
from birdslam.perception.manifest import Input, Label, ManifestMismatch, MultiTask
from birdslam.perception.views import View

CANONICAL_FOCAL_REL = 0.58  # of the image's width
INPUT = "image"
OUTPUTS = ("segmentation", "depth", "heat", "body")
MASKS = ("road", "lane")  # channels of "segmentation": logits
CLASSES = ("vehicle", "person")  # channels of "heat": logits of "a box's centre is here"
KINDS: tuple[Label, ...] = ("car", "truck", "bus")  # of a vehicle
# Channels of "body", at a box's centre. Lengths on the image are in cells.
BODY_CHANNELS = {
    "sides": 4,  # log of the distances to the box's left, top, right, bottom
    "kind": 3,  # logits
    "offset": 2,  # from the cell to the projected centre of the body
    "log_depth": 1,  # of that centre, canonical
    "log_sigma": 1,  # of the Laplace scale of the log depth
    "log_size": 3,  # length, width, height against MEAN_SIZE_M
    "axis": 2,  # cos and sin of twice alpha, times von Mises' concentration
    "front": 2,  # cos and sin of alpha, times the logit of "this end is the front"
}
MEAN_SIZE_M = (4.3, 1.8, 1.6)
# Relative error of sizes on real cars (`perf networks`)
SIGMA_SIZE_REL = (0.20, 0.15, 0.08)
MAX_CANDIDATES = 100  # of one run
MAX_LOG_SIDE = 6.0  # 400 cells, longer than any input


@dataclass(frozen=True)
class Findings:
    """Detections, masks and depth of one image; None if the network does not output them."""

    detections: Detections | None = None
    segmentation: Segmentation | None = None
    depth: DepthMap | None = None


def body_slices() -> dict[str, slice]:
    """Channel range of each part of "body"."""
    out, at = {}, 0
    for name, channels in BODY_CHANNELS.items():
        out[name] = slice(at, at + channels)
        at += channels
    return out


_BODY = body_slices()


class MultiTaskDecoder:
    """Reads the four outputs (see `manifest.MultiTask`). Depths stay canonical: the camera is not known here."""

    def __init__(self, table: MultiTask, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if an output's shape contradicts the manifest."""
        self.table, self.input = table, input
        channels = (len(MASKS), 1, len(CLASSES), sum(BODY_CHANNELS.values()))
        for output, count in zip(OUTPUTS, channels, strict=True):
            if output not in shapes:  # not computed
                continue
            shape = shapes[output]
            if len(shape) != 4 or shape[:2] != (1, count):
                raise ManifestMismatch("multitask", f"{output} of shape (1, {count}, h, w)", shape)
        if shapes["heat"][2:] != shapes["body"][2:]:
            raise ManifestMismatch("multitask", "heat and body on one grid", f"{shapes['heat']} and {shapes['body']}")
        self._cell = np.array([input.width_px / shapes["heat"][3], input.height_px / shapes["heat"][2]])
        self._kernel = np.ones((3, 3), dtype=np.uint8)

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Findings:
        """The findings of one run over the whole image."""
        # The canonical focal length is relative to the input's width, which with padding differs from the image's
        focal_rel = CANONICAL_FOCAL_REL * self.input.width_px / float(view.width_px)
        return Findings(
            detections=self._detections(tensors["heat"][0], tensors["body"][0], view, focal_rel),
            segmentation=self._segmentation(tensors["segmentation"][0], view) if "segmentation" in tensors else None,
            depth=self._depth(tensors["depth"][0, 0], view, focal_rel) if "depth" in tensors else None,
        )

    def merge(self, parts: Sequence[Findings], views: Sequence[View]) -> Findings:
        """The multi-task network has one view."""
        (part,) = parts
        return part

    def _segmentation(self, logits: Floats32, view: View) -> Segmentation:
        """Resizes logits rather than masks, for a smooth border at the image's resolution."""
        size = (view.image_width_px, view.image_height_px)
        road, lane = (
            cv2.resize(view.crop(plane, self.input), size, interpolation=cv2.INTER_LINEAR) for plane in logits
        )
        return Segmentation(road=road > self.table.road_logit, lane=lane > self.table.lane_logit)

    def _depth(self, log_depth: Floats32, view: View, focal_rel: float) -> DepthMap:
        return DepthMap(
            np.exp(view.crop(log_depth, self.input)),
            view.image_width_px,
            view.image_height_px,
            sigma_rel=self.table.depth_sigma_rel,
            canonical_focal_rel=focal_rel,
        )

    def _detections(self, heat: Floats32, body: Floats32, view: View, focal_rel: float) -> Detections:
        """The peaks of the heat map with the body's channels, after NMS, best score first."""
        classes, ys, xs = self._peaks(heat)
        at = body[:, ys, xs].T.astype(np.float64)  # (N, channels)
        scores = 1.0 / (1.0 + np.exp(-heat[classes, ys, xs].astype(np.float64)))
        cells = np.column_stack([xs, ys]).astype(np.float64) + 0.5
        sides = np.exp(np.minimum(at[:, _BODY["sides"]], MAX_LOG_SIDE))
        corners = np.hstack([cells - sides[:, :2], cells + sides[:, 2:]]) * np.tile(self._cell, 2)
        boxes = view.to_image(corners)
        boxes[:, 0::2] = np.clip(boxes[:, 0::2], 0.0, view.image_width_px)
        boxes[:, 1::2] = np.clip(boxes[:, 1::2], 0.0, view.image_height_px)
        solid = np.flatnonzero(np.all(boxes[:, 2:] - boxes[:, :2] >= 1.0, axis=1))
        whole = np.zeros((len(solid), 2), dtype=bool)
        rows = solid[suppress(boxes[solid], scores[solid], classes[solid], whole, self.table.nms_iou)]
        kinds = np.argmax(at[rows, _BODY["kind"]], axis=1)
        labels = tuple(KINDS[k] if c == 0 else "person" for c, k in zip(classes[rows], kinds, strict=True))
        bodies = self._bodies(at[rows], cells[rows], view, focal_rel)
        outlines = move_edges_outward(boxes[rows], self.table.drawn_inside, view)
        sigma = edge_sigma(self.table.box_sigma, view)
        return Detections(outlines, scores[rows], labels, bodies, sigma, self.table.lower_edge)

    def _peaks(self, heat: Floats32) -> tuple[Ints, Ints, Ints]:
        """Class, row and column of the heat map's peaks, best first."""
        bar = math.log(self.table.score_threshold / (1.0 - self.table.score_threshold))
        peaks = [(plane >= cv2.dilate(plane, self._kernel)) & (plane > bar) for plane in heat]
        classes, ys, xs = np.nonzero(peaks)
        best = np.argsort(-heat[classes, ys, xs], kind="stable")[:MAX_CANDIDATES]
        return classes[best], ys[best], xs[best]

    def _bodies(self, at: Floats, cells: Floats, view: View, focal_rel: float) -> Boxes3d:
        """The bodies (N) by their channels `at` (N, channels), at the cells (N, 2)."""
        centres = np.tile((cells + at[:, _BODY["offset"]]) * self._cell, 2)
        depth_m = np.exp(at[:, _BODY["log_depth"]][:, 0])
        size_m = np.exp(at[:, _BODY["log_size"]]) * MEAN_SIZE_M
        axis, front = at[:, _BODY["axis"]], at[:, _BODY["front"]]
        alpha_rad = 0.5 * np.arctan2(axis[:, 1], axis[:, 0])  # modulo pi; `front` resolves the ambiguity
        logit = front[:, 0] * np.cos(alpha_rad) + front[:, 1] * np.sin(alpha_rad)
        alpha_rad = np.where(logit >= 0.0, alpha_rad, alpha_rad - np.copysign(np.pi, alpha_rad))
        concentration = np.maximum(np.hypot(axis[:, 0], axis[:, 1]), 0.5)
        return Boxes3d(
            centre_px=view.to_image(centres)[:, :2] - 0.5,  # from pixel edges to pixel centres
            depth_m=depth_m,
            size_m=size_m,
            alpha_rad=alpha_rad,
            # A Laplace distribution of scale b has the standard deviation sqrt(2) b
            sigma_depth_m=depth_m * math.sqrt(2.0) * np.exp(at[:, _BODY["log_sigma"]][:, 0]),
            sigma_size_m=size_m * SIGMA_SIZE_REL,
            sigma_alpha_rad=0.5 / np.sqrt(concentration),
            flip=1.0 / (1.0 + np.exp(np.abs(logit))),
            canonical_focal_rel=focal_rel,
        )
