"""Each baseline recovers a noise-free world and has its specific properties."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from birdslam.bench.baselines import batch_se3, cubeslam, nair, namdev
from birdslam.bench.baselines.posegraph3 import solve_batch
from birdslam.bench.baselines.trajectories import LiveTrajectories, Trajectories, dead_reckoned
from birdslam.geometry.se2 import SE2
from birdslam.perf.latency import optimizer
from birdslam.perf.latency.drive import Drive, DriveConfig, drive
from birdslam.types import Estimate, Measurements, VehicleEdge
from tests.recordings import KITTI as CAMERA
from tests.records import new_estimate, step_at

QUIET = DriveConfig(frames=40, rate_hz=10.0, vehicles=3, landmarks=8, lane_points=0, noise=0.0)
HEIGHT_M = 1.5
UNIT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def boxed(log: list[Measurements]) -> list[Measurements]:
    """The log with boxes of cars that are HEIGHT_M high and fill their outline."""

    def with_box(edge: VehicleEdge) -> VehicleEdge:
        T, half = edge.T_ego_vehicle, np.array([edge.length_m, edge.width_m]) / 2.0
        corners = np.array([T @ np.array([sx * half[0], sy * half[1]]) for sx in (-1, 1) for sy in (-1, 1)])
        near_m = float(corners[:, 0].min())
        u = CAMERA.cx_px - CAMERA.fx_px * corners[:, 1] / corners[:, 0]
        v = CAMERA.cy_px + CAMERA.fy_px * np.array([CAMERA.height_m - HEIGHT_M, CAMERA.height_m]) / near_m
        return msgspec.structs.replace(edge, box_px=(float(u.min()), float(v.min()), float(u.max()), float(v.max())))

    return [msgspec.structs.replace(m, cv=tuple(with_box(edge) for edge in m.cv)) for m in log]


@pytest.fixture(scope="module")
def world() -> Drive:
    found = drive(QUIET, seed=4)
    return replace(found, measurements=boxed(found.measurements))


def worst_m(world: Drive, result: Trajectories) -> tuple[float, float]:
    ego = max(math.hypot(*(world.ego[f, :2] - [p.x_m, p.y_m])) for f, p in result.ego.items())
    cars = [
        math.hypot(*(world.vehicles[vehicle][frame, :2] - [pose.x_m, pose.y_m]))
        for vehicle, poses in result.vehicles.items()
        for frame, pose in poses.items()
    ]
    return ego, max(cars)


@pytest.mark.parametrize("method", [nair, batch_se3], ids=lambda module: module.__name__)
def test_a_world_without_noise_is_recovered(world: Drive, method) -> None:
    result = method.run(world.measurements, CAMERA)
    assert set(result.ego) == set(range(QUIET.frames))
    assert {(v, f) for v, poses in result.vehicles.items() for f in poses} == {
        (edge.vehicle, edge.frame) for m in world.measurements for edge in m.cv
    }
    ego_m, car_m = worst_m(world, result)
    assert ego_m < 0.05
    assert car_m < 0.05


def test_the_batch_estimates_the_scale(world: Drive) -> None:
    """Whatever unit the odometry has, the answer is in metres."""
    factor = 0.25
    scaled = [
        m
        if m.cc is None
        else msgspec.structs.replace(
            m,
            cc=msgspec.structs.replace(
                m.cc, T_from_to=SE2(m.cc.T_from_to.x_m * factor, m.cc.T_from_to.y_m * factor, m.cc.T_from_to.yaw_rad)
            ),
        )
        for m in world.measurements
    ]
    ego_m, _ = worst_m(world, batch_se3.run(scaled, CAMERA))
    assert ego_m < 0.05
    assert worst_m(world, nair.run(scaled, CAMERA))[0] > 1.0  # which takes the odometry's word


def test_a_solver_at_its_cap_says_so_and_one_that_converged_stays() -> None:
    log = drive(msgspec.structs.replace(QUIET, noise=1.0), seed=4).measurements
    _, cut = solve_batch(log, msgspec.structs.replace(batch_se3.CONFIG, iterations=2), check=True)
    assert (cut.iterations, cut.at_cap, cut.converged) == (2, True, False)
    _, done = solve_batch(log, batch_se3.CONFIG, check=True)
    assert done.converged
    assert done.step < 0.01 * cut.step
    assert done.iterations < batch_se3.CONFIG.iterations
    assert solve_batch([], batch_se3.CONFIG)[1].iterations == 0


def test_a_batch_stopped_at_its_cap_gets_no_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    log = drive(msgspec.structs.replace(QUIET, noise=1.0), seed=4).measurements
    monkeypatch.setattr(batch_se3, "CONFIG", msgspec.structs.replace(batch_se3.CONFIG, iterations=2))
    monkeypatch.setattr(optimizer, "REPEATS", 1)
    rows = {row["method"]: row for row in optimizer.batch_rows(log)}
    assert rows["batch SE(3), unscaled odometry, lanes"]["ratio"] is None
    assert rows["batch SE(3), metric odometry"]["ratio"] > 0.0


def test_an_unknown_position_is_missing_in_the_batch(world: Drive) -> None:
    """A box cut to a sliver stands anywhere, and the paper's weights can't say so."""
    log = list(world.measurements)
    first, *others = log[20].cv
    far, vague = SE2(180.0, 150.0, 3.0), (1e4, 0.0, 0.0, 0.0, 1e4, 0.0, 0.0, 0.0, 0.1)
    sliver = msgspec.structs.replace(first, T_ego_vehicle=far, cov=vague)
    log[20] = msgspec.structs.replace(log[20], cv=(sliver, *others))
    result = batch_se3.run(log, CAMERA)
    assert 20 not in result.vehicles[first.vehicle]
    ego_m, car_m = worst_m(world, result)
    assert ego_m < 0.05
    assert car_m < 0.05


def test_lanes_can_be_left_out(world: Drive) -> None:
    """Lane points that lie pull the ego aside; left out, they are as if the log had none."""
    lying = [
        msgspec.structs.replace(m, cp=tuple(msgspec.structs.replace(e, y_m=e.y_m + 0.02 * m.frame_id) for e in m.cp))
        for m in world.measurements
    ]
    without = [msgspec.structs.replace(m, cp=()) for m in world.measurements]
    assert worst_m(world, batch_se3.run(lying, CAMERA))[0] > 0.5
    assert worst_m(world, batch_se3.run(lying, CAMERA, lanes=False))[0] < 0.05
    assert batch_se3.run(lying, CAMERA, lanes=False) == batch_se3.run(without, CAMERA)


def test_lanes_correct_lateral_odometry_drift() -> None:
    """Exact landmarks take back most of what an odometry adds sideways; without them it stays."""
    world = drive(msgspec.structs.replace(QUIET, vehicles=1), seed=4)
    sliding = [
        m
        if m.cc is None
        else msgspec.structs.replace(
            m, cc=msgspec.structs.replace(m.cc, T_from_to=m.cc.T_from_to @ SE2(0.0, 0.03, 0.0))
        )
        for m in world.measurements
    ]
    with_m, without_m = (worst_m(world, batch_se3.run(sliding, CAMERA, lanes))[0] for lanes in (True, False))
    assert without_m > 0.5
    assert with_m < 0.7 * without_m


def test_cuboids_are_recovered_from_boxes_of_known_size(world: Drive) -> None:
    config = cubeslam.CuboidConfig(height_m=HEIGHT_M)
    for edge in (edge for m in world.measurements for edge in m.cv):
        turned = msgspec.structs.replace(edge, T_ego_vehicle=SE2(0.0, 0.0, edge.T_ego_vehicle.yaw_rad))
        found = cubeslam.cuboid(turned, CAMERA, config).T_ego_vehicle
        assert math.hypot(found.x_m - edge.T_ego_vehicle.x_m, found.y_m - edge.T_ego_vehicle.y_m) < 0.01
    ego_m, car_m = worst_m(world, cubeslam.run(world.measurements, CAMERA, config))
    assert ego_m < 0.2
    assert car_m < 2.5  # a car that changes lanes without turning its nose is not in its motion model


def test_namdev_estimates_the_scale_from_a_stationary_car() -> None:
    """The ego speeds up: only one scale leaves the car where it is, whatever the prior on its size."""
    steps = [SE2(0.5 + 0.03 * k, 0.0, 0.02 * math.sin(0.3 * k)) for k in range(40)]
    ego, place, log = SE2(), SE2(45.0, 4.0), []
    for k, step in enumerate(steps):
        T = ego.between(place)
        column_px, foot_px = CAMERA.cx_px - CAMERA.fx_px * T.y_m / T.x_m, CAMERA.fy_px * HEIGHT_M / T.x_m
        box_px = (column_px - 5.0, 0.0, column_px + 5.0, foot_px)
        seen = VehicleEdge(vehicle=1, frame=k, T_ego_vehicle=T, cov=UNIT, box_px=box_px)
        log.append(step_at(k, steps[k - 1], 1.0, t_source_ns=k, cv=(seen,)))
        ego = ego @ step
    config = namdev.NamdevConfig(start_height_m=2.5, sigma_height_m=1.0, sigma_depth_rel=0.001)
    poses = namdev.run(log, CAMERA, config).vehicles[1]
    assert max(math.hypot(p.x_m - place.x_m, p.y_m - place.y_m) for p in poses.values()) < 0.5


def test_an_empty_log_gives_an_empty_result() -> None:
    for method in (nair, batch_se3, namdev, cubeslam):
        assert method.run([], CAMERA) == Trajectories()


def test_a_new_epoch_goes_on_where_the_last_one_ended() -> None:
    live = LiveTrajectories()
    cov = (0.0,) * 9

    def estimate(frame: int, epoch: int, pose: SE2) -> Estimate:
        return new_estimate(epoch=epoch, frame_id=frame, T_world_ego=pose, cov=cov)

    for frame, epoch, x_m in ((0, 0, 0.0), (1, 0, 2.0), (2, 1, 0.0), (3, 1, 1.5)):
        live.add(estimate(frame, epoch, SE2(x_m)))
    assert [live.result.ego[k].x_m for k in range(4)] == [0.0, 2.0, 2.0, 3.5]


def test_dead_reckoning_chains_the_odometry(world: Drive) -> None:
    ego_m, car_m = worst_m(world, dead_reckoned(world.measurements))
    assert ego_m < 1e-6
    assert car_m < 1e-6


def test_cp_of_vehicles_holds_them_in_the_batch_where_they_were_seen(world: Drive) -> None:
    """Eq. 7 with A a vehicle: of an exact log nothing moves, and one sight that is off counts by CP's weight too."""
    plain = msgspec.structs.replace(nair.CONFIG, landmarks=True)
    more = msgspec.structs.replace(plain, weights=msgspec.structs.replace(plain.weights, cp_vehicles=10_000.0))
    assert max(worst_m(world, solve_batch(world.measurements, more)[0])) < 0.05
    log, middle = list(world.measurements), QUIET.frames // 2
    edge = max(log[middle].cv, key=lambda e: e.T_ego_vehicle.x_m)
    off = msgspec.structs.replace(edge, T_ego_vehicle=SE2(1.0) @ edge.T_ego_vehicle)
    log[middle] = msgspec.structs.replace(
        log[middle], cv=tuple(off if e.vehicle == edge.vehicle else e for e in log[middle].cv)
    )
    left_m = []
    for config in (plain, more):
        result = solve_batch(log, config)[0]
        told = result.ego[middle] @ off.T_ego_vehicle
        found = result.vehicles[edge.vehicle][middle]
        left_m.append(math.hypot(found.x_m - told.x_m, found.y_m - told.y_m))
    assert left_m[1] < 0.1 * left_m[0]
