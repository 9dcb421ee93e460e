"""Whether the ego's covariance is consistent with its errors (NEES, Bar-Shalom et al. 2001, 5.4).

One drive is one sample, however many frames it has: the errors of neighbouring frames are nearly the same error. So a
drive's figure may well be 0.2 or 3 by chance; only the mean of many drives says whether the covariance is right.
"""

from __future__ import annotations

import msgspec
import numpy as np

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import Transform, ego_pose, inverse, mount_pose, split_pose
from birdslam.types import Estimate, Status

DIMENSIONS = 3
INSIDE_95 = 7.815  # chi-square of three degrees of freedom: 95 % of consistent errors lie below
CERTAIN_M = 0.01  # a pose of a smaller 1-sigma is left out: the truth is not known so well


class ConsistencyReport(msgspec.Struct, frozen=True, kw_only=True):
    """Of the valid estimates whose 1-sigma of the position is at least CERTAIN_M."""

    frames: int
    nees: float | None = None  # mean of e' P^-1 e over its degrees of freedom: 1 is consistent, more is overconfident
    inside_95: float | None = None  # share of the frames whose error lies within the stated 95 %


class Consistency:
    """Collects the ego's estimates, frame by frame."""

    def __init__(self, mount: GroundPlane) -> None:
        self._mount = mount_pose(mount)
        self._begins: dict[int, tuple[int, Transform]] = {}  # of an epoch: its first frame, and T_world_ego there
        self._stated: list[tuple[int, Estimate]] = []  # with its frame of the recording
        self._frames = 0

    def add(self, estimate: Estimate) -> None:
        """The next frame's estimate; what comes at the source's end is of no frame."""
        if Status.END_OF_SOURCE in estimate.status:
            return
        self._begins.setdefault(estimate.epoch, (self._frames, ego_pose(estimate.T_world_ego, estimate.attitude)))
        if estimate.valid:
            self._stated.append((self._frames, estimate))
        self._frames += 1

    def report(self, truth: Transform) -> ConsistencyReport:
        """Against `T_first_i` (N, 4, 4) of the camera, all frames of the recording, in its own axes.

        Each epoch's world begins with the truth at its own first frame.
        """
        values = []
        for frame, estimate in self._stated:
            covariance = np.reshape(estimate.cov, (DIMENSIONS, DIMENSIONS))
            if np.sqrt(np.trace(covariance[:2, :2])) >= CERTAIN_M:
                begin, origin = self._begins[estimate.epoch]
                error = estimate.T_world_ego.between(self._true_ego(origin, inverse(truth[begin]) @ truth[frame])).log()
                values.append(float(error @ np.linalg.solve(covariance, error)))
        if not values:
            return ConsistencyReport(frames=0)
        return ConsistencyReport(
            frames=len(values),
            nees=float(np.mean(values)) / DIMENSIONS,
            inside_95=float(np.mean(np.less(values, INSIDE_95))),
        )

    def _true_ego(self, origin: Transform, T_begin_cam: Transform) -> SE2:
        """The ego's true pose on the road; at the epoch's first frame it is `origin`, the estimated one."""
        return split_pose(origin @ self._mount @ T_begin_cam @ inverse(self._mount))[0]
