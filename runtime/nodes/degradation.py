"""Load shedding of perceive in modes, with hysteresis.

    full -> rate (networks on fewer frames) -> boxes (the detector alone) -> odometry (no network) -> coasting

In `coasting` most frames are predicted with a growing covariance, and the estimate becomes invalid after
`coast_max_ms`. Each mode but the first is a status in the measurements and in the estimate.
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Collection

from birdslam.runtime.configuration import DegradationConfig
from birdslam.types import Status


class Mode(enum.StrEnum):
    """From full processing to prediction."""

    FULL = "full"
    RATE = "rate"
    BOXES = "boxes"
    ODOMETRY = "odometry"
    COASTING = "coasting"


STATUS = {
    Mode.FULL: (),
    Mode.RATE: (Status.DEGRADED_RATE,),
    Mode.BOXES: (Status.DEGRADED_BOXES,),
    Mode.ODOMETRY: (Status.DEGRADED_ODOMETRY,),
    Mode.COASTING: (Status.DEGRADED_ODOMETRY,),  # of the frames that are processed
}


def modes(roles: Collection[str]) -> tuple[Mode, ...]:
    """Returns the modes that have an effect, given the roles for which there are networks."""
    out = [Mode.FULL]
    if roles:
        out += [Mode.RATE, *([Mode.BOXES] if {"detector", "segmenter"} <= set(roles) else []), Mode.ODOMETRY]
    return (*out, Mode.COASTING)


class Degradation:
    """Selects the mode by comparing each frame's age, when its measurements are done, with its budget."""

    def __init__(self, config: DegradationConfig, roles: Collection[str], budget_ms: float) -> None:
        self._config = config
        self._modes = modes(roles)
        self._budget_ms = budget_ms
        self._at = 0
        self._late: deque[bool] = deque(maxlen=config.window_frames)
        self._calm = 0

    @property
    def mode(self) -> Mode:
        """The mode of the next frame."""
        return self._modes[self._at]

    def judge(self, age_ms: float) -> bool:
        """Adds a frame's age; returns whether the mode has changed."""
        config = self._config
        self._late.append(age_ms > self._budget_ms)
        self._calm = self._calm + 1 if age_ms <= config.calm_share * self._budget_ms else 0
        full = len(self._late) == config.window_frames
        step = 0
        if full and sum(self._late) >= config.late_share * config.window_frames:
            step = int(self._at + 1 < len(self._modes))
        elif self._calm >= config.calm_frames:
            step = -int(self._at > 0)
        if step:
            self._at += step
            self._late.clear()
            self._calm = 0
        return bool(step)
