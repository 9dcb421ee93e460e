"""CV edges: where the ego sees a vehicle (Eqs. 2 and 6). Linear in the state, whatever the vehicle's yaw."""

from __future__ import annotations

import numpy as np

from birdslam.graph.costs import binary_residual
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import Window


class VehicleDetections(Factor):
    """CV edges to vehicles that the window has; those to new ones begin them (vehicles.py)."""

    name = "CV"
    equation = "Eqs. 2 and 6"
    of_vehicles = True

    def __init__(self, config: GraphConfig) -> None:
        self._gate = config.detection_gate_sigma**2
        self._front_back_ambiguity = config.front_back_ambiguity

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Turns vehicles round whose detection contradicts their heading by more than a right angle."""
        if self._front_back_ambiguity:
            now = window.heading[window.nodes :]
            edges = frame.associations.cv
            opposed = [row for row, _, heading, _ in edges if (heading * now[row].conjugate()).real < 0.0]
            if opposed:
                window.flip_headings(opposed)

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Each edge measures the three numbers of its vehicle's pose."""
        edges = frame.associations.cv
        if not edges:
            return None
        firsts, now_at, now_heading = window.layout.firsts, window.at[window.nodes :], window.heading[window.nodes :]
        index: list[int] = []
        residual: list[float] = []
        covs: list[float] = []
        for row, at, heading, cov in edges:
            first = firsts[row]
            index += (first, first + 1, first + 2)
            residual += binary_residual(at, heading, now_at[row], now_heading[row])  # Eq. 6: its CV edges
            covs += cov
        return Linearised(residual, index, np.fromiter(covs, np.float64, len(covs)).reshape(-1, 3, 3), self._gate)
