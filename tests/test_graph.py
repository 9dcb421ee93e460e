"""The pose graph on simulated drives: the truth, epochs, vehicles, the map, bounds. More in test_consistency."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.bench.baselines.posegraph3 import BatchConfig
from birdslam.geometry.arrays import Floats
from birdslam.geometry.planar import between
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.landmark_points import SHARED_VARIANCE_RATIO, LandmarkPoints, sum_of_points
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.state_layout import StateLayout
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.__main__ import main as perf_main
from birdslam.perf.latency import optimizer
from birdslam.perf.latency.drive import Drive, DriveConfig, drive
from birdslam.perf.latency.optimizer import CONTENDERS
from birdslam.types import Estimate, LandmarkEdge, LanePoint, Measurements, Status
from tests.records import step_at

ALL_EDGES = WeightsConfig(leave_out=())
EQ_6 = GraphConfig(
    constant_velocity=False, detection_gate_sigma=1e3
)  # the paper's graph, and nothing counts as an outlier
NO_CP = DriveConfig(landmarks=0, lane_points=0)


def run(
    measurements: Iterable[Measurements], config: GraphConfig = EQ_6, weights: WeightsConfig = ALL_EDGES
) -> list[Estimate]:
    graph = PoseGraph(config, weights)
    return [graph.optimise(m) for m in measurements]


def numbers(pose: SE2) -> Floats:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])


def off(estimate: SE2, truth: Floats) -> Floats:
    """The error in the estimate's own tangent."""
    return between(numbers(estimate), truth)


def seen(estimate: Estimate) -> dict[int, SE2]:
    return {v.vehicle: v.T_world_vehicle for v in estimate.vehicles if v.age_ns == 0}


# --- the truth ---


@pytest.mark.parametrize("drop", [0.0, 0.3])
def test_a_world_without_noise_is_recovered_exactly(drop: float) -> None:
    world = drive(DriveConfig(frames=100, noise=0.0, drop=drop), seed=5)
    assert (len(world.measurements) < 80) == (drop > 0)
    for estimate in run(world.measurements):
        assert estimate.epoch == 0
        assert np.abs(off(estimate.T_world_ego, world.ego[estimate.frame_id])).max() < 1e-9
        for vehicle, pose in seen(estimate).items():
            assert np.abs(off(pose, world.vehicles[vehicle][estimate.frame_id])).max() < 1e-9


def test_velocity_is_the_motion_over_time() -> None:
    world = drive(replace(NO_CP, frames=120, noise=0.0), seed=5)
    for estimate in run(world.measurements)[20:]:
        for v in estimate.vehicles:
            if v.age_ns == 0 and v.frames > 1:
                before, now = world.vehicles[v.vehicle][estimate.frame_id - 1 : estimate.frame_id + 1]
                if np.hypot(*(now - before)[:2]) < 5.0:
                    # the chord against the tangent at its end: equal to the first order in the turn
                    np.testing.assert_allclose(v.velocity_mps, (now - before)[:2] * 33.0, atol=0.15)


# --- an error of the scale lasts ---


SCALE_ALONE = GraphConfig(correlated_direction_rad=0.0, correlated_turn_rel=0.0)


def chain(steps: Iterable[SE2], scale_sigma_rel: float) -> list[Measurements]:
    """A drive whose odometry states no noise."""
    return [
        step_at(k, step, 1e-12, t_source_ns=k * 30_000_000, scale_sigma_rel=scale_sigma_rel)
        for k, step in enumerate([SE2(), *steps])
    ]


def wander(steps: int, step_m: float, sigma: float, rng: np.random.Generator) -> list[float]:
    keep = np.exp(-step_m / GraphConfig().correlation_length_m)
    error = [sigma * rng.standard_normal()]
    for _ in range(steps - 1):
        error.append(keep * error[-1] + np.sqrt(1.0 - keep**2) * sigma * rng.standard_normal())
    return error


def test_correlated_scale_error_is_within_ego_covariance() -> None:
    config, step_m, sigma, frames = SCALE_ALONE, 1.6, 0.02, 60
    rng = np.random.default_rng(3)
    ends = []
    for _ in range(60):  # an error that wanders as the graph has it
        error = wander(frames - 1, step_m, sigma, rng)
        estimates = run(chain([SE2(step_m * (1.0 + e), 0.0, 0.0) for e in error], sigma), config)
        last = estimates[-1]
        ends.append((last.T_world_ego.x_m - (frames - 1) * step_m) ** 2 / last.cov[0])
    assert 0.6 < np.mean(ends) < 1.5  # 60 squares of a normal number: 1 +- 0.18
    variances = [estimate.cov[0] for estimate in estimates]
    assert all(a < b for a, b in pairwise(variances))
    assert last.cov[4] < 1e-3 * last.cov[0]  # to the side it does nothing


def test_correlated_direction_and_turn_errors_are_within_ego_covariance() -> None:
    config, step_m, turn_rad, frames = GraphConfig(), 1.6, 0.016, 40
    rng = np.random.default_rng(4)
    aside, turned = [], []
    for _ in range(60):
        direction = wander(frames, step_m, config.correlated_direction_rad, rng)
        last = run(chain([SE2(step_m, step_m * e, 0.0) for e in direction], 1e-6), config)[-1]
        aside.append(last.T_world_ego.y_m**2 / last.cov[4])
        turn = wander(frames, step_m, config.correlated_turn_rel, rng)
        last = run(chain([SE2(step_m, 0.0, turn_rad * (1.0 + e)) for e in turn], 1e-6), config)[-1]
        turned.append((last.T_world_ego.yaw_rad - frames * turn_rad) ** 2 / last.cov[8])
    assert 0.6 < np.mean(aside) < 1.5  # as above
    assert 0.6 < np.mean(turned) < 1.5


def test_external_odometry_has_no_correlated_errors() -> None:
    last = run(chain([SE2(0.4, 0.0, 0.01)] * 100, 0.0), GraphConfig())[-1]
    assert max(last.cov) < 1e-5


def test_scale_error_moves_all_bodies_alike() -> None:
    world = drive(DriveConfig(frames=60), seed=8)
    sure = run(world.measurements, GraphConfig())
    unsure = run([replace(m, scale_sigma_rel=0.05) for m in world.measurements], GraphConfig())
    assert unsure[-1].cov[0] > 2.0 * sure[-1].cov[0]
    for a, b in zip(sure, unsure, strict=True):
        for v, w in zip(a.vehicles, b.vehicles, strict=True):
            between_a, between_b = (e.T_world_ego.between(u.T_world_vehicle) for e, u in ((a, v), (b, w)))
            np.testing.assert_allclose(numbers(between_b), numbers(between_a), atol=1e-6)


# --- invariance to the origin of the world ---


def test_earlier_distance_does_not_affect_relative_poses() -> None:
    world = drive(DriveConfig(frames=90), seed=21)
    far = 100_000
    first = world.measurements[0]
    approach = [replace(first, cv=(), vv=(), cp=(), lanes=(), status=())]
    step = replace(world.measurements[1].cc, from_frame=0, to_frame=1, T_from_to=SE2(30.0, 0.5, 0.4))
    approach += [
        replace(approach[0], frame_id=k, t_source_ns=k, cc=replace(step, from_frame=k - 1, to_frame=k))
        for k in range(1, 1000)
    ]

    def shifted(m: Measurements) -> Measurements:
        moved = lambda e, *names: replace(e, **{n: getattr(e, n) + far for n in names})  # noqa: E731
        cc = replace(step, from_frame=999, to_frame=far) if m.cc is None else moved(m.cc, "from_frame", "to_frame")
        return replace(
            moved(m, "frame_id"),
            cc=cc,
            cv=tuple(moved(e, "frame") for e in m.cv),
            vv=tuple(moved(e, "from_frame", "to_frame") for e in m.vv),
            cp=tuple(moved(e, "frame") for e in m.cp),
        )

    near = run(world.measurements, GraphConfig())
    late = run([*approach, *(shifted(m) for m in world.measurements)], GraphConfig())[len(approach) :]
    for a, b in zip(near, late, strict=True):
        assert b.epoch == 0
        assert b.cov[0] > 100.0 * a.cov[0]
        assert [v.vehicle for v in a.vehicles] == [v.vehicle for v in b.vehicles]
        for u, v in zip(a.vehicles, b.vehicles, strict=True):
            relative = between(
                numbers(a.T_world_ego.between(u.T_world_vehicle)), numbers(b.T_world_ego.between(v.T_world_vehicle))
            )
            np.testing.assert_allclose(relative, 0.0, atol=1e-6)


# --- epochs and gaps ---


def test_missing_motion_starts_a_new_epoch() -> None:
    world = drive(DriveConfig(frames=30, noise=0.0), seed=1)
    broken = list(world.measurements)
    broken[10] = replace(broken[10], cc=None, status=())
    estimates = run(broken)
    assert [e.epoch for e in estimates] == [0] * 10 + [1] * 20
    assert Status.GRAPH_RESET not in estimates[0].status
    assert [k for k, e in enumerate(estimates) if Status.GRAPH_RESET in e.status] == [10]
    assert estimates[10].T_world_ego == SE2()
    assert all(v.frames == 1 for v in estimates[10].vehicles)
    for e in estimates[10:]:
        np.testing.assert_allclose(off(e.T_world_ego, between(world.ego[10], world.ego[e.frame_id])), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value"), [("from_frame", 999), ("from_frame", 2), ("to_frame", 11), ("to_frame", 5)]
)
def test_motion_between_unknown_frames_starts_a_new_epoch(field: str, value: int) -> None:
    broken = drive(DriveConfig(frames=20), seed=1).measurements
    assert broken[10].cc is not None
    broken[10] = replace(broken[10], cc=replace(broken[10].cc, **{field: value}))
    assert [e.epoch for e in run(broken)] == [0] * 10 + [1] * 10


def test_falling_frame_number_starts_a_new_epoch() -> None:
    measurements = drive(DriveConfig(frames=10), seed=1).measurements
    assert [e.epoch for e in run([*measurements, measurements[4]])][-2:] == [0, 1]


def test_edge_may_start_at_any_pose_of_the_window() -> None:
    world = drive(replace(NO_CP, frames=12, noise=0.0), seed=2)
    forked = list(world.measurements)
    motion = numbers(SE2(*world.ego[7]).between(SE2(*world.ego[10])))
    assert forked[10].cc is not None
    forked[10] = replace(forked[10], cc=replace(forked[10].cc, from_frame=7, T_from_to=SE2(*motion)))
    straight, estimates = run(world.measurements), run(forked)
    assert estimates[-1].epoch == 0
    np.testing.assert_allclose(off(estimates[10].T_world_ego, world.ego[10]), 0.0, atol=1e-9)
    # The pose that skips frame 9 lacks its variance, but includes that of frame 7
    assert estimates[9].cov[0] > straight[7].cov[0]
    assert estimates[10].cov[0] < straight[10].cov[0]


@pytest.mark.parametrize("back", range(7))
def test_edge_start_is_limited_to_the_window(back: int) -> None:
    """The newest pose and the nodes before it are known, less the node whose place the newest takes."""
    world = drive(replace(NO_CP, frames=20, noise=0.0), seed=2)
    forked = list(world.measurements)
    start = 14 - back
    motion = SE2(*world.ego[start]).between(SE2(*world.ego[15]))
    assert forked[15].cc is not None
    forked[15] = replace(forked[15], cc=replace(forked[15].cc, from_frame=start, T_from_to=motion))
    estimates = run(forked)
    assert (estimates[-1].epoch == 0) == (back < EQ_6.ego_nodes)
    if back < EQ_6.ego_nodes:
        np.testing.assert_allclose(off(estimates[-1].T_world_ego, world.ego[19]), 0.0, atol=1e-9)


def test_a_vv_edge_from_an_unknown_pose_is_left_out() -> None:
    world = drive(replace(NO_CP, frames=30, vehicles=4), seed=4)
    wrong, without = list(world.measurements), list(world.measurements)
    wrong[20] = replace(wrong[20], vv=tuple(replace(e, from_frame=12) for e in wrong[20].vv))
    without[20] = replace(without[20], vv=())
    assert world.measurements[20].vv
    assert msgspec.msgpack.encode(run(wrong)) == msgspec.msgpack.encode(run(without))


@pytest.mark.parametrize("status", [Status.END_OF_SOURCE, Status.FRAME_UNREADABLE])
def test_frame_without_image_repeats_pose_with_larger_covariance(status: Status) -> None:
    world = drive(DriveConfig(frames=30), seed=6)
    blind = Measurements(
        frame_id=20, t_source_ns=world.measurements[20].t_source_ns, t_capture_ns=1, t_utc_ns=2, status=(status,)
    )
    later = [
        replace(m, cc=replace(m.cc, from_frame=19)) if m.frame_id == 21 and m.cc else m for m in world.measurements[21:]
    ]
    estimates = run([*world.measurements[:20], blind, *later], GraphConfig())
    before, repeated, after = estimates[19:22]
    assert before.valid
    assert not repeated.valid
    assert repeated.status == (status,)
    assert repeated.T_world_ego == before.T_world_ego
    assert all(r > b for r, b in zip(repeated.cov[::4], before.cov[::4], strict=True))
    assert len(repeated.vehicles) == len(before.vehicles)
    assert after.valid
    assert after.epoch == 0


def test_skipped_frame_is_predicted_by_the_last_motion() -> None:
    world = drive(DriveConfig(frames=30), seed=6)
    last, ahead = world.measurements[19], world.measurements[23]
    coasts = Measurements(
        frame_id=23, t_source_ns=ahead.t_source_ns, t_capture_ns=1, t_utc_ns=2, status=(Status.COASTING,)
    )
    before, told = run([*world.measurements[:20], coasts], GraphConfig())[19:]
    truth = [SE2(*world.ego[k]) for k in (19, 23)]
    moved, told_m = truth[0].between(truth[1]), before.T_world_ego.between(told.T_world_ego)
    assert told.valid
    assert last.t_source_ns < told.t_source_ns
    assert abs(told_m.between(moved).x_m) < 0.1 * moved.x_m
    assert all(t > b for t, b in zip(told.cov[::4], before.cov[::4], strict=True))


def test_nothing_is_known_before_the_first_image() -> None:
    blind = Measurements(frame_id=0, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, status=(Status.FRAME_UNREADABLE,))
    world = drive(DriveConfig(frames=5), seed=6)
    first, *others = run([blind, *(replace(m, frame_id=m.frame_id) for m in world.measurements)])
    assert not first.valid
    assert Status.NOT_INITIALISED in first.status
    assert [e.epoch for e in others] == [0] * 5


# --- vehicles ---


def test_standstill_keeps_the_pose() -> None:
    world = drive(DriveConfig(frames=60, sigma_cc_m=0.05), seed=7)
    standing = [
        replace(m, cc=replace(m.cc, T_from_to=SE2()), status=(Status.STANDSTILL,)) if m.frame_id >= 30 and m.cc else m
        for m in world.measurements
    ]
    estimates = run(standing, GraphConfig())
    assert len({e.T_world_ego for e in estimates[29:]}) == 1
    np.testing.assert_allclose([e.cov for e in estimates[30:]], [estimates[30].cov] * 30, rtol=1e-9, atol=1e-15)


def test_outlier_detection_hardly_moves_a_vehicle() -> None:
    world = drive(replace(NO_CP, frames=80, vehicles=8), seed=8)
    wild = list(world.measurements)
    hit = wild[60].cv[0]
    T = hit.T_ego_vehicle
    wild[60] = replace(
        wild[60], cv=(replace(hit, T_ego_vehicle=SE2(T.x_m + 20.0, T.y_m - 8.0, T.yaw_rad)), *wild[60].cv[1:])
    )
    calm, hurt = (run(m, GraphConfig(), WeightsConfig()) for m in (world.measurements, wild))
    moved = numbers(seen(calm[60])[hit.vehicle].between(seen(hurt[60])[hit.vehicle]))
    assert np.hypot(*moved[:2]) < 0.3
    assert np.hypot(*numbers(calm[60].T_world_ego.between(hurt[60].T_world_ego))[:2]) < 0.01


def test_vehicle_out_of_sight_is_predicted_then_dropped_then_new() -> None:
    world = drive(replace(NO_CP, frames=200, vehicles=6), seed=3)
    last = next(e.vehicle for e in world.measurements[40].cv)
    hidden = [
        replace(m, cv=tuple(e for e in m.cv if e.vehicle != last), vv=tuple(e for e in m.vv if e.vehicle != last))
        if 41 <= m.frame_id < 120
        else m
        for m in world.measurements
    ]
    estimates = run(hidden, GraphConfig(forget_s=1.0), WeightsConfig())
    mine = {e.frame_id: v for e in estimates for v in e.vehicles if v.vehicle == last}
    assert max(frame for frame in mine if frame < 120) == 40 + 33
    for before, after in pairwise(range(40, 74)):
        assert mine[after].cov[0] + mine[after].cov[4] > mine[before].cov[0] + mine[before].cov[4]
        assert mine[after].age_ns > mine[before].age_ns
    moved = numbers(mine[73].T_world_vehicle)[:2] - numbers(mine[40].T_world_vehicle)[:2]
    assert np.abs(moved - np.array(mine[40].velocity_mps)).max() < 1.0
    again = min(frame for frame in mine if frame >= 120)
    assert mine[again].frames == 1


def test_reversed_yaw_does_not_move_the_vehicle() -> None:
    world = drive(replace(NO_CP, frames=60, vehicles=6), seed=8)
    turned = [
        replace(m, cv=tuple(replace(e, T_ego_vehicle=e.T_ego_vehicle @ SE2(yaw_rad=3.1)) for e in m.cv))
        if m.frame_id >= 50
        else m
        for m in world.measurements
    ]
    independent = GraphConfig(lasting_share=0.0)  # as this world's edges are
    calm, other = (run(m, independent, WeightsConfig())[55] for m in (world.measurements, turned))
    for a, b in zip(calm.vehicles, other.vehicles, strict=True):
        if a.frames > 20 and a.age_ns == 0:
            assert np.hypot(*numbers(a.T_world_vehicle.between(b.T_world_vehicle))[:2]) < 0.3
            np.testing.assert_allclose(a.velocity_mps, b.velocity_mps, atol=0.7)
            assert abs(abs(a.T_world_vehicle.between(b.T_world_vehicle).yaw_rad) - np.pi) < 0.2


# --- the static map ---


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_landmark_edges_sum_exactly_to_one_at_their_centroid(n: int, seed: int) -> None:
    """Eq. 7 over N edges and over their sum differ by a constant, wherever the ego is."""
    rng = np.random.default_rng(seed)
    gaps, A = rng.normal(size=(n, 2)) * 3.0, rng.normal(size=(n, 2, 2))
    covs = A @ A.transpose(0, 2, 1) + 0.01 * np.eye(2)
    xx, xy, yy = covs[:, 0, 0], covs[:, 0, 1], covs[:, 1, 1]
    points = gaps[:, 0] + 1j * gaps[:, 1], 0.5 * (xx + yy), 0.5 * (xx - yy) + 1j * xy
    centroid, mean, deviator = sum_of_points(*points, np.zeros((2, n), np.complex128))
    g = np.array([centroid.real, centroid.imag])
    C = np.array([[mean + deviator.real, deviator.imag], [deviator.imag, mean - deviator.real]])

    def eq_7(t: Floats) -> float:
        return float(sum(d @ np.linalg.solve(c, d) for d, c in zip(t - gaps, covs, strict=True)))

    places = rng.normal(size=(4, 2)) * 5.0
    apart = [eq_7(t) - (t - g) @ np.linalg.solve(C, t - g) for t in places]
    np.testing.assert_allclose(apart, apart[0], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(np.linalg.inv(C), np.linalg.inv(covs).sum(axis=0), rtol=1e-8)


def test_shared_landmark_errors_do_not_average_out() -> None:
    """The covariance of the weighted centroid by what each errs by itself and by what all err by together."""
    rng = np.random.default_rng(0)
    A, S = rng.normal(size=(7, 2, 2)), rng.normal(size=(3, 7, 2))
    own = A @ A.transpose(0, 2, 1) + 0.01 * np.eye(2)
    covs = own + np.einsum("kni,knj->nij", S, S)
    xx, xy, yy = covs[:, 0, 0], covs[:, 0, 1], covs[:, 1, 1]
    points = np.zeros(7, np.complex128), 0.5 * (xx + yy), 0.5 * (xx - yy) + 1j * xy
    _, mean, deviator = sum_of_points(*points, S[..., 0] + 1j * S[..., 1])
    W = np.linalg.inv(covs)
    C, moved = np.linalg.inv(W.sum(axis=0)), np.einsum("nij,knj->ik", W, S)
    expected = C @ (np.einsum("nij,njk,nkl->il", W, own, W) + SHARED_VARIANCE_RATIO * moved @ moved.T) @ C
    found = np.array([[mean + deviator.real, deviator.imag], [deviator.imag, mean - deviator.real]])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def ego_ate(world: Drive, weights: WeightsConfig) -> float:
    errors = [off(e.T_world_ego, world.ego[e.frame_id])[:2] for e in run(world.measurements, GraphConfig(), weights)]
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def with_common_error(world: Drive, rng: np.random.Generator) -> Drive:
    """Landmarks as Eq. 1 sees them with a wrong height and a pitch that shakes: all of a frame are off together."""
    far = [1.02 * (1.0 + 0.02 * rng.standard_normal()) for _ in world.measurements]

    def off_together(e: LandmarkEdge, s: float) -> LandmarkEdge:
        x, y = 0.02 * e.x_m, 0.02 * e.y_m  # by either
        cov = np.reshape(e.cov, (2, 2)) + 2.0 * np.outer((x, y), (x, y))
        return replace(e, x_m=s * e.x_m, y_m=s * e.y_m, cov=tuple(cov.ravel().tolist()), shared=(x, x, y, y))

    measurements = [
        replace(m, cp=tuple(off_together(e, s) for e in m.cp)) for m, s in zip(world.measurements, far, strict=True)
    ]
    return Drive(measurements, world.ego, world.vehicles)


@pytest.mark.parametrize("common_error", [pytest.param(False, marks=pytest.mark.slow), True])
def test_landmarks_never_make_the_ego_worse_than_cc_alone(common_error: bool) -> None:
    rng = np.random.default_rng(0)
    with_cp, without = [], []
    for seed in range(10):
        world = drive(DriveConfig(frames=100, vehicles=0, sigma_cc_m=0.02, outliers=0.05), seed)
        world = with_common_error(world, rng) if common_error else world
        with_cp.append(ego_ate(world, WeightsConfig()))
        without.append(ego_ate(world, WeightsConfig(leave_out=("cp",))))
    assert np.mean(with_cp) <= 1.01 * np.mean(without)


def test_map_has_the_observed_landmarks() -> None:
    world = drive(DriveConfig(frames=300, vehicles=0, noise=0.0, lane_points=4), seed=9)
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    assert graph.map_update() is None
    landmarks: list[tuple[float, float]] = []
    for m in world.measurements:
        graph.optimise(m)
        gained = graph.map_update()
        assert gained.frame_id == m.frame_id
        T = SE2(*world.ego[m.frame_id])
        expected = [T @ np.array([p.x_m, p.y_m]) for p in m.lanes]
        np.testing.assert_allclose(gained.lanes_m, expected, atol=0.1)
        landmarks.extend(gained.landmarks_m)
    truth = {
        e.landmark: SE2(*world.ego[m.frame_id]) @ np.array([e.x_m, e.y_m]) for m in world.measurements for e in m.cp
    }
    assert len(landmarks) > 30
    for point in landmarks:
        assert min(np.hypot(*(np.array(point) - other)) for other in truth.values()) < 0.1


def test_lane_points_keep_their_lanes() -> None:
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    world = drive(DriveConfig(frames=4, vehicles=0, lane_points=2), seed=2).measurements
    plain, *named = (
        msgspec.structs.replace(m, lanes=(LanePoint(1.0, 0.5, k), LanePoint(2.0, 0.5)))
        for k, m in zip((-1, 7, 9, 7), world, strict=True)
    )
    graph.optimise(plain)
    gained = graph.map_update()
    assert gained.lane_ids == ()
    for m in named:
        graph.optimise(m)
    gained = graph.map_update()
    assert gained.lane_ids == (7, -1, 9, -1, 7, -1)
    assert len(gained.lanes_m) == 6


# --- bounded, deterministic, never raises ---


@pytest.mark.slow
def test_memory_is_constant_over_3000_frames() -> None:
    world = drive(DriveConfig(frames=3000, vehicles=4, landmarks=6, outliers=0.02, drop=0.02), seed=10)
    config = GraphConfig(max_pending_landmarks=200, max_pending_frames=100)
    factors = standard_factors(config, WeightsConfig())
    graph, on_the_road = PoseGraph(config, WeightsConfig(), factors=factors), factors[-1]
    assert isinstance(on_the_road, LandmarkPoints)
    rows, landmarks = [], []
    for m in world.measurements:
        estimate = graph.optimise(m)
        assert estimate.epoch == 0
        rows.append(len(graph.window.P))
        landmarks.append(len(on_the_road))
    assert max(rows) <= StateLayout(config.ego_nodes, vehicles=4).size
    assert max(landmarks) <= 6
    gained = graph.map_update()
    assert len(gained.landmarks_m) == 200
    assert len(gained.lanes_m) == 100 * DriveConfig().lane_points


def test_max_vehicles_keeps_the_most_recent() -> None:
    world = drive(replace(NO_CP, frames=60, vehicles=9), seed=10)
    everyone, few = (run(world.measurements, GraphConfig(max_vehicles=n)) for n in (32, 3))
    assert max(len(e.vehicles) for e in everyone) > 3
    assert max(len(e.vehicles) for e in few) == 3
    assert all(len(e.vehicles) == min(3, len(f.vehicles)) for e, f in zip(few, everyone, strict=True))


REPLAY = """
import hashlib, msgspec
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.graph.weights import WeightsConfig
graph = PoseGraph(GraphConfig(), WeightsConfig(leave_out=()))
world = drive(DriveConfig(frames=150, outliers=0.05, drop=0.1), seed=17)
print(hashlib.sha256(b"".join(msgspec.msgpack.encode(graph.optimise(m)) for m in world.measurements)).hexdigest())
"""


@pytest.mark.processes
def test_the_same_log_gives_the_same_bytes_in_every_process() -> None:
    world = drive(DriveConfig(frames=150, outliers=0.05, drop=0.1), seed=17)
    log = [msgspec.msgpack.decode(msgspec.msgpack.encode(m), type=Measurements) for m in world.measurements]
    mine = b"".join(map(msgspec.msgpack.encode, run(log, GraphConfig())))
    other = subprocess.run([sys.executable, "-c", REPLAY], capture_output=True, text=True, check=True, timeout=600)
    assert other.stdout.strip() == hashlib.sha256(mine).hexdigest()


@settings(max_examples=20)
@given(
    config=st.builds(
        DriveConfig,
        frames=st.integers(1, 40),
        rate_hz=st.sampled_from([5.0, 10.0, 33.0]),
        vehicles=st.integers(0, 5),
        landmarks=st.integers(0, 6),
        speed_mps=st.floats(0.0, 30.0),
        noise=st.floats(0.0, 3.0),
        outliers=st.floats(0.0, 1.0),
        drop=st.floats(0.0, 0.9),
        sigma_cc_m=st.sampled_from([0.0, 1e-6, 0.01, 1.0]),
        sigma_cc_rad=st.sampled_from([0.0, 1e-6, 0.01, 1.0]),
        sigma_cv_m=st.sampled_from([0.0, 0.2, 10.0]),
        sigma_cv_rad=st.sampled_from([0.0, 0.1, 3.0]),
        sigma_cp_m=st.sampled_from([0.0, 0.05, 5.0]),
    ),
    seed=st.integers(0, 2**32 - 1),
    constant_velocity=st.booleans(),
    mode=st.sampled_from(["measured", "paper"]),
    ego_nodes=st.integers(1, 6),
)
def test_any_small_world_gives_sound_estimates(
    config: DriveConfig, seed: int, constant_velocity: bool, mode: str, ego_nodes: int
) -> None:
    world = drive(config, seed)
    graph = PoseGraph(
        GraphConfig(constant_velocity=constant_velocity, ego_nodes=ego_nodes),
        WeightsConfig(mode=mode, leave_out=()),
    )
    for m in world.measurements:
        estimate = graph.optimise(m)
        assert estimate.frame_id == m.frame_id
        assert estimate.epoch == 0
        assert {e.vehicle for e in m.cv} <= {v.vehicle for v in estimate.vehicles}
        for cov in (estimate.cov, *(v.cov for v in estimate.vehicles)):
            C = np.reshape(cov, (3, 3))
            assert np.linalg.eigvalsh(0.5 * (C + C.T)).min() >= -1e-7 * max(1.0, np.abs(C).max())
        msgspec.msgpack.decode(msgspec.msgpack.encode(estimate), type=Estimate)


NONSENSE = [
    (1.0, 5.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, 1.0),  # correlation 5
    (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1e300),
    (1e-300, 0.0, 0.0, 0.0, 1e-300, 0.0, 0.0, 0.0, 1e-300),
    (0.0,) * 9,
]


@pytest.mark.parametrize("cov", NONSENSE)
@pytest.mark.parametrize("T", [SE2(1.0, 2.0, 0.1), SE2(1e200, 0.0, 0.0), SE2(10.0, 0.0, 1e9)])
def test_invalid_numbers_raise_nothing(cov: tuple[float, ...], T: SE2) -> None:
    world = drive(DriveConfig(frames=30, vehicles=4), seed=18)
    bad = list(world.measurements)
    bad[15] = replace(
        bad[15],
        cv=tuple(replace(e, T_ego_vehicle=T, cov=cov) for e in bad[15].cv),
        vv=tuple(replace(e, T_from_to=T, cov=cov) for e in bad[15].vv),
        cp=tuple(replace(e, cov=(cov[0], cov[1], cov[3], cov[8]), x_m=T.x_m) for e in bad[15].cp),
        lanes=(LanePoint(1e300, 1e300),),
    )
    bad[20] = replace(bad[20], cc=replace(bad[20].cc, T_from_to=T, cov=cov))
    for config in (GraphConfig(), EQ_6):
        for estimate in run(bad, config):
            assert np.isfinite(estimate.cov).all()


# --- the benchmark ---


@pytest.mark.processes
def test_the_benchmark_measures_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        perf_main(["optimizer", *f"--vehicles 0,2 --frames 150 --contenders ours --output {tmp_path}/F.json".split()])
        == 0
    )
    rows = json.loads((tmp_path / "F.json").read_text())["rows"]
    assert [(row["contender"], row["vehicles"], row["frames"], row["exceptions"]) for row in rows] == [
        ("ours", 0, 150, 0),
        ("ours", 2, 150, 0),
    ]
    for row in rows:
        assert 0.0 < row["p50_us"] <= row["p99_us"] <= row["p999_us"] <= row["max_us"]
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_the_batch_is_measured_against_the_incremental_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimizer, "REPEATS", 1)
    assert perf_main(["optimizer", "--batch", "40", "--output", f"{tmp_path}/F.json"]) == 0
    ours, *_, batch = json.loads((tmp_path / "F.json").read_text())["rows"]
    assert ours["ratio"] == 1.0
    assert 0 < batch["iterations"] < BatchConfig().iterations
    assert batch["ratio"] > 1.0


@pytest.mark.parametrize(
    "kind",
    [
        "incremental_fixed_lag_qr",
        "incremental_fixed_lag_cholesky",
        "batch_fixed_lag",
        "isam2",
    ],
)
def test_the_other_contenders_solve_the_same_world(kind: str) -> None:
    world = drive(DriveConfig(frames=30, vehicles=3, landmarks=6, lane_points=0, noise=0.0, traffic="convoy"), seed=1)
    contender = CONTENDERS[kind][0]()
    for m in world.measurements:
        poses = contender.step(m)
        expected = [world.ego[m.frame_id], *(world.vehicles[e.vehicle][m.frame_id] for e in m.cv)]
        for (pose, _), truth in zip(poses, expected, strict=True):
            np.testing.assert_allclose(between(np.array([pose.x(), pose.y(), pose.theta()]), truth), 0.0, atol=1e-6)
