"""Adapter for supervision: reads `supervision.Detections`, writes metric positions to columns of its `.data`.

It also covers ultralytics, transformers and others (`supervision.Detections.from_ultralytics`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.perception.decoding.detection import Detections, EdgeSigma
from birdslam.perception.external import external_detections
from birdslam.perception.families import Family
from birdslam.road_users.placed_boxes import PlacedBox

CLASS_NAME = "class_name"  # supervision's own column


class SupervisionDetections(Protocol):
    """The fields of `supervision.Detections` that are read, for N boxes."""

    xyxy: Any  # (N, 4) px
    confidence: Any  # (N,) or None
    class_id: Any  # (N,) or None
    tracker_id: Any  # (N,) or None
    data: dict[str, Any]


def from_supervision(
    detections: SupervisionDetections,
    names: Mapping[int, str] | None = None,
    distorted: Camera | None = None,
    detector: Family | EdgeSigma = "unknown",
) -> Detections:
    """Converts detections for `BirdSLAM.step`, in the same order; a tracker's ids are kept.

    Class names come from the column `class_name` or from `names` (class_id -> name). `distorted` and `detector` are
    those of `external_detections`. Raises ValueError if class names are missing or numbers are invalid.
    """
    count = len(detections.xyxy)
    if CLASS_NAME in detections.data:
        labels = [str(name) for name in detections.data[CLASS_NAME]]
    elif names is not None and detections.class_id is not None:
        labels = [names.get(int(number), "unknown") for number in detections.class_id]
    elif count == 0:
        labels = []
    else:
        raise ValueError("supervision: boxes have no class_name; give names={class_id: name}")
    boxes, scores, ids = detections.xyxy, detections.confidence, detections.tracker_id
    return external_detections(boxes, labels, scores, ids, distorted=distorted, detector=detector)


def add_metres(detections: SupervisionDetections, placed: Sequence[PlacedBox | None]) -> None:
    """Writes the results of `BirdSLAM.step` for the same boxes to columns of `detections.data`, one number per box.

    `x_m`, `y_m` (ahead, left), `distance_m`, `distance_sigma_m`, `speed_mps` and `speed_sigma_mps` are NaN if unknown;
    `track` is -1 without a track. Raises ValueError if the counts differ.
    """
    if len(placed) != len(detections.xyxy):
        raise ValueError(f"supervision: {len(placed)} positions for {len(detections.xyxy)} boxes")
    detections.data |= {name: np.array(column) for name, column in columns(placed).items()}


def columns(placed: Sequence[PlacedBox | None]) -> dict[str, list[float] | list[int]]:
    """Name of a column -> one number for each box."""

    def of(name: str) -> list[float]:
        values = [None if box is None else getattr(box, name) for box in placed]
        return [math.nan if value is None else value for value in values]

    names = ("x_m", "y_m", "distance_m", "distance_sigma_m", "speed_mps", "speed_sigma_mps")
    track = [-1 if box is None or box.track is None else box.track for box in placed]
    return {**{name: of(name) for name in names}, "track": track}
