"""Loops closed: the graph of keyframes in SE(2), solved by gtsam with robust loop factors.

Loops are weighed by dynamic covariance scaling (Agarwal et al. 2013), the closed form of switchable constraints: one
that contradicts the rest is switched off. gtsam is loaded only where a loop is there to close.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.loops.keyframe import Floats, Keyframe, Link

DCS_PHI = 5.0  # chi-square at which a loop begins to count less
ORIGIN_SIGMA = 1e-3, 1e-3, 1e-4  # the map's frame is that of its first keyframe
LOOSE_SIGMA = 1e3, 1e3, 1e1  # of keyframes that no link ties to the first


def close_loops(keyframes: Sequence[Keyframe], links: Sequence[Link]) -> dict[int, tuple[SE2, Floats]]:
    """Each keyframe's pose in the map and its covariance, by number, with all links at once."""
    import gtsam  # here: only who closes a loop needs it

    if not keyframes:
        return {}
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tied = _tied(keyframes[0].number, links)
    origin = gtsam.noiseModel.Diagonal.Sigmas(np.array(ORIGIN_SIGMA))
    graph.add(gtsam.PriorFactorPose2(keyframes[0].number, _pose2(keyframes[0].T_map_keyframe), origin))
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array(LOOSE_SIGMA))
    for keyframe in keyframes:
        start.insert(keyframe.number, _pose2(keyframe.T_map_keyframe))
        if keyframe.number not in tied:
            graph.add(gtsam.PriorFactorPose2(keyframe.number, _pose2(keyframe.T_map_keyframe), loose))
    robust = gtsam.noiseModel.mEstimator.DCS(DCS_PHI)
    for link in links:
        noise: Any = gtsam.noiseModel.Gaussian.Covariance(link.cov + 1e-12 * np.eye(3))
        if link.loop:
            noise = gtsam.noiseModel.Robust.Create(robust, noise)
        graph.add(gtsam.BetweenFactorPose2(link.from_number, link.to_number, _pose2(link.T_from_to), noise))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, found)
    out = {}
    for keyframe in keyframes:
        pose = found.atPose2(keyframe.number)
        cov = np.array(marginals.marginalCovariance(keyframe.number))
        out[keyframe.number] = SE2(pose.x(), pose.y(), pose.theta()), cov
    return out


def held(links: Sequence[Link], poses: dict[int, tuple[SE2, Floats]]) -> list[Link]:
    """The links that the solved graph agrees with; loops that it contradicts are left out."""
    return [link for link in links if not link.loop or _chi2(link, poses) < 9.0 * DCS_PHI]


def _chi2(link: Link, poses: dict[int, tuple[SE2, Floats]]) -> float:
    between = poses[link.from_number][0].between(poses[link.to_number][0])
    error = link.T_from_to.between(between).log()
    return float(error @ np.linalg.solve(link.cov + 1e-12 * np.eye(3), error))


def _tied(first: int, links: Sequence[Link]) -> set[int]:
    """The keyframes that links lead to from the first."""
    beside: dict[int, list[int]] = {}
    for link in links:
        beside.setdefault(link.from_number, []).append(link.to_number)
        beside.setdefault(link.to_number, []).append(link.from_number)
    seen, waiting = {first}, [first]
    while waiting:
        for other in beside.get(waiting.pop(), []):
            if other not in seen:
                seen.add(other)
                waiting.append(other)
    return seen


def _pose2(T: SE2) -> Any:
    import gtsam  # here: only who closes a loop needs it

    return gtsam.Pose2(T.x_m, T.y_m, T.yaw_rad)
