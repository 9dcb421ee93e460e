"""A drive's graph as g2o, read back by gtsam: the same poses, edges and information."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.graph.g2o import g2o_lines
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.types import Measurements
from tests.batch_se2 import ego_key, solve

CONFIG = DriveConfig(frames=30, rate_hz=10.0, vehicles=2, landmarks=6, traffic="convoy")
LOG = drive(CONFIG, 3).measurements
ALL_EDGES = WeightsConfig(leave_out=())


def lines(log: list[Measurements], weights: WeightsConfig = ALL_EDGES) -> list[list[str]]:
    return [line.split() for line in g2o_lines(log, weights)]


def test_gtsam_reads_the_file_and_finds_the_batch_poses(tmp_path: Path) -> None:
    log = [replace(m, cp=()) for m in LOG]
    path = tmp_path / "drive.g2o"
    path.write_text("\n".join(g2o_lines(log, ALL_EDGES)) + "\n")
    graph, values = gtsam.readG2o(str(path), False)
    assert graph.size() == sum((m.cc is not None) + len(m.cv) + len(m.vv) for m in log)
    egos = [int(line[1]) for line in lines(log) if line[0] == "FIX"]
    assert egos == [0]
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    batch = solve(log, GraphConfig(constant_velocity=False), ALL_EDGES)
    marginals = [gtsam.Marginals(*both) for both in ((graph, found), (batch.factors, batch.values))]
    first_of_frame = {}
    vertex = [line for line in lines(log) if line[0] == "VERTEX_SE2"]
    at = 0
    for m in log:
        first_of_frame[m.frame_id] = int(vertex[at][1])
        at += 1 + len(m.cv)
    for frame in (10, 29):
        key, ours = first_of_frame[frame], batch.ego(frame)
        pose = found.atPose2(key)
        assert [pose.x(), pose.y(), pose.theta()] == pytest.approx([ours.x_m, ours.y_m, ours.yaw_rad], abs=1e-4)
        covs = marginals[0].marginalCovariance(key), marginals[1].marginalCovariance(ego_key(frame))
        np.testing.assert_allclose(*covs, rtol=1e-3, atol=1e-9)


def test_each_observation_of_a_landmark_is_an_edge() -> None:
    found = lines(LOG, replace(ALL_EDGES, depth_threshold_m=None))
    sights = [line for line in found if line[0] == "EDGE_SE2_XY"]
    assert len(sights) == sum(len(m.cp) for m in LOG)
    assert len([line for line in found if line[0] == "VERTEX_XY"]) == len({e.landmark for m in LOG for e in m.cp})
    assert [float(n) for n in sights[0][5:]] == pytest.approx([400.0, 0.0, 400.0])  # 1 / (5 cm)^2


def test_invalid_edges_are_left_out() -> None:
    log = list(LOG)
    log[9] = replace(
        log[9], cv=(replace(log[9].cv[0], cov=(1.0, 9.0, 0.0, 9.0, 1.0, 0.0, 0.0, 0.0, 1.0)), *log[9].cv[1:])
    )
    assert len([line for line in lines(log) if line[0] == "VERTEX_SE2"]) == 3 * CONFIG.frames - 1
    log[20] = replace(log[20], cc=None, cv=(), vv=(), cp=())
    found = lines(log)
    assert all(np.isfinite([float(n) for n in line[1:]]).all() for line in found)
    assert [line[0] for line in found].count("FIX") == 2  # the first pose, and that after the gap
