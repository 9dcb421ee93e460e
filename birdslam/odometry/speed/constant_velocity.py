"""What images that show no translation make of a motion: the speed is held, and its sigma grows.

A background that is far away shows how the camera turns and not how far it has come: the pose among its landmarks has
an information that says so. A car's speed changes by no more than its brakes and its engine give, so that a step which
is known much worse than that is taken as the last one, as far as the images leave it open.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_SIDESTEP_M = 0.002
_LEAST_INFORMATION = np.diag([1e-2] * 3 + [1e2] * 3)  # 10 m and 0.1 rad: a direction that the images do not see


class HeldSpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the speed is held. By judgement; no data chose these: nothing on the real clips is held.

    In KITTI 06, where all but the end of the street is black for 3 s, the speed is within 6 % throughout.
    """

    acceleration_mps2: Positive = 3.0  # 1-sigma by which a speed changes in a second
    # Sigma of a step by the images over that of a held one: above it they show no translation, below it they do again
    begins_at: Positive = 2.0  # ... of which this is the upper bound
    ends_at: Positive = 0.5  # ... of which this is the lower bound
    # Images that know a step so well show translation, however little a speed changes from one of 33 Hz to the next
    least_sigma_m: Positive = 0.04  # (the shipped drive has 0.01, KITTI 06 at its night 0.1 and more)
    sigma_direction_rad: Positive = 0.02  # of the way, which goes on as the wheels stand
    inflation: Positive = 9.0  # of the images' variances meanwhile: corners far away err together


class HeldSpeed:
    """State: the variance of the last speed ((m/s)^2). Readers: `Odometry`, for poses that the images do not show."""

    def __init__(self, config: HeldSpeedConfig) -> None:
        self.config = config
        self._var = np.inf
        self._holds = False

    def settle(self, sigma_m: float, dt_s: float) -> None:
        """A step over `dt_s` is known to `sigma_m`."""
        self._var = (sigma_m / dt_s) ** 2

    def sigma_m(self, dt_s: float) -> float:
        """1-sigma of a step over `dt_s` with the last speed."""
        return float(np.sqrt(self._var + (self.config.acceleration_mps2 * dt_s) ** 2)) * dt_s

    def hold(
        self, base: Pose, located: Pose, predicted: Pose, info: Floats, dt_s: float
    ) -> tuple[Pose, float] | None:  # fmt: skip
        """The pose of most likelihood by the images and the last speed, and 1-sigma of its place along the way.

        `located` is what the images say, with the information (6, 6) of (translation, rotation) in the camera's own
        axes, and `predicted` where the last motion leads from `base`. None where the images know better.
        """
        held_m, known = self.sigma_m(dt_s), info + _LEAST_INFORMATION
        limit = self.config.ends_at if self._holds else self.config.begins_at
        weaker = worst_sigma_m(known) > max(limit * held_m, self.config.least_sigma_m)
        self._holds = bool(np.isfinite(held_m)) and weaker
        if not self._holds:
            return None
        known, prior = known / self.config.inflation, np.zeros((6, 6))
        way = located.R.T @ (predicted.p - base.p)
        length_m = float(np.linalg.norm(way))
        across_m = min(self.config.sigma_direction_rad * length_m + _SIDESTEP_M, held_m)
        along = way / max(length_m, 1e-9)
        prior[:3, :3] = np.eye(3) / across_m**2 + np.outer(along, along) * (held_m**-2 - across_m**-2)
        off = np.concatenate([located.R.T @ (predicted.p - located.p), np.zeros(3)])
        both = known + prior
        return located.moved(np.linalg.solve(both, prior @ off)), worst_sigma_m(both)


def worst_sigma_m(info: Floats) -> float:
    """1-sigma of the translation in the direction that is known worst, of information (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(info)[:3, :3])[-1]))
