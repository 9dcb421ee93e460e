"""A constant-velocity prior on the motion, for images that show no translation.

Landmarks that are all far away determine the rotation and not the translation: the information of the resected pose
says so. A car's speed changes only as fast as its brakes and engine allow, so that where the images know a step much
worse than that, both are fused, and the speed's sigma grows from step to step.
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
_WEAK_PRIOR = np.diag([1e-2] * 3 + [1e2] * 3)  # 10 m and 0.1 rad: a direction that the images do not see


class ConstantVelocityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the prior is used. By judgement; no data chose these: on the real clips it is never used.

    In KITTI 06, with all but the end of the street blackened for 3 s, the speed stays within 6 %.
    """

    acceleration_mps2: Positive = 3.0  # 1-sigma by which a speed changes in a second
    # The ratio of a step's sigma by the images to that by the prior
    on_threshold: Positive = 2.0  # above it the prior is used
    off_threshold: Positive = 0.5  # below it no more
    # A step known to this shows translation, however little the speed changes between images at 33 Hz
    least_sigma_m: Positive = 0.04  # (the shipped drive has 0.01, KITTI 06 at its night 0.1 and more)
    sigma_direction_rad: Positive = 0.02  # of the direction of travel
    inflation: Positive = 9.0  # of the images' variances meanwhile: far corners err together


class ConstantVelocityPrior:
    """State: the variance of the last speed ((m/s)^2). Reader: `Odometry`."""

    def __init__(self, config: ConstantVelocityConfig) -> None:
        self.config = config
        self._var = np.inf
        self._active = False

    def update(self, sigma_m: float, dt_s: float) -> None:
        """The last step, over `dt_s`, is known to `sigma_m`."""
        self._var = (sigma_m / dt_s) ** 2

    def sigma_m(self, dt_s: float) -> float:
        """1-sigma of a step over `dt_s` predicted by the last speed."""
        return float(np.sqrt(self._var + (self.config.acceleration_mps2 * dt_s) ** 2)) * dt_s

    def fuse(
        self, base: Pose, measured: Pose, predicted: Pose, info: Floats, dt_s: float
    ) -> tuple[Pose, float] | None:  # fmt: skip
        """The maximum-likelihood pose by the images and the prior, and 1-sigma of its position; None: prior not needed.

        `measured` is the pose by the images, with information (6, 6) of (translation, rotation) in the camera's own
        axes; `predicted` is the motion model's prediction from the pose `base`.
        """
        predicted_sigma_m, known = self.sigma_m(dt_s), info + _WEAK_PRIOR
        limit = self.config.off_threshold if self._active else self.config.on_threshold
        weaker = largest_sigma_m(known) > max(limit * predicted_sigma_m, self.config.least_sigma_m)
        self._active = bool(np.isfinite(predicted_sigma_m)) and weaker
        if not self._active:
            return None
        known, prior = known / self.config.inflation, np.zeros((6, 6))
        way = measured.R.T @ (predicted.p - base.p)
        length_m = float(np.linalg.norm(way))
        across_m = min(self.config.sigma_direction_rad * length_m + _SIDESTEP_M, predicted_sigma_m)
        along = way / max(length_m, 1e-9)
        prior[:3, :3] = np.eye(3) / across_m**2 + np.outer(along, along) * (predicted_sigma_m**-2 - across_m**-2)
        off = np.concatenate([measured.R.T @ (predicted.p - measured.p), np.zeros(3)])
        both = known + prior
        return measured.moved(np.linalg.solve(both, prior @ off)), largest_sigma_m(both)


def largest_sigma_m(info: Floats) -> float:
    """1-sigma of the translation in its least certain direction, given the information (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(info)[:3, :3])[-1]))
