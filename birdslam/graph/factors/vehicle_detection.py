"""CV edges: the ego observes the pose of a vehicle (Eqs. 2 and 6). Linear in the state."""

from __future__ import annotations

import math

import numpy as np

from birdslam.graph.costs import binary_residuals
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.factors.lasting_error import DRIVING_MPS, lasting_correlation, relative_sigmas
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.state_layout import LASTING, OF_VEHICLE, POSE
from birdslam.graph.vehicles import MIN_INTERVAL_S
from birdslam.graph.window import PLACE, Window

OWN_POSE = [*range(POSE.start, POSE.stop)]


class VehicleDetections(Factor):
    """CV edges to vehicles of the window; edges to new vehicles initialize them (vehicles.py)."""

    name = "CV"
    equation = "Eqs. 2 and 6"
    of_vehicles = True

    def __init__(self, config: GraphConfig) -> None:
        self._gate = config.detection_gate_sigma**2
        self._front_back_ambiguity = config.front_back_ambiguity
        self._share, self._memory_s = config.lasting_share, config.lasting_s

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Correlates the lasting errors with those of the previous edges.

        Reverses vehicles whose detection contradicts their heading by more than a right angle.
        """
        edges = frame.associations.cv
        if self._share and edges.rows:
            sigma_rel = relative_sigmas(edges)
            ego_mps = math.hypot(frame.motion.x_m, frame.motion.y_m) / max(frame.passed_s, MIN_INTERVAL_S)
            driven_s = frame.associations.dt_s[edges.rows] * -math.expm1(-ego_mps / DRIVING_MPS)
            same = lasting_correlation(sigma_rel, window.sigma_rel[edges.rows], driven_s, self._memory_s)
            window.fade_lasting(edges.rows, same, sigma_rel)
        if self._front_back_ambiguity and edges.rows:
            opposed = (edges.heading * window.heading[window.nodes :][edges.rows].conj()).real < 0.0
            if opposed.any():
                window.flip_headings([edges.rows[k] for k in np.flatnonzero(opposed)])

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """Each edge measures its vehicle's pose (3 numbers); a share of the error is correlated over time."""
        edges = frame.associations.cv
        if not edges.rows:
            return None
        at, heading = window.at[window.nodes :][edges.rows], window.heading[window.nodes :][edges.rows]
        residuals = binary_residuals(edges.at, edges.heading, at, heading)  # Eq. 6: its CV edges
        if not self._share:
            return Linearised(residuals, OWN_POSE, edges.covs, self._gate, edges.rows)
        J, covs = np.zeros((len(edges.rows), 3, OF_VEHICLE)), edges.covs.copy()
        J[:, POSE, POSE] = np.eye(3)
        J[:, PLACE, LASTING] = math.sqrt(self._share) * edges.factors
        covs[:, PLACE] *= math.sqrt(1.0 - self._share)
        covs[:, :, PLACE] *= math.sqrt(1.0 - self._share)
        return Linearised(residuals, J, covs, self._gate, edges.rows)
