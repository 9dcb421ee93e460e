"""ATE and RPE against evo; HOTA and IDF1 on cases that can be counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given
from hypothesis import strategies as st

from birdslam.bench.tracking.metrics import (
    BoxFrame,
    count_boxes,
    hota,
    hota_parts,
    identities,
    idf1,
    match_vehicles,
    path_errors,
)
from birdslam.geometry.se2 import SE2
from birdslam.sources.label_projection import Label
from birdslam.trajectory import ego_pose
from birdslam.types import Attitude


def label(track: int, box: tuple[float, float, float, float], kind: str = "Car", occluded: int = 0) -> Label:
    return Label(0, track, kind, 0.0, occluded, box, 1.5, 1.7, 4.0, (0.0, 1.65, 10.0), 0.0)


def exact(labels: list[int], tracks: list[int]) -> BoxFrame:
    """A frame in which the k-th track lies exactly on the k-th label."""
    return BoxFrame(np.array(labels), np.array(tracks), np.eye(len(labels), len(tracks)))


def test_errors_agree_with_evo() -> None:
    rng = np.random.default_rng(3)
    truth = {k: SE2(0.9 * k, 0.05 * k * k, 0.02 * k) for k in range(40)}
    found = {k: pose @ SE2(*rng.normal(0.0, [0.3, 0.2, 0.01])) for k, pose in truth.items()}
    errors = path_errors(truth, found)
    assert errors is not None
    reference, estimate = (
        PosePath3D(poses_se3=[ego_pose(p[k], Attitude()) for k in range(40)]) for p in (truth, found)
    )
    for relation, value in (
        (metrics.PoseRelation.translation_part, errors.rpe_t_m),
        (metrics.PoseRelation.rotation_angle_deg, errors.rpe_r_deg),
    ):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames, all_pairs=False)
        rpe.process_data((reference, estimate))
        assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    assert errors.ate_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


def test_relative_errors_leave_out_gaps() -> None:
    truth = {k: SE2(float(k)) for k in range(6)}
    found = {k: SE2(k + (1.0 if k > 2 else 0.0)) for k in range(6) if k != 2}  # it jumps where it was not seen
    errors = path_errors(truth, found)
    assert errors is not None
    assert errors.frames == 5
    assert errors.rpe_t_m == pytest.approx(0.0)
    assert errors.motion_error_m == pytest.approx(0.0)
    assert errors.ate_m == pytest.approx(math.sqrt(3.0 / 5.0))
    assert path_errors(truth, {}) is None
    alone = path_errors(truth, {0: SE2()})
    assert alone is not None
    assert (alone.ate_m, alone.rpe_t_m) == (0.0, None)


def test_perfect_tracks_score_one() -> None:
    frames = [exact([1, 2], [10, 20]) for _ in range(5)]
    assert hota(frames) == pytest.approx(1.0)
    assert idf1(frames) == pytest.approx(1.0)


def test_a_switched_id_costs_association_alone() -> None:
    frames = [exact([1], [10]) for _ in range(5)] + [exact([1], [20]) for _ in range(5)]
    assert idf1(frames) == pytest.approx(0.5)  # 5 of 10 labels and 5 of 10 boxes keep one identity
    # DetA 1; each true positive's association is 5 / (10 + 5 - 5)
    assert hota(frames) == pytest.approx(math.sqrt(0.5))


def test_misses_and_false_alarms_cost_detection() -> None:
    missed = [exact([1], [10]) for _ in range(5)] + [exact([1], []) for _ in range(5)]
    assert idf1(missed) == pytest.approx(2 * 5 / 15)
    assert hota(missed) == pytest.approx(math.sqrt(0.5 * 0.5))
    alarms = [exact([1], [10]) for _ in range(5)] + [exact([], [99]) for _ in range(5)]
    assert hota(alarms) == pytest.approx(math.sqrt(0.5))
    assert hota([exact([], [])]) is None
    assert idf1([]) is None


def test_overlap_counts_in_steps() -> None:
    frames = [BoxFrame(np.array([1]), np.array([10]), np.array([[0.52]])) for _ in range(4)]
    assert hota(frames) == pytest.approx(10 / 19)  # the thresholds 0.05 ... 0.50 of nineteen


def test_matching_is_by_overlap_and_one_to_one() -> None:
    labels = [label(1, (0, 0, 100, 100)), label(2, (200, 0, 300, 100)), label(3, (0, 0, 100, 100), kind="Pedestrian")]
    boxes = np.array([[202.0, 0.0, 300.0, 100.0], [0.0, 5.0, 100.0, 100.0], [0.0, 40.0, 100.0, 100.0]])
    assert match_vehicles(labels, [5, 6, 7], boxes) == {1: 6, 2: 5}
    assert match_vehicles([], [5], boxes[:1]) == {}


def test_what_counts_follows_kitti() -> None:
    labels = [
        label(1, (0, 0, 100, 100)),
        label(2, (200, 0, 300, 100), kind="Van"),
        label(-1, (400, 0, 500, 100), kind="DontCare"),
        label(4, (700, 0, 800, 100), occluded=3),
    ]
    boxes = np.array(
        [
            [0.0, 0.0, 100.0, 100.0],  # on the car
            [200.0, 0.0, 300.0, 100.0],  # on a van: left out
            [410.0, 10.0, 490.0, 90.0],  # in a region that nobody labelled: left out
            [600.0, 0.0, 620.0, 20.0],  # a false alarm too low to count
            [600.0, 200.0, 700.0, 300.0],  # a false alarm
            [700.0, 0.0, 800.0, 100.0],  # on a car that is hardly seen: neither hit nor alarm
        ]
    )
    counted = count_boxes(labels, [10, 11, 12, 13, 14, 15], boxes)
    assert counted.labels.tolist() == [1]
    assert counted.tracks.tolist() == [10, 14]
    np.testing.assert_allclose(counted.overlap, [[1.0, 0.0]])
    empty = count_boxes([], [], np.zeros((0, 4)))
    assert empty.overlap.shape == (0, 0)


def test_clear_mot_counts_misses_false_alarms_and_switches() -> None:
    frames = [exact([1, 2], [7, 8])] * 3 + [exact([1, 2], [8, 7])] * 2 + [exact([1], []), exact([], [7])]
    counted = identities(frames)
    assert counted.switches == 2
    assert counted.mota == pytest.approx(1.0 - (1 + 1 + counted.switches) / 11)  # a miss, a false alarm, switches
    assert counted.idf1 == pytest.approx(idf1(frames))


@given(seed=st.integers(0, 1000))
def test_idf1_of_the_papers_tables_is_that_of_motmetrics(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(12):
        labels, tracks = (rng.permutation(5)[: rng.integers(0, 5)] for _ in range(2))
        frames.append(BoxFrame(labels, tracks, rng.uniform(0.0, 1.0, (len(labels), len(tracks)))))
    assert identities(frames).idf1 == pytest.approx(idf1(frames) or 0.0)


def test_hota_has_its_parts() -> None:
    parts = hota_parts([exact([1], [7])] * 4)
    assert parts is not None
    assert (parts.hota, parts.det_a, parts.ass_a, parts.loc_a) == pytest.approx((1.0,) * 4)
