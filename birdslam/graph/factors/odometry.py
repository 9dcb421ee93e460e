"""CC edges: the ego's motion between two frames (Eqs. 2 and 6), and the correlated errors of its odometry.

A CC edge propagates the window, so its residual is zero. Without a sigma of the scale (an odometry that is not from
images) no error is correlated.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.factor import Factor, GraphFrame
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import Window


class OdometryState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of `Odometry`."""

    correlated_m: float
    correlated_turn_rad: float


class Odometry(Factor):
    """CC edges; a frame without one starts a new epoch."""

    name = "CC"
    equation = "Eqs. 2 and 6"
    state_type = OdometryState

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self.begin()

    def begin(self) -> None:
        """Clears the correlated errors."""
        self._correlated_m = 0.0  # distance over which the present scale error is common, older parts discounted
        self._correlated_turn_rad = 0.0  # the same for the turn

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Propagates the window to this frame."""
        m, cc = frame.measurements, frame.edges.cc
        assert cc is not None  # the caller predicts only frames with a CC edge
        cov = np.zeros((3, 3)) if frame.zero_velocity else np.reshape(cc.cov, (3, 3))
        dt_s = frame.associations.dt_s.copy()
        dt_s[[*frame.fixed]] = 0.0
        window.propagate(  # Eq. 6: its CC edge
            frame.motion, cov, cc.from_frame, m.frame_id, dt_s, frame.twist_growth, frame.kept
        )
        if not frame.zero_velocity:
            self._drift(frame.motion, window, m.scale_sigma_rel)

    def _drift(self, motion: SE2, window: Window, scale_sigma_rel: float) -> None:
        """Adds the covariance between this step and the earlier ones; docs/method.md derives it."""
        step, turn_rad, config = complex(motion.x_m, motion.y_m), motion.yaw_rad, self._config
        if config.correlation_length_m and (length_m := abs(step)) and scale_sigma_rel:
            along = step / length_m
            common_m2 = 2.0 * self._correlated_m * length_m
            window.drift(along, scale_sigma_rel**2 * common_m2, config.correlated_direction_rad**2 * common_m2)
            # A turn back would cancel the error of the earlier turn; ignored, so that the variance never falls
            window.turn_drift(2.0 * config.correlated_turn_rel**2 * max(self._correlated_turn_rad * turn_rad, 0.0))
            keep = math.exp(-length_m / config.correlation_length_m)
            self._correlated_m = keep * self._correlated_m + length_m
            self._correlated_turn_rad = keep * self._correlated_turn_rad + turn_rad

    def state(self) -> OdometryState:
        """The correlated errors."""
        return OdometryState(correlated_m=self._correlated_m, correlated_turn_rad=self._correlated_turn_rad)

    def resume(self, state: OdometryState) -> None:
        """Restores the state."""
        self._correlated_m, self._correlated_turn_rad = state.correlated_m, state.correlated_turn_rad
