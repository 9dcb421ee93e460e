"""VV edges: a vehicle's own motion since its newest pose in the window (Eqs. 2 and 6)."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.constant_twist import advance, rate
from birdslam.graph.costs import binary_residuals, rotated
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.state_layout import TWIST
from birdslam.graph.window import Window

OWN_TWIST = [*range(TWIST.start, TWIST.stop)]


class VehicleMotion(Factor):
    """VV edges as in Eq. 6, without constant velocity: the VV edge sets the vehicle's twist in an interval.

    Precedes the odometry in the list, which propagates the vehicles.
    """

    name = "VV"
    equation = "Eqs. 2 and 6"

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Sets the twists of the interval up to this frame."""
        edges = frame.associations.vv
        if edges.rows:
            velocity, turn_radps = rate(edges.at, edges.yaw_rad, edges.dt_s)  # Eq. 6: its VV edges
            covs = edges.covs / np.square(edges.dt_s)[:, None, None]
            window.set_twists(edges.rows, velocity, turn_radps, covs)


class MeasuredTwist(Factor):
    """VV edges beside constant velocity: measurements of the twist that it predicts."""

    name = "VV"
    equation = "Eqs. 2 and 6"
    of_vehicles = True

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Each edge measures its vehicle's twist (3 numbers)."""
        edges = frame.associations.vv
        if not edges.rows:
            return None
        ahead, measured = np.ones(len(edges.rows), np.complex128), np.exp(1j * edges.yaw_rad)
        velocity, turn_radps = window.velocity[edges.rows], window.turn_radps[edges.rows]
        way, heading, g, d = advance(ahead, velocity, turn_radps, edges.dt_s)
        J = np.zeros_like(edges.covs)  # of the displacement with respect to the twist
        J[:, 0, 0] = J[:, 1, 1] = g.real
        J[:, 0, 1], J[:, 1, 0] = -g.imag, g.imag
        J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = d.real, d.imag, edges.dt_s
        back = np.linalg.inv(J)
        residuals = back @ binary_residuals(edges.at, measured, way, heading)[:, :, None]  # Eq. 6: its VV edges
        covs = back @ rotated(edges.covs, measured) @ back.transpose(0, 2, 1)
        return Linearised(residuals, OWN_TWIST, covs, vehicles=edges.rows)
