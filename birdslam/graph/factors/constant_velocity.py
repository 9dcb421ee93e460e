"""Constant velocity, which ties each vehicle's newest pose to the one before: ours, in the place of Eq. 6's VV edges.

A vehicle drives on with its twist (velocity in its own frame), whose variances grow with time: it changes little from
one interval to the next. The window moves poses and covariances by it (`Window.propagate`).
"""

from __future__ import annotations

from birdslam.graph.costs import Triple
from birdslam.graph.factors.factor import Factor, GraphFrame
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import Window


def twist_growth(config: GraphConfig) -> Triple:
    """(3,) by how much the variances of a twist (x_mps, y_mps, yaw_radps) grow in a second."""
    return config.change_forward_mps**2, config.change_sideways_mps**2, config.change_turn_radps**2


class ConstantVelocity(Factor):
    """Stands before the odometry in the list, which drives the vehicles on."""

    name = "constant velocity"
    equation = "in place of Eq. 6's VV edges"

    def __init__(self, config: GraphConfig) -> None:
        self._growth = twist_growth(config)

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """How uncertain the twists become by this frame."""
        frame.twist_growth = self._growth
