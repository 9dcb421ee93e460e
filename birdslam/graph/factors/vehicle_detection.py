"""CV edges: the ego observes the pose of a vehicle (Eqs. 2 and 6). Linear in the state."""

from __future__ import annotations

import math

import numpy as np

from birdslam.graph.costs import binary_residuals
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.factors.lasting_error import DRIVING_MPS, lasting_correlation
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.state_layout import LASTING, OF_VEHICLE, POSE
from birdslam.graph.vehicles import MIN_INTERVAL_S
from birdslam.graph.window import PLACE, Window

OWN_POSE = [*range(POSE.start, POSE.stop)]


class LastingErrors(Factor):
    """The errors that consecutive CV edges share: lasting_error.py. Precedes the odometry, which propagates them."""

    name = "lasting errors"
    equation = "of CV edges, in place of independent ones"

    def __init__(self, config: GraphConfig) -> None:
        self._memory_s = config.lasting_s

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Sets the fractions of the lasting errors that are common with those of the previous edges."""
        edges = frame.associations.cv
        if not edges.rows:
            return
        ego_mps = math.hypot(frame.motion.x_m, frame.motion.y_m) / max(frame.passed_s, MIN_INTERVAL_S)
        driven_s = frame.associations.dt_s[edges.rows] * -math.expm1(-ego_mps / DRIVING_MPS)
        kept = lasting_correlation(edges.sigma_rel, window.sigma_rel[edges.rows], driven_s, self._memory_s)
        frame.kept = np.ones(window.sigma_rel.shape)
        frame.kept[edges.rows] = kept
        window.sigma_rel[edges.rows] = edges.sigma_rel


class VehicleDetections(Factor):
    """CV edges to vehicles of the window; edges to new vehicles initialize them (vehicles.py)."""

    name = "CV"
    equation = "Eqs. 2 and 6"
    of_vehicles = True

    def __init__(self, config: GraphConfig) -> None:
        self._gate = config.detection_gate_sigma**2
        self._front_back_ambiguity = config.front_back_ambiguity
        self._lasting = math.sqrt(config.lasting_share)  # of the sigma of a position
        own = np.ones(POSE.stop)
        own[PLACE] = math.sqrt(1.0 - config.lasting_share)
        self._own_share = np.outer(own, own)  # of the covariance

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Reverses vehicles whose detection contradicts their heading by more than a right angle."""
        edges = frame.associations.cv
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
        if not self._lasting:
            return Linearised(residuals, OWN_POSE, edges.covs, self._gate, edges.rows)
        J = np.zeros((len(edges.rows), 3, OF_VEHICLE))
        J[:, OWN_POSE, OWN_POSE], J[:, PLACE, LASTING] = 1.0, self._lasting * edges.factors
        return Linearised(residuals, J, edges.covs * self._own_share, self._gate, edges.rows)
