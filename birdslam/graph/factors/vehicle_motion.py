"""VV edges: a vehicle's own motion since its newest pose in the window (Eqs. 2 and 6)."""

from __future__ import annotations

import cmath

import numpy as np

from birdslam.geometry.constant_twist import advance, rate
from birdslam.graph.costs import binary_residual, rotated
from birdslam.graph.edges import VvEdge
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.window import Window


class VehicleMotion(Factor):
    """Alone, as in Eq. 6: a vehicle's twist in an interval is what its VV edge says, whatever it was before.

    Stands before the odometry in the list, which drives the vehicles on.
    """

    name = "VV"
    equation = "Eqs. 2 and 6"

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """The twists of the interval that leads to this frame."""
        edges = frame.associations.vv
        if edges:
            twists = [rate(complex(e.motion.x_m, e.motion.y_m), e.motion.yaw_rad, e.dt_s) for e in edges]  # Eq. 6: VV
            intervals_s = np.array([e.dt_s for e in edges])
            covs = np.array([e.cov for e in edges]).reshape(-1, 3, 3) / np.square(intervals_s)[:, None, None]
            window.set_twists([e.row for e in edges], twists, covs)


class MeasuredTwist(Factor):
    """VV edges beside constant velocity: measurements of the twist that it predicts."""

    name = "VV"
    equation = "Eqs. 2 and 6"
    of_vehicles = True

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Each edge measures the three numbers of its vehicle's twist."""
        edges = frame.associations.vv
        if not edges:
            return None
        index: list[int] = []
        residual: list[float] = []
        covs: list[float] = []
        for e in edges:
            first = window.layout.firsts[e.row] + 3
            index += (first, first + 1, first + 2)
            gap, cov = _of_twist(e, window.velocity[e.row], window.turn_radps[e.row])  # Eq. 6: its VV edges
            residual += gap
            covs += cov
        return Linearised(residual, index, np.array(covs).reshape(-1, 3, 3))


def _of_twist(edge: VvEdge, velocity: complex, turn_radps: float) -> tuple[list[float], list[float]]:
    """What a VV edge says of the twist that the window has: residual (3,) and covariance (9,)."""
    way, heading, by_velocity, by_turn = advance(1.0 + 0.0j, velocity, turn_radps, edge.dt_s)
    T = edge.motion
    measured = cmath.rect(1.0, T.yaw_rad)
    g, d = by_velocity, by_turn
    back = np.linalg.inv([[g.real, -g.imag, d.real], [g.imag, g.real, d.imag], [0.0, 0.0, edge.dt_s]])
    residual = back @ binary_residual(complex(T.x_m, T.y_m), measured, way, heading)
    cov = back @ np.reshape(rotated(edge.cov, measured), (3, 3)) @ back.T
    return residual.tolist(), cov.ravel().tolist()
