"""Detections of an external detector or tracker, in place of a network's."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.perception.decoding.detection import Detections, EdgeSigma
from birdslam.perception.families import Family, sigma_of
from birdslam.perception.manifest import LowerEdge


def external_detections(
    boxes_px: ArrayLike,
    labels: tuple[str, ...] | list[str],
    scores: ArrayLike | None = None,
    track_ids: ArrayLike | None = None,
    *,
    distorted: Camera | None = None,
    detector: Family | EdgeSigma = "unknown",
    lower_edge: LowerEdge = "body",
) -> Detections:
    """Boxes (N, 4) x1, y1, x2, y2 in px with a label each, for `BirdSLAM.step`, in the given order.

    `scores` (N,) in [0, 1] default to 1. `track_ids` (N,) come from an external tracker and are kept; a negative id
    means no track. `distorted` is the camera whose raw images the boxes refer to; None: undistorted images. `detector`
    is its family, which gives the sigmas of the edges (families.py), or measured sigmas. Raises ValueError for invalid
    numbers and for an unknown family.
    """
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4) if np.size(boxes_px) else np.zeros((0, 4))
    count = len(boxes)
    sure = np.ones(count) if scores is None else np.asarray(scores, np.float64).reshape(-1)
    ids = None if track_ids is None else np.asarray(track_ids).reshape(-1)
    for name, found in (
        ("labels", len(labels)),
        ("scores", len(sure)),
        ("track_ids", count if ids is None else len(ids)),
    ):
        if found != count:
            raise ValueError(f"{name}: {found} for {count} boxes")
    if not (np.isfinite(boxes).all() and (boxes[:, :2] <= boxes[:, 2:]).all()):
        raise ValueError("boxes must be finite, with x1 <= x2 and y1 <= y2")
    if not ((sure >= 0.0) & (sure <= 1.0)).all():
        raise ValueError("scores must be in [0, 1]")
    if ids is not None:
        known = ids[ids >= 0]
        if not np.issubdtype(ids.dtype, np.integer) or len(np.unique(known)) < len(known):
            raise ValueError("track_ids must be integers, unique in an image")
        ids = ids.astype(np.int64)
    if distorted is not None:
        boxes = undistort_boxes(distorted, boxes)
    edge_sigma = detector if isinstance(detector, EdgeSigma) else sigma_of(detector)
    return Detections(boxes, sure, tuple(labels), None, edge_sigma, lower_edge, ids)


def undistort_boxes(camera: Camera, boxes_px: Floats) -> Floats:
    """Undistorts boxes (N, 4) of the camera's raw images, by the midpoints of their sides."""
    if not (camera.distortion and len(boxes_px)):
        return boxes_px
    x1, y1, x2, y2 = boxes_px.T
    x, y = (x1 + x2) / 2.0, (y1 + y2) / 2.0
    middles = np.stack([np.column_stack(side) for side in ((x1, y), (x, y1), (x2, y), (x, y2))], axis=1)
    undistort = cv2.fisheye.undistortPoints if camera.fisheye else cv2.undistortPoints
    K, lens = camera.K, np.array(camera.distortion)
    straight = undistort(middles.reshape(-1, 1, 2), K, lens, P=K).reshape(-1, 4, 2)
    return np.stack([straight[:, 0, 0], straight[:, 1, 1], straight[:, 2, 0], straight[:, 3, 1]], axis=1)
