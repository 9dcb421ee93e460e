"""Monocular multibody SLAM in bird's-eye view: the public API (docs/planner.md).

    slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
    for frame in recording.undistorted_frames():  # open_recording("video:drive.mp4", load_camera(Path("camera.toml")))
        measurements, estimate = slam.step(frame)

Names are loaded on first use: BLAS reads its number of threads from the environment when numpy is imported, and
`runtime/environment.py` must set it before.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same names, for editors and mypy; a test compares them with `_MODULES`
    from birdslam.frontend import FrontEnd as FrontEnd
    from birdslam.geometry.camera import Camera as Camera
    from birdslam.geometry.camera import Undistorter as Undistorter
    from birdslam.geometry.se2 import SE2 as SE2
    from birdslam.graph.pose_graph import PoseGraph as PoseGraph
    from birdslam.graph.weights import WeightsConfig as WeightsConfig
    from birdslam.outputs.drive_files import Recorder as Recorder
    from birdslam.perception.manifest import ModelError as ModelError
    from birdslam.perception.network import ModelSpec as ModelSpec
    from birdslam.perception.schedule import Networks as Networks
    from birdslam.perception.shipped import load_networks as load_networks
    from birdslam.perception.shipped import shipped_networks as shipped_networks
    from birdslam.slam import BirdSLAM as BirdSLAM
    from birdslam.slam import SlamConfig as SlamConfig
    from birdslam.sources.camera_file import load_camera as load_camera
    from birdslam.sources.opening import open_recording as open_recording
    from birdslam.sources.recording import DatasetError as DatasetError
    from birdslam.sources.recording import Recording as Recording
    from birdslam.types import Estimate as Estimate
    from birdslam.types import Frame as Frame
    from birdslam.types import MapUpdate as MapUpdate
    from birdslam.types import Measurements as Measurements
    from birdslam.types import SpeedReading as SpeedReading
    from birdslam.types import SpeedSource as SpeedSource
    from birdslam.types import Status as Status
    from birdslam.types import VehicleEstimate as VehicleEstimate

_MODULES = {
    "BirdSLAM": "birdslam.slam",
    "Camera": "birdslam.geometry.camera",
    "DatasetError": "birdslam.sources.recording",
    "Estimate": "birdslam.types",
    "Frame": "birdslam.types",
    "FrontEnd": "birdslam.frontend",
    "MapUpdate": "birdslam.types",
    "Measurements": "birdslam.types",
    "ModelError": "birdslam.perception.manifest",
    "ModelSpec": "birdslam.perception.network",
    "Networks": "birdslam.perception.schedule",
    "PoseGraph": "birdslam.graph.pose_graph",
    "Recorder": "birdslam.outputs.drive_files",
    "Recording": "birdslam.sources.recording",
    "SE2": "birdslam.geometry.se2",
    "SlamConfig": "birdslam.slam",
    "SpeedReading": "birdslam.types",
    "SpeedSource": "birdslam.types",
    "Status": "birdslam.types",
    "Undistorter": "birdslam.geometry.camera",
    "VehicleEstimate": "birdslam.types",
    "WeightsConfig": "birdslam.graph.weights",
    "load_camera": "birdslam.sources.camera_file",
    "load_networks": "birdslam.perception.shipped",
    "open_recording": "birdslam.sources.opening",
    "shipped_networks": "birdslam.perception.shipped",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Loads a public name on first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'birdslam' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
