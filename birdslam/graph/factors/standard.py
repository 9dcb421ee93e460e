"""The default factors of the graph and their order, by weights and configuration."""

from __future__ import annotations

from birdslam.graph.factors.constant_velocity import ConstantVelocity
from birdslam.graph.factors.factor import Factor
from birdslam.graph.factors.landmark_points import LandmarkPoints
from birdslam.graph.factors.odometry import Odometry
from birdslam.graph.factors.vehicle_detection import LastingErrors, VehicleDetections
from birdslam.graph.factors.vehicle_landmarks import VehicleLandmarks
from birdslam.graph.factors.vehicle_motion import MeasuredTwist, VehicleMotion
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import WeightsConfig


def standard_factors(config: GraphConfig, weights: WeightsConfig) -> list[Factor]:
    """Eqs. 6 and 7, with a constant-velocity factor if `constant_velocity`. Append new factors."""
    odometry, detections, landmarks = Odometry(config), VehicleDetections(config), LandmarkPoints(config)
    factors: list[Factor]
    if config.constant_velocity:
        factors = [ConstantVelocity(config), odometry, detections, MeasuredTwist()]
    else:
        factors = [VehicleMotion(), odometry, detections]
    if config.lasting_share:
        factors.insert(1, LastingErrors(config))
    if weights.cp_vehicles is not None:
        factors.append(VehicleLandmarks(weights.cp_vehicles, landmarks))
    return [*factors, landmarks]
