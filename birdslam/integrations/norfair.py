"""Adapter for Norfair: reads `Detection` and `TrackedObject`, writes metric positions to their `.data`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.perception.decoding.detection import Detections, EdgeSigma
from birdslam.perception.external import external_detections
from birdslam.perception.families import Family
from birdslam.road_users.placed_boxes import PlacedBox

KEY = "birdslam"  # in a detection's data


def from_norfair(
    objects: Sequence[Any], distorted: Camera | None = None, detector: Family | EdgeSigma = "unknown"
) -> Detections:
    """Converts `norfair.Detection` (points (2, 2): two corners) or `norfair.TrackedObject`, whose ids are kept.

    The order is kept. `distorted` and `detector` are those of `external_detections`. Raises ValueError for points that
    are not a box.
    """
    boxes, scores, ids = [], [], []
    for each in objects:
        detection = getattr(each, "last_detection", each)
        points = np.asarray(detection.points, np.float64)
        if points.shape != (2, 2):
            raise ValueError(f"norfair: a box needs two corners (2, 2), got points {points.shape}")
        boxes.append(np.concatenate([points.min(axis=0), points.max(axis=0)]))
        scores.append(1.0 if detection.scores is None else float(np.mean(detection.scores)))
        number = getattr(each, "id", None)
        ids.append(-1 if number is None else int(number))
    labels = [str(each.label) for each in objects]
    known = ids if any(i >= 0 for i in ids) else None
    return external_detections(boxes, labels, scores, known, distorted=distorted, detector=detector)


def add_metres(objects: Sequence[Any], placed: Sequence[PlacedBox | None]) -> None:
    """Writes the `PlacedBox` of each object, or None, to `data["birdslam"]` of its detection.

    Raises ValueError if the counts differ or the data is not a dict.
    """
    if len(placed) != len(objects):
        raise ValueError(f"norfair: {len(placed)} positions for {len(objects)} boxes")
    for each, place in zip(objects, placed, strict=True):
        detection = getattr(each, "last_detection", each)
        if detection.data is None:
            detection.data = {}
        if not isinstance(detection.data, dict):
            raise ValueError(f"norfair: data is a {type(detection.data).__name__}; it must be a dict")
        detection.data[KEY] = place
