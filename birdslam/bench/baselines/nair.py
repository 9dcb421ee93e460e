"""Nair et al., "Multi-object monocular SLAM for dynamic environments" (IV 2020): batch SE(3) with metric odometry.

Kept: one batch over SE(3) nodes of ego and vehicles; CC edges scaled to metres by the camera's height, CV and VV edges,
weights of their order (CC well above CV above VV).
Not kept: their vehicles come from shape priors fitted to keypoints, and their VV edges from these; here both come from
the log, i.e. from boxes.
"""

from __future__ import annotations

from collections.abc import Sequence

from birdslam.bench.baselines.posegraph3 import BatchConfig, optimise_batch
from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.geometry.camera import Camera
from birdslam.types import Measurements

CONFIG = BatchConfig(metric=True, landmarks=False)


def run(log: Sequence[Measurements], camera: Camera) -> Trajectories:
    """Trajectories of the whole log at once."""
    return optimise_batch(log, CONFIG)
