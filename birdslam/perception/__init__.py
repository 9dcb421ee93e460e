"""Perception: networks by manifest, their schedule, and what they find in an image."""

from birdslam.perception.detection import Detections
from birdslam.perception.manifest import Label, ModelError, shipped_manifests
from birdslam.perception.network import Findings, ModelSpec, Network, load_network
from birdslam.perception.schedule import Networks, Pending, Perception, Ready
from birdslam.perception.segmentation import Segmentation

__all__ = [
    "Detections",
    "Findings",
    "Label",
    "ModelError",
    "ModelSpec",
    "Network",
    "Networks",
    "Pending",
    "Perception",
    "Ready",
    "Segmentation",
    "load_network",
    "shipped_manifests",
]
