"""Loops closed, and fixes of GNSS taken in: the graph of keyframes in SE(2), solved by gtsam.

Loops are weighed by dynamic covariance scaling (Agarwal et al. 2013), the closed form of switchable constraints: one
that contradicts the rest is switched off. Which fixes are outliers graduated non-convexity says (Yang et al. 2020):
odometry's links are held, and fixes that can't all be true with them are left out. gtsam is loaded only where there is
something to solve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.keyframe import Link, Placed

DCS_PHI = 5.0  # chi-square at which a loop begins to count less
ORIGIN_SIGMA = 1e-3, 1e-3, 1e-4  # the map's frame is that of its first keyframe
LOOSE_SIGMA = 1e3, 1e3, 1e1  # of keyframes that only loops, or nothing, tie to the first: a loop may be switched off
GNC_COST = 0.5 * 11.3  # half the chi-square beyond which a factor is an outlier: 99 % of three degrees of freedom


@dataclass(frozen=True)
class PlaceFactor:
    """Where a keyframe is by a fix, in the graph's frame."""

    number: int
    xy_m: tuple[float, float]
    sigma_m: float  # of the fix by itself, by which it is judged
    weighed_m: float  # and with what it shares with those around it, by which it pulls


def close_loops(
    keyframes: Sequence[Placed], links: Sequence[Link], fixes: Sequence[PlaceFactor] = ()
) -> dict[int, tuple[SE2, Floats]]:
    """Each keyframe's pose and its covariance, by number, with all links and fixes at once.

    Without fixes the first keyframe stays where it is; with them all may move.
    """
    import gtsam  # here: only who closes a loop needs it

    if not keyframes:
        return {}
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tied = _tied(keyframes[0].number, links)
    first = ORIGIN_SIGMA if not fixes else LOOSE_SIGMA
    for keyframe in keyframes:
        pose = _pose2(keyframe.T_map_keyframe)
        start.insert(keyframe.number, pose)
        if keyframe is keyframes[0] or keyframe.number not in tied:
            sigmas = np.array(first if keyframe is keyframes[0] else LOOSE_SIGMA)
            graph.add(gtsam.PriorFactorPose2(keyframe.number, pose, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    robust = gtsam.noiseModel.mEstimator.DCS(DCS_PHI)
    for link in links:
        noise = _noise(link)
        if link.loop:
            noise = gtsam.noiseModel.Robust.Create(robust, noise)
        graph.add(gtsam.BetweenFactorPose2(link.from_number, link.to_number, _pose2(link.T_from_to), noise))
    for fix in fixes:
        graph.add(_place_factor(fix, fix.weighed_m))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, found)
    out = {}
    for keyframe in keyframes:
        pose = found.atPose2(keyframe.number)
        cov = np.array(marginals.marginalCovariance(keyframe.number))
        out[keyframe.number] = SE2(pose.x(), pose.y(), pose.theta()), cov
    return out


def inliers(keyframes: Sequence[Placed], links: Sequence[Link], fixes: Sequence[PlaceFactor]) -> Bools:
    """(N,) whether each fix fits the others and odometry."""
    import gtsam  # here: only who has fixes needs it

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array(LOOSE_SIGMA))
    tied = _tied(keyframes[0].number, links)
    for keyframe in keyframes:
        pose = _pose2(keyframe.T_map_keyframe)
        start.insert(keyframe.number, pose)
        if keyframe is keyframes[0] or keyframe.number not in tied:
            graph.add(gtsam.PriorFactorPose2(keyframe.number, pose, loose))
    ordered = sorted(links, key=lambda link: link.loop)  # what is held comes first
    for link in ordered:
        graph.add(gtsam.BetweenFactorPose2(link.from_number, link.to_number, _pose2(link.T_from_to), _noise(link)))
    size = graph.size()
    for fix in fixes:
        graph.add(_place_factor(fix, fix.sigma_m))
    params = gtsam.GncLMParams()
    params.setKnownInliers(list(range(size - sum(link.loop for link in links))))
    solver = gtsam.GncLMOptimizer(graph, start, params)
    solver.setInlierCostThresholds(GNC_COST)
    solver.optimize()
    out: Bools = np.array(solver.getWeights())[size:] > 0.5
    return out


def _noise(link: Link) -> Any:
    import gtsam  # here: only who closes a loop needs it

    return gtsam.noiseModel.Gaussian.Covariance(link.cov + 1e-12 * np.eye(3))


def _place_factor(fix: PlaceFactor, sigma_m: float) -> Any:
    import gtsam  # here: only who has fixes needs it

    return gtsam.PoseTranslationPrior2D(fix.number, np.array(fix.xy_m), gtsam.noiseModel.Isotropic.Sigma(2, sigma_m))


def held(links: Sequence[Link], poses: dict[int, tuple[SE2, Floats]]) -> list[Link]:
    """The links that the solved graph agrees with; loops that it contradicts are left out."""
    return [link for link in links if not link.loop or _chi2(link, poses) < 9.0 * DCS_PHI]


def _chi2(link: Link, poses: dict[int, tuple[SE2, Floats]]) -> float:
    between = poses[link.from_number][0].between(poses[link.to_number][0])
    error = link.T_from_to.between(between).log()
    return float(error @ np.linalg.solve(link.cov + 1e-12 * np.eye(3), error))


def _tied(first: int, links: Sequence[Link]) -> set[int]:
    """The keyframes that odometry's links lead to from the first."""
    beside: dict[int, list[int]] = {}
    for link in links:
        if link.loop:
            continue
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
