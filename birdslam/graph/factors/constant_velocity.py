"""Constant-velocity factor between successive poses of a vehicle; it replaces the VV edges of Eq. 6.

The twist (velocity in the vehicle's frame) follows a random walk. `Window.propagate` moves poses and covariances by it.
"""

from __future__ import annotations

from birdslam.graph.costs import Triple
from birdslam.graph.factors.factor import Factor, GraphFrame
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import Window


def twist_growth(config: GraphConfig) -> Triple:
    """Growth (3,) of the variances of a twist (x_mps, y_mps, yaw_radps) per second."""
    return config.change_forward_mps**2, config.change_sideways_mps**2, config.change_turn_radps**2


class ConstantVelocity(Factor):
    """Sets the process noise of the twists; precedes the odometry, which propagates the vehicles."""

    name = "constant velocity"
    equation = "in place of Eq. 6's VV edges"

    def __init__(self, config: GraphConfig) -> None:
        self._growth = twist_growth(config)

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Sets the growth of the twists' variances for this frame."""
        frame.twist_growth = self._growth
