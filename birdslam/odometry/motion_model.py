"""The last measured motion, as a rate: it predicts the next one, and goes on where nothing is measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_exp, rotation_log

Floats = NDArray[np.float64]

STILL = Pose(np.eye(3), np.zeros(3))


class LastMotion:
    """Of the camera, in its own axes. Unknown until the first motion was measured."""

    def __init__(self) -> None:
        self._rate: tuple[Floats, Floats] | None = None  # (3,) m/s and (3,) rad/s
        self.interval_s = 0.1  # that it took

    @property
    def known(self) -> bool:
        """Whether one was ever measured."""
        return self._rate is not None

    @property
    def speed_mps(self) -> float:
        """0 where none was ever measured."""
        return 0.0 if self._rate is None else float(np.linalg.norm(self._rate[0]))

    def measured(self, step: Pose, dt_s: float) -> None:
        """T_prev_curr of a motion that took `dt_s`."""
        self._rate, self.interval_s = (step.p / dt_s, rotation_log(step.R) / dt_s), dt_s

    def stood(self) -> None:
        """The camera stands."""
        self._rate = np.zeros(3), np.zeros(3)

    def over(self, dt_s: float) -> Pose:
        """T_prev_curr at the same rate; no motion where none was ever measured."""
        if self._rate is None:
            return STILL
        linear_mps, angular_radps = self._rate
        return Pose(rotation_exp(angular_radps * dt_s), linear_mps * dt_s)
