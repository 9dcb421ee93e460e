"""Removing an edge from a noise-free log keeps the poses and increases the covariances."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from birdslam.bench.tracking import ablation
from birdslam.bench.tracking.benchmark import PAPER, Live, ours
from birdslam.geometry.arrays import Floats
from birdslam.graph.pose_graph import PoseGraph
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.slam import SlamConfig

WORLD = drive(DriveConfig(frames=25, rate_hz=10.0, vehicles=2, landmarks=12, noise=0.0, traffic="convoy"), seed=2)
of_both_graphs = pytest.mark.parametrize("base", [PAPER, ours(SlamConfig())], ids=["paper", "birdslam"])


def known(method: Live) -> tuple[Floats, Floats]:
    """(frames, 3, 3) covariances of the ego, and of both vehicles against it as the window has them (2, 3, 3)."""
    graph = PoseGraph(method.graph, method.weights)
    estimates = [graph.optimise(method.reweighed(m)) for m in WORLD.measurements]
    window = graph.window
    vehicles = [window.P[np.ix_(rows, rows)] for rows in window.layout.poses]
    return np.array([np.reshape(e.cov, (3, 3)) for e in estimates]), np.array(vehicles)


def grows(less: Floats, more: Floats) -> float:
    """By what factor the total variance grew; the covariances are asserted to shrink in no direction."""
    gap = np.linalg.eigvalsh(less - more).min(axis=-1)
    assert (gap >= -1e-6 * np.trace(less, axis1=-2, axis2=-1)).all()
    return float(np.trace(less[-1]) / np.trace(more[-1]))


@of_both_graphs
@pytest.mark.parametrize("edge", ["cc", "cp", "cv", "vv"])
def test_removing_an_edge_increases_the_covariance(base: Live, edge: str) -> None:
    (ego, vehicles), (ego_all, vehicles_all) = (
        known(ablation.constraint_variants(base)[name]) for name in (f"without_{edge}", "all")
    )
    of_ego, of_vehicles = grows(ego, ego_all), grows(vehicles, vehicles_all)
    assert (of_ego if edge in ("cc", "cp") else of_vehicles) > 1.0001  # more than rounding


@of_both_graphs
def test_information_of_landmarks_follows_weight_and_depth(base: Live) -> None:
    variants = ablation.landmark_variants(base)
    for names in (ablation.CP_WEIGHTS, ablation.DEPTHS_M):
        egos = [known(variants[name])[0] for name in names]
        for less, more in pairwise(egos):
            grows(less, more)
        assert grows(egos[0], egos[-1]) > 1.0001  # little with what is common to all landmarks, but more than rounding
