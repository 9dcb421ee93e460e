"""Parameters of the back end, their defaults, and their consistency with the weights."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from birdslam.graph.weights import WeightsConfig

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
LandmarkAnchor = Literal["key_frame", "first_sight"]
Side = Literal["right", "left"]
Count = Annotated[int, msgspec.Meta(ge=1)]


class GraphConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the back end."""

    # Ego poses in the window beside the newest: the period of key frames, which landmarks connect
    ego_nodes: Annotated[int, msgspec.Meta(ge=1, le=64)] = 4
    # Vehicles
    constant_velocity: bool = True  # False: only VV edges tie the poses of a vehicle, as in Eq. 6
    change_forward_mps: Positive = 2.0  # 1-sigma of the change of a vehicle's velocity within a second
    change_sideways_mps: Positive = 0.5  # the same laterally
    change_turn_radps: Positive = 0.3  # the same of its yaw rate
    birth_forward_mps: Positive = 12.0  # 1-sigma of the velocity of a vehicle seen for the first time
    birth_sideways_mps: Positive = 2.0  # the same laterally
    birth_turn_radps: Positive = 0.5  # the same of its yaw rate
    forget_s: Positive = 1.0  # time that a vehicle out of sight is predicted
    max_vehicles: Count = 32  # those longest out of sight are dropped first
    detection_gate_sigma: Positive = 4.0  # Mahalanobis distance beyond which a detection weighs less; twice it: outlier
    detection_contradictions: Count = 5  # successive outliers that restart a vehicle
    # Whether observations of vehicles correct the ego. False: only odometry and landmarks do, since errors of vehicles
    # are correlated over time (size, yaw)
    vehicles_move_ego: bool = False
    # Share of a CV edge's covariance that is correlated with the previous edge; see lasting_error.py
    lasting_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.5
    lasting_s: Positive = 2.0  # correlation time, while driving
    front_back_ambiguity: bool = True  # the yaw of a CV edge may be reversed; False: it is used as measured
    drives_on: Side = "right"  # initial guess of the side of traffic; oncoming vehicles correct it
    # Static map
    landmark_gate_sigma: Positive = 3.0  # Mahalanobis distance beyond which a landmark weighs less
    # X_p of Eq. 3. key_frame: from the last key frame, with the uncertainty of its observation and pose; first_sight:
    # fixed in world at its first observation and then known exactly, as in the paper
    landmark_anchor: LandmarkAnchor = "key_frame"
    landmark_least_frames: Count = 2  # min. observations of a landmark before it is added to the map
    max_landmarks: Count = 512  # of a frame
    max_pending_landmarks: Count = 10_000  # waiting for `map_update`
    max_pending_frames: Count = 1_000  # whose lane points wait for `map_update`
    # Errors that successive CC edges share: they move all visible objects relative to the world's origin
    # Correlation length of the errors of metric scale, direction and turn; 0: uncorrelated
    correlation_length_m: NotNegative = 20.0
    # The correlated part of a camera's motion errors
    correlated_direction_rad: NotNegative = 0.005  # 1-sigma of the direction of travel
    correlated_turn_rel: NotNegative = 0.01  # 1-sigma of a turn, as a fraction
    zero_velocity_update: bool = True  # a stationary car keeps its pose; False: it follows its CC edges
    # Frames without an image
    blind_mps: Positive = 1.0  # 1-sigma of the ego's velocity around the last one measured
    blind_radps: Positive = 0.1  # the same for its yaw rate


def check_together(graph: GraphConfig, weights: WeightsConfig) -> None:
    """Raises ValueError if the weights need edges that the graph does not have."""
    if weights.cp_vehicles is not None and graph.landmark_anchor != "first_sight":
        raise ValueError('weights.cp_vehicles needs graph.landmark_anchor = "first_sight" (X_p in the world)')
