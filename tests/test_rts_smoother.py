"""Smoothed vehicles: late sizes correct earlier positions, stationary and moving phases are kept."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.bench.ego.trajectory_errors import rms
from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Detections, Perception, Ready
from birdslam.road_users.rts_smoother import RtsSmoother, SmootherConfig, VehicleMeasurement, smooth_vehicle
from birdslam.types import Measurements, Status, VehicleEdge
from tests.boxes import CAR, car_px
from tests.cases import first
from tests.test_frontend import CAMERA, ScriptedOdometry, frame, motion

CONFIG = SmootherConfig()
FRAMES = 40
STEP = SE2(1.0, 0.0, 0.0)  # of the ego, a frame of 0.1 s
PARKED = SE2(75.0, 6.0, 0.0)


def oncoming(k: int) -> SE2:
    return SE2(95.0 - 0.9 * k, 4.0, math.pi)


def log_of(seed: int, parked_height_m: float, oncoming_height_m: float) -> list[Measurements]:
    """The front end's, of a car parked beside the road and of one that comes, with half a pixel of noise."""
    rng = np.random.default_rng(seed)
    front = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry({k: motion(k, STEP) for k in range(1, FRAMES)}))
    out = []
    for k in range(FRAMES):
        ego = SE2(float(k), 0.0, 0.0)
        boxes = [
            car_px(ego.between(car), height_m, CAMERA.ground)
            for car, height_m in ((PARKED, parked_height_m), (oncoming(k), oncoming_height_m))
            if ego.between(car).x_m > 8.0
        ]
        found = np.array(boxes).reshape(-1, 4) + 0.5 * rng.standard_normal((len(boxes), 4))
        detections = Detections(found, np.full(len(boxes), 0.9), ("car",) * len(boxes))
        out.append(front.measure(frame(k), Ready(Perception(detections, None, {"detector": 0}, ()))))
    return out


def errors(log: list[Measurements]) -> dict[str, tuple[float, float]]:
    """Root mean squares in metres, of the live and the smoothed estimate, for each of the two cars."""
    graph, smoother = PoseGraph(GraphConfig(), WeightsConfig()), RtsSmoother(CONFIG)
    live: dict[int, dict[int, SE2]] = {}
    for m in log:
        estimate = graph.optimise(m)
        smoother.add(m, estimate)
        for v in estimate.vehicles:
            if v.age_ns == 0:
                live.setdefault(v.vehicle, {})[m.frame_id] = v.T_world_vehicle
    found: dict[str, tuple[list[float], list[float]]] = {"parked": ([], []), "oncoming": ([], [])}
    for (epoch, vehicle), poses in smoother.smooth().items():
        assert epoch == 0
        assert poses.keys() == live[vehicle].keys()
        for k, pose in poses.items():
            beside_m = pose.y_m - (PARKED.y_m + oncoming(k).y_m) / 2.0  # the one parks farther to the left
            name, truth = ("parked", PARKED) if beside_m > 0.0 else ("oncoming", oncoming(k))
            for gaps, at in zip(found[name], (live[vehicle][k], pose), strict=True):
                gaps.append(math.hypot(at.x_m - truth.x_m, at.y_m - truth.y_m))
    return {name: (rms(np.array(at_once)), rms(np.array(later))) for name, (at_once, later) in found.items()}


@pytest.mark.parametrize("parked_height_m", first(1, [1.38, 1.46, 1.68]))
def test_known_size_improves_the_trajectory_of_a_parked_car(parked_height_m: float) -> None:
    trials = [errors(log_of(seed, parked_height_m, 1.53)) for seed in range(2)]
    live, smoothed = np.mean([t["parked"] for t in trials], axis=0)
    assert smoothed < 0.6 * live


@pytest.mark.slow  # many seeds
def test_smoothing_never_worsens_any_motion() -> None:
    heights = 1.53 * np.exp(CAR.sigma_height_rel * np.random.default_rng(0).standard_normal((5, 2)))
    trials = [errors(log_of(seed, *pair)) for seed, pair in enumerate(heights.tolist())]
    for name in ("parked", "oncoming"):
        live, smoothed = np.sqrt(np.mean(np.square([t[name] for t in trials]), axis=0))
        assert smoothed < 0.9 * live, name


def measured(
    xs_m: Floats,
    log_heights: Floats | float = 0.4,
    depth_per_height: float = 0.0,
    standing: Floats | float = 0.0,
    sigma_m: float = 1.0,
    sigma_log_height: Floats | float = 0.0,
) -> list[VehicleMeasurement]:
    """A vehicle straight ahead of a stationary ego, at `xs_m` (N,)."""
    each = np.broadcast_arrays(xs_m, log_heights, sigma_log_height, standing)
    out = []
    for k, (x_m, log_height, sigma, stands) in enumerate(zip(*(a.tolist() for a in each), strict=True)):
        T = SE2(x_m, 0.0, 0.0)
        cov = (sigma_m**2, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01)
        edge = VehicleEdge(
            vehicle=1,
            frame=k,
            T_ego_vehicle=T,
            cov=cov,
            log_height=log_height,
            sigma_log_height=sigma,
            depth_per_height=depth_per_height,
        )
        out.append(VehicleMeasurement(k, 0.1 * k, edge, SE2(), T, stands))
    return out


def replace_edge(one: VehicleMeasurement, **changes: object) -> VehicleMeasurement:
    return dataclasses.replace(one, edge=replace(one.edge, **changes))


def along(seen: list[VehicleMeasurement]) -> Floats:
    return np.array([pose.x_m for pose in smooth_vehicle(seen, CONFIG).values()])


def test_final_size_corrects_every_measurement() -> None:
    face_m, reach_m = 38.0, 2.0
    assumed = np.linspace(0.5, 0.4, 30)  # it was assumed ten percent taller than it is
    seen_m = face_m * np.exp(assumed - 0.4) + reach_m
    assert np.abs(along(measured(seen_m, assumed, depth_per_height=1.0)) - 40.0).max() < 0.05
    assert np.abs(along(measured(seen_m, assumed, depth_per_height=0.0)) - 40.0).max() > 2.0
    assert smooth_vehicle(measured(seen_m[:1], assumed[:1], 1.0), CONFIG)[0].x_m == pytest.approx(seen_m[0])


def test_unobserved_direction_of_a_truncated_car_stays_uncertain() -> None:
    """Its error is along the line of sight of the one edge that is seen, most of it by its height."""
    seen = [
        replace_edge(one, T_ego_vehicle=SE2(4.0, 3.0, 0.0), cov=(0.5, 0.6, 0.0, 0.6, 0.73, 0.0, 0.0, 0.0, 0.01))
        for one in measured(np.array([4.0, 4.0, 4.0]), 0.4, 1.0, sigma_log_height=0.5)
    ]
    for pose in smooth_vehicle(seen, CONFIG).values():
        assert np.hypot(pose.x_m - 4.0, pose.y_m - 3.0) < 0.5


def test_uncertain_final_size_moves_little() -> None:
    """As at a vehicle that leaves the image, cut by its border: 38 m of 20 % would be 8 m."""
    assumed, sigma = np.full(30, 0.4), np.geomspace(0.08, 0.02, 30)
    assumed[-1], sigma[-1] = 0.6, 0.06
    seen_m = 38.0 * np.exp(assumed - 0.4) + 2.0
    assert np.abs(along(measured(seen_m, assumed, 1.0, sigma_log_height=sigma)) - 40.0).max() < 0.1


def test_stationary_vehicle_has_one_position() -> None:
    noise = np.random.default_rng(3).standard_normal(60)
    still = along(measured(40.0 + noise, standing=0.95))
    assert np.ptp(still) < 0.3
    assert abs(still.mean() - 40.0) < 0.3
    driving_m = 40.0 + 0.8 * np.arange(60)
    told_wrong = along(measured(driving_m + noise, standing=0.95))  # its measurements contradict
    assert np.abs(told_wrong - driving_m).max() < 2.0
    assert np.abs(along(measured(driving_m + noise)) - told_wrong).max() == 0.0


def test_moving_vehicle_was_moving_just_before() -> None:
    noise = 0.3 * np.random.default_rng(4).standard_normal(40)
    x_m = 30.0 + 0.15 * np.arange(40) + noise
    standing = np.where(np.arange(40) < 4, 0.8, 0.0)  # as a filter has it at first
    assert np.abs(along(measured(x_m, standing=standing)) - along(measured(x_m))).max() == 0.0


def test_stopping_vehicle_stops() -> None:
    x_m = np.concatenate([20.0 + 1.0 * np.arange(20), np.full(30, 39.0)])
    standing = np.where(np.arange(50) < 22, 0.0, 0.97)
    found = along(measured(x_m + 0.3 * np.random.default_rng(5).standard_normal(50), standing=standing))
    assert np.ptp(found[25:]) < 0.3
    assert np.abs(found - x_m).max() < 1.5


def test_outlier_has_little_weight() -> None:
    x_m = 40.0 + 0.5 * np.arange(40)
    outlier = x_m + 25.0 * (np.arange(40) == 20)
    assert np.abs(along(measured(outlier, sigma_m=0.3)) - x_m).max() < 0.5


def test_epochs_are_separate() -> None:
    log = log_of(0, 1.5, 1.5)
    log[20] = replace(log[20], cc=None)
    graph, smoother = PoseGraph(GraphConfig(), WeightsConfig()), RtsSmoother(CONFIG)
    for m in log:
        estimate = graph.optimise(m)
        smoother.add(m, estimate)
    assert estimate.epoch == 1
    trajectories = smoother.smooth()
    assert {epoch for epoch, _ in trajectories} == {0, 1}
    for (epoch, _), poses in trajectories.items():
        assert all((k >= 20) == (epoch == 1) for k in poses)


def test_frames_without_measurements_give_none() -> None:
    smoother = RtsSmoother(CONFIG)
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    m = Measurements(frame_id=0, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, status=(Status.FRAME_UNREADABLE,))
    smoother.add(m, graph.optimise(m))
    assert smoother.smooth() == {}
