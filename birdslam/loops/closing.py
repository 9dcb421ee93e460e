"""Loop closure and GNSS fixes: the pose graph of keyframes in Sim(2), solved by gtsam.

Each keyframe has a pose in the map and a scale, map metres over odometry metres (Strasdat et al. 2010). Links are in
the metres of their first keyframe. Loops have dynamic covariance scaling (Agarwal et al. 2013); outliers among the
fixes are found by graduated non-convexity (Yang et al. 2020).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import KEPT_M, MIN_SCALE_REL
from birdslam.loops.keyframe import Link, Placed

DCS_PHI = 5.0  # chi-square above which the weight of a loop decreases
# Prior sigmas of x, y, yaw and log scale
ORIGIN_SIGMA = 1e-3, 1e-3, 1e-4, 1e1  # of the first keyframe, which defines the map frame
LOOSE_SIGMA = 1e3, 1e3, 1e1, 1e-1  # of keyframes that no odometry link connects to the first
FREE_SIGMA = 1e6  # of components without a prior
LOOP_SCALE_SIGMA = 1e1  # a loop does not measure the scale
MIN_LENGTH_M = 0.1  # of a link, for the change of scale
GNC_COST = 0.5 * 11.3  # half the chi-square of an outlier: 99 % of three degrees of freedom


@dataclass(frozen=True)
class PlaceFactor:
    """The position of a keyframe by a fix, in the graph's frame."""

    number: int
    xy_m: tuple[float, float]
    sigma_m: float  # 1-sigma of the fix, for the outlier test
    weighed_m: float  # 1-sigma with the error shared with nearby fixes, for the factor


class Solved(NamedTuple):
    """A keyframe in the solved graph."""

    T_map_keyframe: SE2
    cov: Floats  # (3, 3) of the tangent at the pose
    scale: float  # map metres over odometry metres


def close_loops(
    keyframes: Sequence[Placed], links: Sequence[Link], fixes: Sequence[PlaceFactor] = (), agreed: bool = False
) -> dict[int, Solved]:
    """Solves the graph with all links and fixes; returns each keyframe by its number.

    Without fixes the first keyframe is fixed. `agreed`: the loops are mutually consistent and may be far from the
    current poses; without it such loops are down-weighted.
    """
    import gtsam

    if not keyframes:
        return {}
    first_sigma = LOOSE_SIGMA if fixes else ORIGIN_SIGMA
    graph, start = _graph(keyframes, links, first_sigma, gtsam.noiseModel.mEstimator.DCS(DCS_PHI))
    if agreed:
        start = gtsam.LevenbergMarquardtOptimizer(_graph(keyframes, links, first_sigma)[0], start).optimize()
    for fix in fixes:
        graph.add(_place_factor(fix, fix.weighed_m, start))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    marginals = gtsam.Marginals(graph, found)
    out = {}
    for keyframe in keyframes:
        solved = found.atSimilarity2(keyframe.number)
        scale = float(solved.scale())
        x_m, y_m = scale * np.array(solved.translation())
        in_map = np.diag([scale, scale, 1.0])  # the tangent is in the keyframe's metres
        cov = in_map @ np.array(marginals.marginalCovariance(keyframe.number))[:3, :3] @ in_map
        out[keyframe.number] = Solved(SE2(float(x_m), float(y_m), solved.rotation().theta()), cov, scale)
    return out


def inliers(keyframes: Sequence[Placed], links: Sequence[Link], fixes: Sequence[PlaceFactor]) -> Bools:
    """Returns (N,) whether each fix is consistent with the others and odometry.

    A fix farther from its keyframe than the drive extends is rejected at once: graduated non-convexity starts from the
    fit of all fixes, which a single one of these would ruin.
    """
    import gtsam

    graph, start = _graph(keyframes, links, LOOSE_SIGMA)
    size = graph.size()
    for fix in fixes:
        graph.add(_place_factor(fix, fix.sigma_m, start))
    params = gtsam.GncLMParams()
    params.setKnownInliers(list(range(size - sum(link.loop for link in links))))
    params.setKnownOutliers((size + np.flatnonzero(_far(keyframes, fixes))).tolist())
    solver = gtsam.GncLMOptimizer(graph, start, params)
    solver.setInlierCostThresholds(GNC_COST)
    solver.optimize()
    out: Bools = np.array(solver.getWeights())[size:] > 0.5
    return out


def _far(keyframes: Sequence[Placed], fixes: Sequence[PlaceFactor]) -> Bools:
    """Returns (N,) whether each fix is farther from its keyframe than the keyframes extend."""
    at = {keyframe.number: (keyframe.T_map_keyframe.x_m, keyframe.T_map_keyframe.y_m) for keyframe in keyframes}
    extent_m = np.linalg.norm(np.ptp(np.array(list(at.values())), axis=0))
    apart_m = np.array([math.dist(fix.xy_m, at[fix.number]) for fix in fixes])
    far: Bools = apart_m > extent_m + math.sqrt(2.0 * GNC_COST) * np.array([fix.sigma_m for fix in fixes])
    return far


def _graph(
    keyframes: Sequence[Placed], links: Sequence[Link], first_sigma: tuple[float, ...], robust: Any = None
) -> tuple[Any, Any]:
    """Returns the graph, loops last and weighted by `robust`, and the initial values."""
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tied, information = _tied(keyframes[0].number, links), _scale_information(links)
    for keyframe in keyframes:
        number, pose = keyframe.number, _similarity(keyframe.T_map_keyframe, keyframe.scale)
        start.insert(number, pose)
        if keyframe is keyframes[0] or number not in tied:
            graph.add(_prior(number, pose, first_sigma if keyframe is keyframes[0] else LOOSE_SIGMA))
        if number in information:  # the scale is 1 in the mean
            right = _similarity(keyframe.T_map_keyframe, 1.0)
            graph.add(_prior(number, right, (FREE_SIGMA,) * 3 + (information[number] ** -0.5,)))
    for link in sorted(links, key=lambda link: link.loop):
        cov = 1e-12 * np.eye(4)
        cov[:3, :3] += link.cov
        cov[3, 3] = LOOP_SCALE_SIGMA**2 if link.loop else _scale_step(link)
        noise: Any = gtsam.noiseModel.Gaussian.Covariance(cov)
        if link.loop and robust is not None:
            noise = gtsam.noiseModel.Robust.Create(robust, noise)
        graph.add(
            gtsam.BetweenFactorSimilarity2(link.from_number, link.to_number, _similarity(link.T_from_to, 1.0), noise)
        )
    return graph, start


def _scale_step(link: Link) -> float:
    """Returns the variance of the change of log scale along a link.

    With `_scale_information` at both ends this is an Ornstein-Uhlenbeck process with the correlation exp(-length /
    KEPT_M) and odometry's variance.
    """
    sigma_rel, lasting = _scale_process(link)
    return 2.0 * sigma_rel**2 * math.sinh(lasting)


def _scale_information(links: Sequence[Link]) -> dict[int, float]:
    """Returns the information of each keyframe's log scale from odometry's sigma."""
    out: dict[int, float] = defaultdict(float)
    for link in links:
        if not link.loop:
            sigma_rel, lasting = _scale_process(link)
            for number in (link.from_number, link.to_number):
                out[number] += math.tanh(0.5 * lasting) / (2.0 * sigma_rel**2)
    return out


def _scale_process(link: Link) -> tuple[float, float]:
    """Returns the 1-sigma of the scale, and the link's length in correlation lengths."""
    way_m = max(math.hypot(link.T_from_to.x_m, link.T_from_to.y_m), MIN_LENGTH_M)
    return max(link.scale_rel, MIN_SCALE_REL), min(way_m / KEPT_M, 20.0)


def _prior(number: int, pose: Any, sigmas: tuple[float, ...]) -> Any:
    import gtsam

    return gtsam.PriorFactorSimilarity2(number, pose, gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas)))


def _place_factor(fix: PlaceFactor, sigma_m: float, start: Any) -> Any:
    """Returns a prior of the position; rotation and scale are free."""
    import gtsam

    guess = start.atSimilarity2(fix.number)
    scale = float(guess.scale())
    place = gtsam.Similarity2(guess.rotation(), gtsam.Point2(*np.divide(fix.xy_m, scale)), scale)
    return _prior(fix.number, place, (sigma_m / scale, sigma_m / scale, FREE_SIGMA, FREE_SIGMA))


def held(links: Sequence[Link], poses: dict[int, Solved]) -> list[Link]:
    """Returns the links without the loops that are inconsistent with the solved graph."""
    return [link for link in links if not link.loop or _chi2(link, poses) < 9.0 * DCS_PHI]


def _chi2(link: Link, poses: dict[int, Solved]) -> float:
    here, there = poses[link.from_number], poses[link.to_number]
    between = here.T_map_keyframe.between(there.T_map_keyframe).scaled(1.0 / here.scale)
    error = link.T_from_to.between(between).log()
    return float(error @ np.linalg.solve(link.cov + 1e-12 * np.eye(3), error))


def _tied(first: int, links: Sequence[Link]) -> set[int]:
    """Returns the keyframes that odometry links connect to the first."""
    neighbours: dict[int, list[int]] = {}
    for link in links:
        if link.loop:
            continue
        neighbours.setdefault(link.from_number, []).append(link.to_number)
        neighbours.setdefault(link.to_number, []).append(link.from_number)
    seen, waiting = {first}, [first]
    while waiting:
        for other in neighbours.get(waiting.pop(), []):
            if other not in seen:
                seen.add(other)
                waiting.append(other)
    return seen


def _similarity(T: SE2, scale: float) -> Any:
    """Returns gtsam's Similarity2, which maps p to scale * (R p + t)."""
    import gtsam

    return gtsam.Similarity2(gtsam.Rot2(T.yaw_rad), gtsam.Point2(T.x_m / scale, T.y_m / scale), scale)
