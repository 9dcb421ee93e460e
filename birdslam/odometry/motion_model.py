"""Constant-velocity motion model: the last measured velocity predicts the next motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_exp, rotation_log

Floats = NDArray[np.float64]

NO_MOTION = Pose(np.eye(3), np.zeros(3))


class MotionModel:
    """State: the camera's velocity and angular velocity in its own axes; unknown before the first measured motion."""

    def __init__(self) -> None:
        self._rate: tuple[Floats, Floats] | None = None  # (3,) m/s and (3,) rad/s
        self.interval_s = 0.1  # duration of the last motion

    @property
    def known(self) -> bool:
        """Whether a velocity has been measured."""
        return self._rate is not None

    @property
    def rate(self) -> tuple[Floats, Floats]:
        """(3,) m/s and (3,) rad/s in camera axes; zero before the first measured motion."""
        return (np.zeros(3), np.zeros(3)) if self._rate is None else self._rate

    @property
    def speed_mps(self) -> float:
        """Speed; 0 before the first measured motion."""
        return 0.0 if self._rate is None else float(np.linalg.norm(self._rate[0]))

    def update(self, step: Pose, dt_s: float, over_s: float) -> None:
        """Sets the velocity from a motion T_prev_curr over `over_s`; the image interval is `dt_s`."""
        self._rate, self.interval_s = (step.p / over_s, rotation_log(step.R) / over_s), dt_s

    def stop(self) -> None:
        """Sets the velocity to zero."""
        self._rate = np.zeros(3), np.zeros(3)

    def predict(self, dt_s: float) -> Pose:
        """T_prev_curr over `dt_s` at constant velocity; identity before the first measured motion."""
        if self._rate is None:
            return NO_MOTION
        linear_mps, angular_radps = self._rate
        return Pose(rotation_exp(angular_radps * dt_s), linear_mps * dt_s)
