"""CP edges of vehicles: a frame's landmarks locate the vehicles that it shows (Eqs. 3 and 7).

Eq. 7 has a unary edge between "an agent A (ego-camera or vehicle in scene)" and each point. The camera observes both,
so the edge is their difference: the CV edge again, with CP's weight, relative to landmarks instead of the ego. It
measures the position in world and corrects ego and vehicle, after all other factors, so that it includes new vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Complexes
from birdslam.graph.factors.factor import Factor, GraphFrame
from birdslam.graph.factors.landmark_points import LandmarkPoints, landmark_residual
from birdslam.graph.state_layout import EGO
from birdslam.graph.window import Window


class VehicleLandmarks(Factor):
    """CP edges of vehicles, each with information `weight` (Eq. 4). Precedes `landmarks` in the list."""

    name = "CP of vehicles"
    equation = "Eqs. 3 and 7"
    ties_vehicles = True

    def __init__(self, weight: float, landmarks: LandmarkPoints) -> None:
        self._weight = weight
        self._landmarks = landmarks

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """Corrects ego and vehicles by the edges of this frame."""
        edges, known = frame.edges.cv, self._landmarks.known_in_ego(window)
        if not edges or known is None:
            return
        place_of = {frame.vehicles.row(edge.vehicle): edge.T_ego_vehicle for edge in edges}
        place_of.pop(-1, None)
        if not place_of:
            return
        points, there, heading = known
        ego = complex(landmark_residual(there, 0.0, heading, points).mean())  # Eq. 7: all landmarks weigh alike
        places = [complex(T.x_m, T.y_m) for T in place_of.values()]
        at = window.at[window.nodes :][[*place_of]]
        residuals = ego + heading * np.array(places) - at  # Eq. 3, of the vehicle
        _correct(window, [*place_of], residuals, 1.0 / (self._weight * len(points)), frame.zero_velocity)


def _correct(window: Window, rows: Sequence[int], residuals: Complexes, variance_m2: float, hold: bool) -> None:
    """Applies edges on the positions of the vehicles `rows` (k,): `residuals` (k,) in ego, metres.

    `variance_m2` is that of each edge per axis; `hold` keeps the ego fixed.
    """
    k, states, P = len(rows), window.layout.poses[rows], window.P
    at = window.at[window.nodes :][rows]
    H = np.zeros((2 * k, len(P)))  # Jacobian of the positions in world
    H[0::2, EGO.start] = H[1::2, EGO.start + 1] = 1.0
    H[0::2, EGO.start + 2], H[1::2, EGO.start + 2] = -at.imag, at.real
    H[2 * np.arange(k), states[:, 0]] = H[2 * np.arange(k) + 1, states[:, 1]] = 1.0
    PHt = P @ H.T
    K = np.linalg.solve(H @ PHt + variance_m2 * np.eye(2 * k), PHt.T).T
    residual = np.column_stack([residuals.real, residuals.imag]).ravel()
    dx, held = K @ residual, window.ego_cov.copy()
    P -= K @ PHt.T
    P = 0.5 * (P + P.T)
    if hold:
        dx[EGO] = 0.0
        P[EGO, EGO] = held
    window.set_P(P)
    window.shift(dx)
