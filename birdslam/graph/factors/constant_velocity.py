"""Constant-velocity factor between successive poses of a vehicle; it replaces the VV edges of Eq. 6.

The twist (velocity in the vehicle's frame) follows a random walk. `Window.propagate` moves poses and covariances by it.
"""

from __future__ import annotations

import numpy as np

from birdslam.graph.costs import Triple
from birdslam.graph.factors.factor import Factor, GraphFrame
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import Window
from birdslam.types import Moves


def twist_growth(config: GraphConfig) -> Triple:
    """Growth (3,) of the variances of a twist (x_mps, y_mps, yaw_radps) per second."""
    return config.change_forward_mps**2, config.change_sideways_mps**2, config.change_turn_radps**2


class ConstantVelocity(Factor):
    """Sets the process noise of the twists, none for stationary vehicles; precedes the odometry, which propagates them.

    A vehicle that was decided to be stationary has a fixed position in world, so its covariance only shrinks. Its twist
    is that of a vehicle that may start, and moves it again after the decision is revoked.
    """

    name = "constant velocity"
    equation = "in place of Eq. 6's VV edges"

    def __init__(self, config: GraphConfig) -> None:
        self._growth = twist_growth(config)

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Sets the growth of the twists' variances for this frame, and the rows of stationary vehicles."""
        frame.twist_growth, nodes = self._growth, frame.vehicles.nodes
        fixed = [row for row, v in enumerate(nodes) if v.moves is Moves.STANDING and not v.in_path]
        if started := [row for row in fixed if not nodes[row].is_fixed]:
            still = np.zeros(len(started))
            window.set_twists(started, still, still, np.tile(np.diag(self._growth), (len(started), 1, 1)))
        for row, v in enumerate(nodes):
            v.is_fixed = row in fixed
        frame.fixed = fixed
