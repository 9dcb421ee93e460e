"""The constant-velocity motion model: the last measured velocity predicts the next motion, and coasts without one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_exp, rotation_log

Floats = NDArray[np.float64]

NO_MOTION = Pose(np.eye(3), np.zeros(3))


class MotionModel:
    """State: the camera's velocity and yaw rate in its own axes; unknown until the first motion was measured."""

    def __init__(self) -> None:
        self._rate: tuple[Floats, Floats] | None = None  # (3,) m/s and (3,) rad/s
        self.interval_s = 0.1  # that it took

    @property
    def known(self) -> bool:
        """Whether one was ever measured."""
        return self._rate is not None

    @property
    def rate(self) -> tuple[Floats, Floats]:
        """(3,) m/s and (3,) rad/s of the camera in its own axes; zero where none was ever measured."""
        return (np.zeros(3), np.zeros(3)) if self._rate is None else self._rate

    @property
    def speed_mps(self) -> float:
        """0 where none was ever measured."""
        return 0.0 if self._rate is None else float(np.linalg.norm(self._rate[0]))

    def update(self, step: Pose, dt_s: float, over_s: float) -> None:
        """Takes T_prev_curr of a motion `over_s`, of which the last image took `dt_s`."""
        self._rate, self.interval_s = (step.p / over_s, rotation_log(step.R) / over_s), dt_s

    def stop(self) -> None:
        """Zero velocity."""
        self._rate = np.zeros(3), np.zeros(3)

    def predict(self, dt_s: float) -> Pose:
        """T_prev_curr over `dt_s` at constant velocity; no motion where none was ever measured."""
        if self._rate is None:
            return NO_MOTION
        linear_mps, angular_radps = self._rate
        return Pose(rotation_exp(angular_radps * dt_s), linear_mps * dt_s)
