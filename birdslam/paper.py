"""The configuration of the paper (Sec. 3), selected by `method = "paper"`.

The rows of the tables that are called *as published* use it too. Numbers that the paper does not state are the
defaults.
"""

from __future__ import annotations

from birdslam.frontend import FrontEndConfig
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import PAPER_WEIGHTS
from birdslam.odometry.odometry import OdometryConfig
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import LocalisationConfig
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.slam import SlamConfig

NO_GATE = 1e6  # sigmas; accepts every edge

PAPER = SlamConfig(
    frontend=FrontEndConfig(
        odometry=OdometryConfig(
            road=RoadScaleConfig(mode="paper")
        ),  # Sec. 3.1: flat earth, a moving median of the scale
        # Sec. 3.1.3: depth network within 20 m, beyond it Eq. 1 on the lower edge of the box, on the calibrated plane
        pseudolidar=PseudoLidarConfig(rule="paper"),
        localisation=LocalisationConfig(
            reach_rel=0.0,  # Eq. 1 gives the road point under the lower edge, not the car's centre
            overhang_rel=0.0,  # regardless of whether the edge is at the tyres or under the body
        ),
        ground_size=GroundSizeConfig(
            cues=("bottom",),  # the box's height and width are not used
            sigma_pitch_rad=1e-6,  # the camera's calibrated pose is exact
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
    # Eqs. 5-8: only CC, CP, CV and VV edges
    graph=GraphConfig(
        constant_velocity=False,
        detection_gate_sigma=NO_GATE,
        landmark_gate_sigma=NO_GATE,
        landmark_anchor="first_sight",  # X_p of Eq. 3 is a known point in world
        correlation_length_m=0.0,  # only the errors of the edges
        zero_velocity_update=False,
        vehicles_move_ego=True,  # all edges of Eq. 8 at once
        lasting_share=0.0,  # edges are independent
        front_back_ambiguity=False,  # the measured yaw is used as is
    ),
)
