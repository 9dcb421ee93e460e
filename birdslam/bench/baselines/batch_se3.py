"""The paper's own batch baseline: a pose graph in SE(3) over odometry of unknown scale (Sec. 4, its Tables 1, 2, 5).

Kept: SE(3) nodes, one batch, CC, CV and VV edges with the paper's weights, odometry stripped of its scale, which the
CV edges bring to metres; CP edges of ego and vehicles (Eqs. 3 and 7), or none. Not kept: ORB-SLAM2's odometry,
vehicles by shape priors, points of amodal lanes; here all come from the log. Its VV edges are predictions in metres of
a tracker on metric odometry, so that they carry scale too. ORB's drift of scale is only in as far as the log's is.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from birdslam.bench.baselines.posegraph3 import BatchConfig, optimise_batch
from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.geometry.camera import Camera
from birdslam.graph.weights import PAPER_WEIGHTS
from birdslam.types import Measurements

CONFIG = BatchConfig(metric=False, landmarks=True, weights=PAPER_WEIGHTS)


def run(log: Sequence[Measurements], camera: Camera, lanes: bool = True) -> Trajectories:
    """Trajectories of the whole log at once; `lanes=False` is "before lane constraints" of Table 5."""
    return optimise_batch(log, CONFIG if lanes else replace(CONFIG, landmarks=False))
