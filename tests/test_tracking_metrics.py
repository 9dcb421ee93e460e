"""HOTA, MOTA and ATE on cases that can be counted by hand, and the ablations."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from birdslam.bench.tracking import ablation
from birdslam.bench.tracking.benchmark import PAPER, Live, ours
from birdslam.bench.tracking.metrics import (
    BoxFrame,
    hota,
    identities,
    match_vehicles,
    path_errors,
)
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.pose_graph import PoseGraph
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.slam import SlamConfig
from birdslam.sources.label_projection import Label


def label(track: int, box: tuple[float, float, float, float], kind: str = "Car", occluded: int = 0) -> Label:
    return Label(0, track, kind, 0.0, occluded, box, 1.5, 1.7, 4.0, (0.0, 1.65, 10.0), 0.0)


def exact(labels: list[int], tracks: list[int]) -> BoxFrame:
    """A frame in which the k-th track matches the k-th label exactly."""
    return BoxFrame(np.array(labels), np.array(tracks), np.eye(len(labels), len(tracks)))


def test_errors_are_those_of_the_frames_that_both_have() -> None:
    truth = {k: SE2(float(k)) for k in range(6)}
    found = {k: SE2(k + (1.0 if k > 2 else 0.0)) for k in range(6) if k != 2}  # it jumps where it was not seen
    errors = path_errors(truth, found)
    assert errors.frames == 5
    assert errors.ate_m == pytest.approx(math.sqrt(3.0 / 5.0))
    assert path_errors(truth, {}) is None


def test_perfect_tracks_score_one() -> None:
    frames = [exact([1, 2], [10, 20]) for _ in range(5)]
    assert hota(frames) == pytest.approx(1.0)


def test_switched_id_lowers_only_association() -> None:
    frames = [exact([1], [10]) for _ in range(5)] + [exact([1], [20]) for _ in range(5)]
    # DetA 1; each true positive's association is 5 / (10 + 5 - 5)
    assert hota(frames) == pytest.approx(math.sqrt(0.5))


def test_misses_and_false_alarms_lower_detection() -> None:
    missed = [exact([1], [10]) for _ in range(5)] + [exact([1], []) for _ in range(5)]
    assert hota(missed) == pytest.approx(math.sqrt(0.5 * 0.5))
    alarms = [exact([1], [10]) for _ in range(5)] + [exact([], [99]) for _ in range(5)]
    assert hota(alarms) == pytest.approx(math.sqrt(0.5))
    assert hota([exact([], [])]) is None


def test_overlap_counts_in_steps() -> None:
    frames = [BoxFrame(np.array([1]), np.array([10]), np.array([[0.52]])) for _ in range(4)]
    assert hota(frames) == pytest.approx(10 / 19)  # the thresholds 0.05 ... 0.50 of nineteen


def test_matching_is_by_overlap_and_one_to_one() -> None:
    labels = [label(1, (0, 0, 100, 100)), label(2, (200, 0, 300, 100)), label(3, (0, 0, 100, 100), kind="Pedestrian")]
    boxes = np.array([[202.0, 0.0, 300.0, 100.0], [0.0, 5.0, 100.0, 100.0], [0.0, 40.0, 100.0, 100.0]])
    assert match_vehicles(labels, [5, 6, 7], boxes) == {1: 6, 2: 5}
    assert match_vehicles([], [5], boxes[:1]) == {}


def test_clear_mot_counts_misses_false_alarms_and_switches() -> None:
    frames = [exact([1, 2], [7, 8])] * 3 + [exact([1, 2], [8, 7])] * 2 + [exact([1], []), exact([], [7])]
    counted = identities(frames)
    assert counted.switches == 2
    assert counted.mota == pytest.approx(1.0 - (1 + 1 + counted.switches) / 11)  # a miss, a false alarm, switches


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
