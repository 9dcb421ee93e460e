"""The paper's own choices (Sec. 3), as one configuration of the method: what `method = "paper"` stands for.

The rows of the tables that are called *as published* and `--set method=paper` use it too.
Where the paper states no number, the default stands.
"""

from __future__ import annotations

from birdslam.frontend import FrontEndConfig
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import PAPER_WEIGHTS
from birdslam.odometry.odometry import OdometryConfig
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.slam import SlamConfig
from birdslam.vehicles.placement.depth_fusion import PseudoLidarConfig
from birdslam.vehicles.placement.localisation import LocalisationConfig
from birdslam.vehicles.state.ground_size_config import GroundSizeConfig

NO_GATE = 1e6  # sigmas: nothing is an outlier

PAPER = SlamConfig(
    frontend=FrontEndConfig(
        odometry=OdometryConfig(
            road=RoadScaleConfig(mode="paper")
        ),  # Sec. 3.1: flat earth, a moving median of the scale
        # Sec. 3.1.3: depth within 20 m, farther Eq. 1 on the bottom edge of the box, on level ground as calibrated
        pseudolidar=PseudoLidarConfig(rule="paper"),
        localisation=LocalisationConfig(
            reach_rel=0.0,  # Eq. 1 gives the point of the road under the bottom edge, not the car's centre
            overhang_rel=0.0,  # ... and wherever that edge ends: at the tyres or under the body
        ),
        ground_size=GroundSizeConfig(
            cues=("bottom",),  # the box's height and width say nothing
            sigma_pitch_rad=1e-6,  # the camera is held to stand as it was calibrated
            pitch_memory_s=1e-3,
            sigma_pitch_step_rad=1e-6,
            sigma_pitch_blind_rad=1e-6,
            sigma_roll_rad=1e-6,
            sigma_kerb_m=1e-3,
            sigma_common_edge_rel=0.0,
            sigma_edge_rel=0.0,
            sigma_tilt_rad=1e-6,
            sigma_crown_rad=0.0,
            sigma_common_crown_rad=0.0,
        ),
    ),
    weights=PAPER_WEIGHTS,
    # Eqs. 5-8: CC, CP, CV and VV edges and nothing else
    graph=GraphConfig(
        constant_velocity=False,
        detection_gate_sigma=NO_GATE,
        landmark_gate_sigma=NO_GATE,
        landmark_anchor="first_sight",  # X_p of Eq. 3 is a point of the world, and known
        correlation_length_m=0.0,  # no error but those of the edges
        zero_velocity_update=False,
        vehicles_move_ego=True,  # all edges of Eq. 8 at once
        lasting_share=0.0,  # each edge is independent of all others
        front_back_ambiguity=False,  # a measured yaw counts as it is
    ),
)
