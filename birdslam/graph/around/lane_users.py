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
    T_ego_world, covs, users = window.world.inverse(), window.each_vehicle[:, POSE, POSE], []
    for row, (node, estimate) in enumerate(zip(nodes, vehicles, strict=True)):
        T_ego_vehicle = T_ego_world @ estimate.T_world_vehicle
        by_size = node.size_bias_rel * np.array([T_ego_vehicle.x_m, T_ego_vehicle.y_m, 0.0])  # see marginals.py
        cov = covs[row] + np.outer(by_size, by_size)
        yaw_rad = estimate.T_world_vehicle.yaw_rad
        speed_mps = estimate.velocity_mps[0] * math.cos(yaw_rad) + estimate.velocity_mps[1] * math.sin(yaw_rad)
        size = estimate.length_m
        sigma_mps = math.sqrt(max(estimate.velocity_cov[0], estimate.velocity_cov[3], 0.0))
        users.append(UserInEgo(estimate.vehicle, T_ego_vehicle, cov, size, speed_mps, sigma_mps, estimate.standing))
    return [*users, *map(person_in_ego, people)]
