"""What one network found in one image."""

from __future__ import annotations

from dataclasses import dataclass

from birdslam.perception.decoding.depth import DepthMap
from birdslam.perception.decoding.detection import Detections
from birdslam.perception.decoding.segmentation import Segmentation


@dataclass(frozen=True)
class Findings:
    """Detections, masks and depth of one image; None where the network does not look for them."""

    detections: Detections | None = None
    segmentation: Segmentation | None = None
    depth: DepthMap | None = None
