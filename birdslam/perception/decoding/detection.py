"""Detections in the image: YOLOX decoding, class-wise NMS, merging of tiles, and bodies from another network."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.perception.boxes3d import Boxes3d
from birdslam.perception.manifest import BoxSigma, DetectorTable, DrawnInside, Input, LowerEdge, ManifestMismatch, Yolox
from birdslam.perception.views import View

CUT_MARGIN_RATIO = 0.015  # of a tile's width: a box this close to a tile's inner edge is cut by it
MIN_COVERED_RATIO = 0.6  # of a cut box's area inside a whole box of the same object
MAX_CANDIDATES = 400  # of one run; bounds memory and time when a network fails
MIN_ROWS_IOU = 0.5  # of the rows of two halves of one object
MIN_BODY_IOU = 0.5  # of two networks' boxes of one object; the usual threshold of a match


@dataclass(frozen=True)
class EdgeSigma:
    """1-sigma of a box's left, right, upper and lower edge: a fraction of its side plus `px` of the image."""

    rel: tuple[float, float, float, float]
    px: float


@dataclass(frozen=True)
class Detections:
    """Boxes (N, 4) x1, y1, x2, y2 in pixels of the undistorted image, scores (N,) in [0, 1] descending, labels.

    `boxes3d` holds a body for each box if the network estimates bodies. `edge_sigma` is the uncertainty of the edges;
    None: unknown. `lower_edge` is that of `manifest.DetectorTable`. `track_ids` (N,) come from an external tracker,
    negative without a track; None: no external tracker.
    """

    boxes_px: Floats
    scores: Floats
    labels: tuple[str, ...]
    boxes3d: Boxes3d | None = None
    edge_sigma: EdgeSigma | None = None
    lower_edge: LowerEdge = "body"
    track_ids: Ints | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def only(self, labels: Collection[str]) -> Detections:
        """Those with one of the labels."""
        return self.take([i for i, label in enumerate(self.labels) if label in labels])

    def inside(self, width_px: int, height_px: int) -> Detections:
        """Clips boxes to the image and drops those that lie outside it."""
        box, size = self.boxes_px, np.array([width_px, height_px], np.float64)
        if not len(box) or ((box >= 0.0).all() and (box[:, 2:] <= size).all()):
            return self
        seen = (box[:, :2] < size).all(axis=1) & (box[:, 2:] > 0.0).all(axis=1)
        kept = self.take(np.flatnonzero(seen).tolist())
        return replace(kept, boxes_px=np.clip(kept.boxes_px, 0.0, np.tile(size, 2)))

    def take(self, keep: Sequence[int]) -> Detections:
        """Those with these indices."""
        bodies = None if self.boxes3d is None else self.boxes3d.take(keep)
        labels_kept = tuple(self.labels[i] for i in keep)
        ids = None if self.track_ids is None else self.track_ids[keep]
        return replace(
            self,
            boxes_px=self.boxes_px[keep],
            scores=self.scores[keep],
            labels=labels_kept,
            boxes3d=bodies,
            track_ids=ids,
        )


@dataclass(frozen=True)
class Candidates:
    """Boxes (N, 4) before NMS in image pixels, with scores (N,) and class ids (N,).

    `cut` (N, 2): whether the view's left, right edge cuts the box.
    """

    boxes_px: Floats
    scores: Floats
    classes: Ints
    cut: Bools


class YoloxDecoder:
    """Reads YOLOX outputs (see `manifest.Yolox`)."""

    def __init__(self, table: Yolox, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the output's shape contradicts the manifest."""
        self.table = table
        cells, strides = _grid(input.width_px, input.height_px, table.strides)
        shape = shapes[table.output]
        if len(shape) != 3 or shape[0] != 1:
            raise ManifestMismatch("detector.output", f"{table.output} of shape (1, cells, 5 + classes)", shape)
        if shape[1] != len(cells):
            stated = f"{list(table.strides)} over {input.width_px}x{input.height_px}, that is {len(cells)} cells"
            raise ManifestMismatch("detector.strides", stated, f"{shape[1]} cells in {table.output} {shape}")
        if shape[2] != 5 + table.classes:
            stated = f"{table.classes}, that is {5 + table.classes} channels"
            raise ManifestMismatch("detector.classes", stated, f"{shape[2]} channels in {table.output} {shape}")
        self._cells, self._strides = cells, strides
        self._groups = rival_groups(table.classes, table.labels, table.rivals)
        self._wanted = np.isin(np.arange(table.classes), list(table.labels))

    def read(self, tensors: Mapping[str, Floats32], view: View) -> Candidates:
        """The boxes of one run above the score threshold, clipped to the image."""
        raw = tensors[self.table.output][0]
        rows = np.flatnonzero(raw[:, 4] >= self.table.score_threshold)  # class scores are <= 1
        chosen = raw[rows].astype(np.float64)
        classes = np.argmax(chosen[:, 5:], axis=1)
        scores = chosen[:, 4] * chosen[np.arange(len(rows)), 5 + classes]
        good = (scores >= self.table.score_threshold) & self._wanted[classes]
        best = np.flatnonzero(good)[np.argsort(-scores[good], kind="stable")[:MAX_CANDIDATES]]
        rows, chosen, classes, scores = rows[best], chosen[best], classes[best], scores[best]
        with np.errstate(over="ignore"):
            half = np.exp(chosen[:, 2:4]) * self._strides[rows] / 2.0
        centre = (chosen[:, :2] + self._cells[rows]) * self._strides[rows]
        return candidates_in_image(np.hstack([centre - half, centre + half]), scores, classes, view)

    def merge(self, parts: Sequence[Candidates], views: Sequence[View]) -> Detections:
        """Merges the boxes of all views of one image."""
        return merge_views(parts, views, self._groups, self.table)


def edge_sigma(table: BoxSigma | None, view: View) -> EdgeSigma | None:
    """Converts the manifest's sigmas of box edges to pixels of the image."""
    if table is None:
        return None
    left, right, upper, lower = (
        table.rel if own is None else own for own in (table.left, table.right, table.upper, table.lower)
    )
    return EdgeSigma((left, right, upper, lower), table.px / float(view.ratio.min()))


def move_edges_outward(boxes_px: Floats, inside: DrawnInside, view: View) -> Floats:
    """Moves the edges of boxes (N, 4) of the image out to the object's outline; edges at the border stay."""
    width, height = (boxes_px[:, 2:] - boxes_px[:, :2]).T
    moves = [-inside.left * width, -inside.upper * height, inside.right * width, inside.lower * height]
    limits = np.array([view.image_width_px, view.image_height_px] * 2, dtype=np.float64)
    at_border = (boxes_px <= 0.0) | (boxes_px >= limits)
    out: Floats = np.where(at_border, boxes_px, np.clip(boxes_px + np.column_stack(moves), 0.0, limits))
    return out


def rival_groups(classes: int, labels: Mapping[int, str], rivals: Sequence[Sequence[str]]) -> Ints:
    """Group numbers (classes,): classes that compete in NMS share a number."""
    group_of = {label: i for i, group in enumerate(rivals) for label in group}
    groups = np.arange(classes) + len(rivals)
    for index, label in labels.items():
        groups[index] = group_of.get(label, groups[index])
    return groups


def candidates_in_image(boxes_px: Floats, scores: Floats, classes: Ints, view: View) -> Candidates:
    """Boxes (N, 4) of the network's input, transformed to the image and clipped to the view, without slivers."""
    boxes = view.to_image(boxes_px)
    margin_px = CUT_MARGIN_RATIO * (view.x1_px - view.x0_px)
    cut = np.column_stack(
        [
            (boxes[:, 0] < view.x0_px + margin_px) & (view.x0_px > 0),
            (boxes[:, 2] > view.x1_px - margin_px) & (view.x1_px < view.image_width_px),
        ]
    )
    boxes[:, 0::2] = np.clip(boxes[:, 0::2], view.x0_px, view.x1_px)
    boxes[:, 1::2] = np.clip(boxes[:, 1::2], 0.0, view.image_height_px)
    solid = np.all(boxes[:, 2:] - boxes[:, :2] >= 1.0, axis=1)
    return Candidates(boxes[solid], scores[solid], classes[solid], cut[solid])


def merge_views(parts: Sequence[Candidates], views: Sequence[View], groups: Ints, table: DetectorTable) -> Detections:
    """Merges the boxes of all views of one image; `groups` (classes,) comes from `rival_groups`."""
    boxes, scores, classes, cut = (
        np.concatenate([getattr(part, field) for part in parts]) for field in ("boxes_px", "scores", "classes", "cut")
    )
    kept = suppress(boxes, scores, groups[classes], cut, table.nms_iou)
    boxes, scores, classes, cut = boxes[kept], scores[kept], classes[kept], cut[kept]
    slack_px = 2.0 * CUT_MARGIN_RATIO * (views[0].x1_px - views[0].x0_px)
    boxes, alive = join_halves(boxes, groups[classes], cut, slack_px)
    order = alive[np.argsort(-scores[alive], kind="stable")]
    labels = tuple(table.labels[int(c)] for c in classes[order])
    outlines = move_edges_outward(boxes[order], table.drawn_inside, views[0])
    sigma = edge_sigma(table.box_sigma, views[0])
    return Detections(outlines, scores[order], labels, edge_sigma=sigma, lower_edge=table.lower_edge)


def _grid(width_px: int, height_px: int, strides: Sequence[int]) -> tuple[Floats, Floats]:
    """Cells (N, 2) as x, y and their strides (N, 1), row by row, one stride after another."""
    cells, sizes = [], []
    for stride in strides:
        y, x = np.mgrid[0 : height_px // stride, 0 : width_px // stride]
        cells.append(np.column_stack([x.ravel(), y.ravel()]))
        sizes.append(np.full((x.size, 1), stride))
    return np.vstack(cells).astype(np.float64), np.vstack(sizes).astype(np.float64)


def intersections(boxes: Floats) -> Floats:
    """Areas (N, N) of the intersections of the boxes (N, 4)."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    out: Floats = np.prod(np.clip(high - low, 0.0, None), axis=-1)
    return out


def suppress(boxes: Floats, scores: Floats, groups: Ints, cut: Bools, nms_iou: float) -> Ints:
    """Indices that survive NMS within each group, best first: whole boxes before cut ones, then by score (stable).

    A cut box (N, 2: on its left, on its right) yields to one that covers it, since the IoU of a part is not
    informative. Two halves of one object do not suppress each other: `join_halves` joins them.
    """
    shared = intersections(boxes)
    area = np.diagonal(shared)
    partial = cut[:, 0] | cut[:, 1]
    halves = np.outer(cut[:, 0], cut[:, 1]) | np.outer(cut[:, 1], cut[:, 0])
    covers = (shared >= MIN_COVERED_RATIO * area[None, :]) & partial[None, :] & (area[:, None] > area[None, :])
    beaten = covers | (shared > nms_iou * (area[:, None] + area[None, :] - shared))  # [i, j]: i beats j
    beaten &= ~halves & (groups[:, None] == groups[None, :]) & ~np.eye(len(boxes), dtype=bool)
    alive = np.ones(len(boxes), dtype=bool)
    order = np.lexsort((-scores, partial))
    for i in order:
        if alive[i]:
            alive &= ~beaten[i]
    return order[alive[order]]


def join_halves(boxes: Floats, groups: Ints, cut: Bools, slack_px: float) -> tuple[Floats, Ints]:
    """Joins the two halves of an object that is wider than the overlap of two neighbouring tiles.

    Both halves span the overlap to within `slack_px`. Returns the boxes and the indices of those kept.
    """
    boxes = boxes.copy()
    stands = np.ones(len(boxes), dtype=bool)
    rightward = np.argsort(boxes[:, 0], kind="stable")
    for i in rightward[cut[rightward, 1]]:
        for j in rightward[cut[rightward, 0]]:
            a, b = boxes[i], boxes[j]
            rows = min(a[3], b[3]) - max(a[1], b[1])
            same_rows = rows > MIN_ROWS_IOU * (max(a[3], b[3]) - min(a[1], b[1]))
            meet = a[0] - slack_px <= b[0] <= a[2] <= b[2] + slack_px
            if i != j and stands[i] and stands[j] and groups[i] == groups[j] and same_rows and meet:
                boxes[i] = np.concatenate([np.minimum(a[:2], b[:2]), np.maximum(a[2:], b[2:])])
                stands[j] = False
    return boxes, np.flatnonzero(stands)


def with_bodies(detections: Detections, others: Detections | None) -> Detections:
    """The detections (N) with the bodies of the boxes of `others`, in the same image, that overlap them most.

    A box without such an overlap gets an unknown body, with infinite sigmas. Detections that already have bodies are
    returned unchanged.
    """
    if others is None or others.boxes3d is None or detections.boxes3d is not None:
        return detections
    n, bodies = len(detections), others.boxes3d
    if not n or not len(bodies):
        return detections
    shared = intersections(np.concatenate([detections.boxes_px, others.boxes_px]))
    area = np.diagonal(shared)
    both = shared[:n, n:]
    overlap = both / np.maximum(area[:n, None] + area[None, n:] - both, 1e-9)
    best = overlap.argmax(axis=1)
    return replace(detections, boxes3d=_unknown_unless(bodies.take(best), overlap[np.arange(n), best] >= MIN_BODY_IOU))


def _unknown_unless(bodies: Boxes3d, known: Bools) -> Boxes3d:
    return replace(
        bodies,
        sigma_depth_m=np.where(known, bodies.sigma_depth_m, np.inf),
        sigma_size_m=np.where(known[:, None], bodies.sigma_size_m, np.inf),
        sigma_alpha_rad=np.where(known, bodies.sigma_alpha_rad, np.inf),
        flip=np.where(known, bodies.flip, 0.5),
    )
