"""A map's graph without scales: every link as it is, in SE(2), what the method's Sim(2) is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2

FIRST_SIGMA = 1e-3, 1e-3, 1e-4  # x, y, yaw of the first pose, which is the frame


def places_in_se2(poses: Sequence[SE2], links: Sequence[tuple[int, int, SE2, Floats]]) -> tuple[Floats, Floats]:
    """(N, 2) where the poses are, of N first guesses, and (N, 2) their 1-sigma along their own axes.

    A link is from, to, the pose of the one in the other, and its covariance (3, 3).
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, pose in enumerate(poses):
        start.insert(number, _pose2(pose))
    first = gtsam.noiseModel.Diagonal.Sigmas(np.array(FIRST_SIGMA))
    graph.add(gtsam.PriorFactorPose2(0, _pose2(poses[0]), first))
    for begin, end, T, cov in links:
        graph.add(gtsam.BetweenFactorPose2(begin, end, _pose2(T), gtsam.noiseModel.Gaussian.Covariance(cov)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, found)
    solved = [found.atPose2(number) for number in range(len(poses))]
    sigma = [np.sqrt(np.diag(marginals.marginalCovariance(number)))[:2] for number in range(len(poses))]
    return np.array([(each.x(), each.y()) for each in solved]), np.array(sigma)


def _pose2(T: SE2) -> gtsam.Pose2:
    return gtsam.Pose2(T.x_m, T.y_m, T.yaw_rad)
