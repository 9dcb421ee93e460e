"""CV edges: where the ego sees a vehicle (Eqs. 2 and 6). Linear in the state, whatever the vehicle's yaw."""

from __future__ import annotations

import numpy as np

from birdslam.graph.costs import binary_residuals
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.state_layout import POSE
from birdslam.graph.window import Window

OWN_POSE = [*range(POSE.start, POSE.stop)]


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
        edges = frame.associations.cv
        if self._front_back_ambiguity and edges.rows:
            opposed = (edges.heading * window.heading[window.nodes :][edges.rows].conj()).real < 0.0
            if opposed.any():
                window.flip_headings([edges.rows[k] for k in np.flatnonzero(opposed)])

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Each edge measures the three numbers of its vehicle's pose."""
        edges = frame.associations.cv
        if not edges.rows:
            return None
        at, heading = window.at[window.nodes :][edges.rows], window.heading[window.nodes :][edges.rows]
        residuals = binary_residuals(edges.at, edges.heading, at, heading)  # Eq. 6: its CV edges
        return Linearised(residuals, OWN_POSE, edges.covs, self._gate, edges.rows)
