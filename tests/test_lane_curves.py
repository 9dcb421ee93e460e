"""Lane lines as curves in the graph: sideways and in heading, never along."""

import numpy as np
import pytest

from birdslam.bench.simulation.drive import DriveConfig, drive
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.graph.lane_curves import EgoOnLines, OnCurve, SeenCurve, VehiclesOnLanes

SETTINGS = GraphConfig(), WeightsConfig()
LOG = drive(DriveConfig(frames=60, vehicles=3, landmarks=8), 3).measurements
LINE = np.arange(3.0, 25.0)


def last(factor, records):
    graph = PoseGraph(*SETTINGS, factors=[*standard_factors(*SETTINGS), factor])
    for m in LOG:
        estimate = graph.optimise(m, records.get(m.frame_id, ()))
    return graph, estimate


def seen(at: SE2, first: SE2, aside_m: float = 0.0) -> SeenCurve:
    """What a pose sees of the line 2 m to the left of the axis of `first`, `aside_m` too far to the left."""
    T = at.inverse() @ first
    x, y = np.linspace(-60.0, 60.0, 500), np.full(500, 2.0)
    c, s = np.cos(T.yaw_rad), np.sin(T.yaw_rad)
    there = T.x_m + c * x - s * y, T.y_m + s * x + c * y
    return SeenCurve(7, LINE, np.interp(LINE, *there) + aside_m, np.diag([1e-4, 1e-4]))


def test_a_line_that_is_where_it_was_leaves_the_ego_there() -> None:
    estimates = _poses()
    first, end = estimates[-40], estimates[-1]
    records = {LOG[-40].frame_id: (seen(first, first),), LOG[-1].frame_id: (seen(end, first),)}
    _, held = last(EgoOnLines(), records)
    assert end.between(held.T_world_ego).log() == pytest.approx(np.zeros(3), abs=1e-3)


def test_a_line_farther_to_the_left_moves_the_ego_to_the_right_and_not_along() -> None:
    estimates = _poses()
    first, end = estimates[-40], estimates[-1]
    records = {LOG[-40].frame_id: (seen(first, first),), LOG[-1].frame_id: (seen(end, first, 0.1),)}
    _, held = last(EgoOnLines(), records)
    x, y, _ = end.between(held.T_world_ego).log()
    assert y < -0.01
    assert abs(x) < 0.3 * abs(y)


def test_a_vehicle_in_a_lane_is_pulled_across_it() -> None:
    graph, _ = last(VehiclesOnLanes(), {})
    (vehicle, (T, _)), *_ = graph.vehicles_in_ego().items()
    foot = T @ SE2(0.0, 0.3, 0.0)
    graph, _ = last(VehiclesOnLanes(), {LOG[-1].frame_id: (OnCurve(vehicle, foot, 1e-3, 10.0),)})
    moved = T.between(graph.vehicles_in_ego()[vehicle][0])
    assert moved.y_m == pytest.approx(0.3, abs=0.05)


def _poses() -> list[SE2]:
    graph = PoseGraph(*SETTINGS)
    return [graph.optimise(m).T_world_ego for m in LOG]
