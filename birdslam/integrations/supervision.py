"""`supervision.Detections` in, and our metres as columns of its `.data`.

Results of ultralytics, transformers and others come through it (`supervision.Detections.from_ultralytics`).
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
from birdslam.vehicles.placed_boxes import PlacedBox

CLASS_NAME = "class_name"  # supervision's own column


class SupervisionDetections(Protocol):
    """What is read of `supervision.Detections`: N boxes."""

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
    """For `BirdSLAM.step`, in the same order; a tracker's ids are kept.

    Classes are named by the column `class_name`, or by `names` (class_id -> name). `distorted` and `detector` are as of
    `external_detections`. Raises ValueError where no class has a name, and for numbers that are none.
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
    """Puts what `BirdSLAM.step` says of the same boxes into columns of `detections.data`, one number a box.

    `x_m`, `y_m` (ahead, left), `distance_m`, `distance_sigma_m`, `speed_mps` and `speed_sigma_mps`: NaN where unknown;
    `track`: -1 where there is none. Raises ValueError for other boxes than these.
    """
    if len(placed) != len(detections.xyxy):
        raise ValueError(f"supervision: {len(placed)} places for {len(detections.xyxy)} boxes")
    detections.data |= {name: np.array(column) for name, column in columns(placed).items()}


def columns(placed: Sequence[PlacedBox | None]) -> dict[str, list[float] | list[int]]:
    """Name of a column -> one number for each box."""

    def of(name: str) -> list[float]:
        values = [None if box is None else getattr(box, name) for box in placed]
        return [math.nan if value is None else value for value in values]

    names = ("x_m", "y_m", "distance_m", "distance_sigma_m", "speed_mps", "speed_sigma_mps")
    track = [-1 if box is None or box.track is None else box.track for box in placed]
    return {**{name: of(name) for name in names}, "track": track}
