"""CP edges of lanes: invariant to the viewpoint, observable across the lane only, consistent."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.lanes.amodal.lane_edges import LaneEdgesConfig, Station, fit_stations, lane_stations
from birdslam.types import Estimate, LandmarkEdge, LandmarkKind, Measurements
from tests.records import step_at

CONFIG = LaneEdgesConfig()
CAMERA = Camera(
    width_px=1242, height_px=375, fx_px=720.0, fy_px=720.0, cx_px=610.0, cy_px=173.0, height_m=1.65, pitch_rad=0.01
)

ALL_EDGES = WeightsConfig(leave_out=())


def line(yaw_rad: float, aside_m: float, start_m: float = 5.0, end_m: float = 15.0) -> Floats:
    """Points in the ego of the one that looks along x."""
    x = np.arange(start_m, end_m, 0.25)
    return SE2(0.0, 0.0, yaw_rad) @ np.column_stack([x, np.full(len(x), aside_m)])


def found(T_world_ego: SE2, points_ego_m: Floats, lane: int = 3) -> list[Station]:
    points, lanes = T_world_ego @ points_ego_m, np.full(len(points_ego_m), lane)
    return lane_stations(points, lanes, T_world_ego, CAMERA, CAMERA.ground, 0.003, 0.02, CONFIG)


@given(st.floats(-math.pi, math.pi), st.floats(-4.0, 4.0), st.floats(0.0, 6.0))
def test_station_is_the_same_world_point_from_any_pose(yaw_rad: float, aside_m: float, step_m: float) -> None:
    world = SE2(3.0, -2.0, yaw_rad) @ line(0.0, aside_m, 0.0, 40.0)
    seen = {}
    for at in (SE2(3.0, -2.0, yaw_rad), SE2(3.0, -2.0, yaw_rad) @ SE2(step_m, 0.3, 0.05)):
        ego = at.inverse() @ world
        near = ego[(ego[:, 0] > 4.0) & (ego[:, 0] < 20.0)]
        for station in found(at, near):
            assert station.edge(0, at).kind is LandmarkKind.LANE_STATION
            if station.landmark in seen:
                np.testing.assert_allclose(station.point_m, seen[station.landmark], atol=1e-9)
            seen[station.landmark] = station.point_m
    assert len(seen) >= 2
    assert len({tuple(np.round(p, 3)) for p in seen.values()}) == len(seen)


@given(st.floats(-1.2, 1.2), st.floats(-3.0, 3.0))
def test_covariance_is_small_across_and_infinite_along_the_lane(yaw_rad: float, aside_m: float) -> None:
    for station in found(SE2(), line(yaw_rad, aside_m, 5.0, 25.0)):
        edge = station.edge(4, SE2())
        cov = np.reshape(edge.cov, (2, 2))
        along = np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        across = np.array([-along[1], along[0]])
        assert along @ cov @ along == pytest.approx(CONFIG.sigma_along_m**2)
        assert CONFIG.sigma_across_m**2 <= across @ cov @ across < 1.0
        assert abs(along @ cov @ across) < 1e-6


def test_two_lanes_have_different_landmarks() -> None:
    points = np.concatenate([line(0.0, 2.0), line(0.0, -2.0)])
    lanes = np.repeat([5, 6], [len(line(0.0, 2.0))] * 2)
    both, one = fit_stations(points, lanes, CONFIG), fit_stations(points[lanes == 5], lanes[lanes == 5], CONFIG)
    assert one
    assert len({landmark for landmark, _, _ in both}) == len(both) == 2 * len(one)
    assert fit_stations(points, np.full(len(points), -1), CONFIG) == []


def test_short_lanes_and_blobs_have_no_station() -> None:
    assert found(SE2(), line(0.0, 1.0, 5.0, 7.0)) == []  # no stretch of 4 m is spanned
    blot = np.random.default_rng(0).uniform([8.0, -0.7], [12.0, 0.7], (200, 2))
    assert found(SE2(), blot) == []


def drive(seed: int, edges: bool, weights: WeightsConfig, frames: int = 120) -> tuple[float, float]:
    """RMS of the ego's place and the mean of its squared error over its covariance, lanes seen with noise or not."""
    rng = np.random.default_rng(seed)
    graph, truth, odometry = PoseGraph(GraphConfig(), weights), SE2(), SE2()
    step, sigma = SE2(1.0, 0.0, 0.004), np.array([0.02, 0.02, 0.001])
    errors, nees = [], []
    for k in range(frames):
        noisy, cp = None, ()
        if k:
            noisy = step @ SE2(*(rng.standard_normal(3) * sigma).tolist())
            truth, odometry = truth @ step, odometry @ noisy
        if edges and k:
            # Both lines are seen from where the ego truly is, with an error of height and pitch common to the frame
            common_m, own_m = rng.standard_normal(), rng.standard_normal(2) * CONFIG.sigma_across_m
            seen = []
            for lane, aside_m in enumerate((-2.0, 2.0)):
                x = np.arange(k - 2.0, k + 24.0, 0.25)
                bent = [SE2.exp(np.array([s, 0.0, 0.004 * s])) @ np.array([[0.0, aside_m]]) for s in x]
                near = truth.inverse() @ np.concatenate(bent)
                near = near[(near[:, 0] > 5.0) & (near[:, 0] < 17.0)]
                near[:, 1] += own_m[lane] + 0.02 * common_m * aside_m
                seen += [s.edge(k, odometry) for s in found(odometry, near, lane)]
            cp = tuple(seen)
        estimate = graph.optimise(step_at(k, noisy, cov=tuple(np.diag(sigma**2).ravel().tolist()), cp=cp))
        if k:
            e = np.array((estimate.T_world_ego.between(truth)).log())
            errors.append(math.hypot(e[0], e[1]))
            nees.append(e @ np.linalg.solve(np.reshape(estimate.cov, (3, 3)), e) / 3.0)
    return math.sqrt(np.mean(np.square(errors))), float(np.mean(nees))


@pytest.mark.slow  # six drives, with and without
def test_lanes_keep_the_ego_accurate_and_consistent() -> None:
    """Over six drives; by how much they help is not asked: odometry is surer than a marking within a window."""
    measured = ALL_EDGES
    without = np.array([drive(seed, False, measured) for seed in range(6)])
    with_lanes = np.array([drive(seed, True, measured) for seed in range(6)])
    assert with_lanes[:, 0].mean() < 1.01 * without[:, 0].mean()
    assert not np.array_equal(with_lanes, without)  # they do enter the graph
    assert 0.5 < with_lanes[:, 1].mean() < 1.5


def test_leaving_out_lanes_keeps_road_points() -> None:
    corner = LandmarkEdge(landmark=7, frame=0, x_m=5.0, y_m=1.0, cov=(0.1, 0.0, 0.0, 0.1))
    (station, *_) = found(SE2(), line(0.0, 1.0))
    record = Measurements(frame_id=0, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, cp=(corner, station.edge(0, SE2())))
    assert weighted(record, ALL_EDGES) == record
    assert weighted(record, WeightsConfig()).cp == weighted(record, WeightsConfig(leave_out=("lanes",))).cp == (corner,)
    assert weighted(record, WeightsConfig(leave_out=("cp",))).cp == ()


def test_station_and_road_point_with_equal_id_are_distinct() -> None:
    """Distinguished only by kind: the graph uses both, with the same result as with different ids."""

    def estimates(station_id: int) -> list[Estimate]:
        graph, out = PoseGraph(GraphConfig(ego_nodes=1), ALL_EDGES), []
        for k in range(4):
            corner = LandmarkEdge(landmark=7, frame=k, x_m=9.1 - k, y_m=1.0, cov=(0.01, 0.0, 0.0, 0.01))
            station = LandmarkEdge(
                landmark=station_id, frame=k, x_m=7.0 - k, y_m=-1.0, cov=(0.01, 0.0, 0.0, 0.01), kind=LandmarkKind(1)
            )
            out.append(graph.optimise(step_at(k, SE2(1.0), 1e-2, cp=(corner, station))))
        assert len(graph.factors[-1]) == 2
        return out

    assert estimates(7) == estimates(8)


def test_lane_is_not_a_landmark_on_the_map() -> None:
    graph = PoseGraph(GraphConfig(ego_nodes=1, landmark_least_frames=1), ALL_EDGES)
    for k in range(6):
        corner = LandmarkEdge(landmark=7, frame=k, x_m=9.0 - k, y_m=1.0, cov=(0.1, 0.0, 0.0, 0.1))
        lanes = tuple(s.edge(k, SE2(float(k))) for s in found(SE2(float(k)), line(0.0, 1.0)))
        cp = (corner, *lanes) if k < 3 else ()
        graph.optimise(step_at(k, SE2(1.0), 1e-4, cp=cp))
    gained = graph.map_update()
    assert len(gained.landmarks_m) == 1
