"""The back end's own numbers: what they are, their defaults, and what they ask of the weights."""

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
    """The back end's own numbers."""

    # Ego poses kept beside the newest. One frame in so many is a key frame: landmarks tie it to the key frame before
    ego_nodes: Annotated[int, msgspec.Meta(ge=1, le=64)] = 4
    # Vehicles
    constant_velocity: bool = True  # False: only VV edges tie the poses of a vehicle, as in Eq. 6
    change_forward_mps: Positive = 2.0  # 1-sigma by which a vehicle's velocity changes within a second
    change_sideways_mps: Positive = 0.5  # the same across
    change_turn_radps: Positive = 0.3  # and of its yaw rate
    birth_forward_mps: Positive = 12.0  # 1-sigma of the velocity of a vehicle seen for the first time
    birth_sideways_mps: Positive = 2.0  # the same across
    birth_turn_radps: Positive = 0.5  # and of its yaw rate
    forget_s: Positive = 1.0  # a vehicle out of sight is predicted on for so long
    max_vehicles: Count = 32  # the longest out of sight go first
    detection_gate_sigma: Positive = 4.0  # Mahalanobis distance past which a detection weighs less; twice it: nothing
    detection_contradictions: Count = 5  # so many left out in a row begin the vehicle again
    # Whether what is seen of vehicles corrects the ego, too. False: they are placed with all of the ego's uncertainty,
    # and leave it where odometry and landmarks put it. Their errors last (size, yaw), which no edge says
    vehicles_move_ego: bool = False
    # Of a CV edge's covariance, by how much its error is that of the edge before; lasting_error.py. By the errors of
    # 16 sequences of KITTI tracking with RRC's boxes, the median over tracks: after 0.1 s 0.49 of it along the line of
    # sight and 0.52 across, after 2 s 0.21 and 0.11
    lasting_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.5
    lasting_s: Positive = 2.0  # for so long, of driving
    front_back_ambiguity: bool = True  # a CV edge may take a vehicle's front for its back; False: its yaw is believed
    drives_on: Side = "right"  # the side of the road that traffic keeps to; those who come towards the ego correct it
    # Static map
    landmark_gate_sigma: Positive = 3.0  # Mahalanobis distance past which a landmark weighs less
    # Where X_p of Eq. 3 is. key_frame: where the last key frame saw it, as uncertain as that sight and that pose;
    # first_sight: in the world, put there once by the frame that saw it first and known from then on, as in the paper
    landmark_anchor: LandmarkAnchor = "key_frame"
    landmark_least_frames: Count = 2  # frames with CP edges that a landmark was seen in, to be put on the map
    max_landmarks: Count = 512  # of a frame
    max_pending_landmarks: Count = 10_000  # waiting for `map_update`
    max_pending_frames: Count = 1_000  # whose lane points wait for `map_update`
    # What is common to many CC edges in a row, and so moves all that is in sight against the world's origin alone
    # The way over which the errors of the metric scale, direction and turn last; 0: they do not
    correlation_length_m: NotNegative = 20.0
    # The part of a camera's motion that lasts so: over 10 m the direction is off by 0.0033 to 0.0070 rad on KITTI 00,
    # 01, 06, 0005 and the shipped drive, and a turn by 0.8 % (01) and 1.8 % (00)
    correlated_direction_rad: NotNegative = 0.005  # 1-sigma of the direction of travel
    correlated_turn_rel: NotNegative = 0.01  # 1-sigma of a turn, as a fraction
    zero_velocity_update: bool = True  # a car that stands keeps its pose; False: it has the CC edge of one that drives
    # Frames without a picture
    blind_mps: Positive = 1.0  # 1-sigma by which the ego's velocity may differ from the last one measured
    blind_radps: Positive = 0.1  # the same of its yaw rate


def check_together(graph: GraphConfig, weights: WeightsConfig) -> None:
    """Raises ValueError where the weights ask for edges that the graph does not have."""
    if weights.cp_vehicles is not None and graph.landmark_anchor != "first_sight":
        raise ValueError('weights.cp_vehicles needs graph.landmark_anchor = "first_sight": X_p in the world')
