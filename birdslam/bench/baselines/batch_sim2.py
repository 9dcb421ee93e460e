"""Poses in Sim(2), each with a scale of its own (Strasdat et al. 2010): what a drifting unit of length asks for."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2

FIRST_SIGMA = 1e-3, 1e-3, 1e-4, 1e-3  # x, y, yaw and the scale's logarithm of the first pose, which is the frame


def places_in_sim2(poses: Sequence[SE2], edges: Sequence[tuple[int, int, SE2, Floats]]) -> Floats:
    """(N, 2) where the poses are, of N first guesses.

    An edge is from, to, the pose of the one in the metres of the other, and (4,) 1-sigma of x, y, yaw and the
    logarithm of how the two scales differ.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, pose in enumerate(poses):
        start.insert(number, _similarity(pose))
    first = gtsam.noiseModel.Diagonal.Sigmas(np.array(FIRST_SIGMA))
    graph.add(gtsam.PriorFactorSimilarity2(0, _similarity(poses[0]), first))
    for begin, end, T, sigmas in edges:
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.BetweenFactorSimilarity2(begin, end, _similarity(T), noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    solved = [found.atSimilarity2(number) for number in range(len(poses))]
    return np.array([each.scale() * np.array(each.translation()) for each in solved])


def _similarity(T: SE2) -> gtsam.Similarity2:
    return gtsam.Similarity2(gtsam.Rot2(T.yaw_rad), gtsam.Point2(T.x_m, T.y_m), 1.0)
