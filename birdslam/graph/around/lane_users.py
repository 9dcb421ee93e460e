"""The vehicles and people of a frame in ego, for their assignment to lanes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from birdslam.graph.state_layout import POSE
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.window import Window
from birdslam.lanes.users import UserInEgo, person_in_ego
from birdslam.types import FollowedPerson, VehicleEstimate


def lane_users(
    window: Window,
    nodes: Sequence[VehicleNode],
    vehicles: Sequence[VehicleEstimate],
    people: Sequence[FollowedPerson],
) -> list[UserInEgo]:
    """Returns all road users; `vehicles` are the estimates of `nodes`. The ego's error in world is not included."""
    T_ego_world, users = window.world.inverse(), []
    places = [T_ego_world @ estimate.T_world_vehicle for estimate in vehicles]
    sizes = [(node.size_bias_rel * T.x_m, node.size_bias_rel * T.y_m) for node, T in zip(nodes, places, strict=True)]
    by_size = np.array(sizes).reshape(-1, 2)  # see marginals.py
    covs = window.each_vehicle[:, POSE, POSE].copy()
    covs[:, :2, :2] += by_size[:, :, None] * by_size[:, None]
    for estimate, T_ego_vehicle, cov in zip(vehicles, places, covs, strict=True):
        yaw_rad = estimate.T_world_vehicle.yaw_rad
        speed_mps = estimate.velocity_mps[0] * math.cos(yaw_rad) + estimate.velocity_mps[1] * math.sin(yaw_rad)
        size = estimate.length_m
        sigma_mps = math.sqrt(max(estimate.velocity_cov[0], estimate.velocity_cov[3], 0.0))
        users.append(UserInEgo(estimate.vehicle, T_ego_vehicle, cov, size, speed_mps, sigma_mps, estimate.standing))
    return [*users, *map(person_in_ego, people)]
