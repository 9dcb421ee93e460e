"""Perception: networks described by manifests, their schedule, and their results."""

from birdslam.perception.boxes3d import Boxes3d
from birdslam.perception.decoding.depth import DepthMap
from birdslam.perception.decoding.detection import Detections
from birdslam.perception.decoding.multitask import Findings
from birdslam.perception.decoding.segmentation import Segmentation
from birdslam.perception.kept_findings import KeptFindings
from birdslam.perception.manifest import Label, ModelError
from birdslam.perception.manifest_file import shipped_manifests
from birdslam.perception.network import ModelSpec, Network, load_network
from birdslam.perception.schedule import ROLES, Networks, Pending, Perception, Ready
from birdslam.perception.shipped import load_networks, shipped_networks

__all__ = [
    "ROLES",
    "Boxes3d",
    "DepthMap",
    "Detections",
    "Findings",
    "KeptFindings",
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
    "load_networks",
    "shipped_manifests",
    "shipped_networks",
]
