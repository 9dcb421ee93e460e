"""Whether vehicles are stationary or moving: the decision, and the velocity in estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.standing import DECIDED, GIVEN_UP, STANDING_MPS, decide, judge, reported_velocities
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.weights import WeightsConfig
from birdslam.odometry.speed.standstill import StandstillDetector
from birdslam.odometry.speed.stillness import StillnessConfig
from birdslam.odometry.speed.zero_velocity import ZeroVelocityConfig
from birdslam.types import Moves, VehicleEstimate
from tests.recordings import KITTI
from tests.records import new_edge, step_at

BIRTH_DET = (12.0 * 2.0) ** 2
probabilities = st.floats(0.0, 1.0)


def node(standing_seen: float | None, **more: object) -> VehicleNode:
    return VehicleNode(1, seen_ns=7, standing_seen=standing_seen, **more)


def judged(vehicle: VehicleNode, v_mps: tuple[float, float], sigma_mps: float) -> VehicleNode:
    judge([vehicle], np.array([v_mps]), sigma_mps**2 * np.eye(2)[None], BIRTH_DET, 7)
    return vehicle


def reported(vehicle: VehicleNode, v_mps: tuple[float, float], cov: Floats) -> tuple[Floats, Floats]:
    """Velocity (2,) and covariance (2, 2)."""
    (u,), (C,) = reported_velocities([vehicle], np.array([v_mps]), cov[None])
    return u, C


@given(probabilities)
def test_decision_has_hysteresis(standing: float) -> None:
    assert (decide(Moves.UNDECIDED, standing) is Moves.STANDING) == (standing >= DECIDED)
    assert (decide(Moves.UNDECIDED, standing) is Moves.DRIVING) == (standing <= 1.0 - DECIDED)
    assert (decide(Moves.STANDING, standing) is Moves.STANDING) == (standing >= GIVEN_UP)
    assert (decide(Moves.DRIVING, standing) is Moves.DRIVING) == (1.0 - standing >= GIVEN_UP)


@given(
    st.sampled_from(Moves), probabilities, st.tuples(*2 * [st.floats(-30.0, 30.0)]), st.tuples(*2 * [st.floats(0.1, 9)])
)
def test_covariance_is_that_of_the_mixture_about_the_reported_velocity(
    moves: Moves, p: float, v: tuple[float, float], sigmas: tuple[float, float]
) -> None:
    """Its moments, from points that have the two parts' moments exactly."""
    u, C = reported(node(p, standing=p, moves=moves), v, np.diag(np.square(sigmas)))
    assert np.hypot(*u) <= np.hypot(*v) + 1e-9
    spread = math.sqrt(2.0) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    points = np.concatenate([STANDING_MPS * spread, v + spread * sigmas]) - u
    weights = np.repeat([p, 1.0 - p], 4) / 4.0
    np.testing.assert_allclose(np.einsum("n,ni,nj->ij", weights, points, points), C, atol=1e-9)


def test_new_vehicle_is_undecided_with_velocity_pulled_to_zero() -> None:
    new = judged(node(0.4), (6.0, 0.0), 6.0)
    assert new.moves is Moves.UNDECIDED
    assert 0.2 < new.standing < 0.8
    u, C = reported(new, (6.0, 0.0), 36.0 * np.eye(2))
    assert u[0] < 6.0 * (1.0 - new.standing) + 1e-9
    assert u[0] - 2.0 * math.sqrt(C[0, 0]) < 0.0  # nor reported as certainly moving


def test_both_filters_must_agree() -> None:
    assert judged(node(0.995), (0.3, 0.0), 0.5).moves is Moves.STANDING
    assert judged(node(0.005), (9.0, 0.0), 0.5).moves is Moves.DRIVING
    assert judged(node(0.995), (9.0, 0.0), 0.5).moves is Moves.UNDECIDED
    assert judged(node(0.005), (0.0, 0.0), 0.5).moves is Moves.UNDECIDED


def test_vehicle_beside_the_road_needs_more_evidence_of_motion() -> None:
    for standing_seen, v_mps in ((0.2, 2.5), (0.4, 1.5)):
        on_road = judged(node(standing_seen), (v_mps, 0.0), 1.0)
        beside = judged(node(standing_seen, beside=True), (v_mps, 0.0), 1.0)
        assert beside.standing > on_road.standing
    assert judged(node(0.005, beside=True), (9.0, 0.0), 0.5).moves is Moves.DRIVING


def test_decision_in_the_egos_path_is_kept_until_contradicted() -> None:
    creeps = judged(node(0.999, in_path=True), (1.0, 0.0), 0.5)
    assert creeps.moves is Moves.UNDECIDED
    assert creeps.standing is None
    stands = node(0.999, in_path=True, moves=Moves.STANDING, standing=0.95)
    assert judged(stands, (0.5, 0.0), 0.5).moves is Moves.STANDING
    assert judged(stands, (5.0, 0.0), 0.5).moves is Moves.UNDECIDED
    assert stands.standing is None


def test_either_filter_may_decide_in_the_egos_path() -> None:
    follows = judged(node(0.01, in_path=True), (11.0, 0.0), 0.8)
    assert follows.moves is Moves.DRIVING
    assert judged(follows, (0.5, 0.0), 0.5).moves is Moves.DRIVING  # it creeps
    assert judged(node(0.5, in_path=True), (11.0, 0.0), 5.0).moves is Moves.UNDECIDED  # by the depth's error alone
    assert judged(node(0.01, in_path=True), (0.4, 0.0), 0.5).moves is Moves.UNDECIDED


@pytest.mark.parametrize("vehicle", [node(None), VehicleNode(1, seen_ns=6, standing_seen=0.999)])
def test_unobserved_vehicles_are_not_decided(vehicle: VehicleNode) -> None:
    judged(vehicle, (0.0, 0.0), 0.5)
    assert vehicle.moves is Moves.UNDECIDED
    assert vehicle.standing is None
    u, C = reported(vehicle, (3.0, 1.0), np.eye(2))
    assert u.tolist() == [3.0, 1.0]
    assert C.tolist() == np.eye(2).tolist()


def driven_past(
    speed_mps: float, standing: float, config: GraphConfig, weights: WeightsConfig
) -> list[VehicleEstimate]:
    """Estimates of a vehicle 3 m to the side with correlated errors, in 40 frames at 10 Hz."""
    graph, told = PoseGraph(config, weights), []
    for k in range(40):
        place = SE2(60.0 - k + speed_mps * k / 10.0 + 0.6 * math.sin(0.4 * k), 3.0)
        seen = new_edge(1, k, place, (0.5, 0.1, 0.01), standing=standing)
        told += graph.optimise(step_at(k, SE2(1.0), 1e-4, cv=(seen,))).vehicles
    return told


def test_planners_see_the_status() -> None:
    config, weights = GraphConfig(), WeightsConfig()
    parked = driven_past(0.0, 0.97, config, weights)
    assert max(math.hypot(*v.velocity_mps) for v in parked) < 1.0
    assert parked[0].moves is Moves.UNDECIDED
    assert parked[-1].moves is Moves.STANDING
    assert parked[-1].standing > DECIDED
    assert parked[-1].velocity_mps == (0.0, 0.0)
    assert parked[-1].velocity_cov[0] >= (1.0 - parked[-1].standing) * 0.01
    driving = driven_past(8.0, 0.02, config, weights)
    assert driving[-1].moves is Moves.DRIVING
    assert driving[-1].velocity_mps[0] == pytest.approx(8.0, abs=1.5)
    nobody_says = driven_past(0.0, 0.0, config, weights)
    assert {(v.moves, v.standing) for v in nobody_says} == {(Moves.UNDECIDED, 0.5)}
    as_published = driven_past(0.0, 0.97, GraphConfig(constant_velocity=False), WeightsConfig(mode="paper"))
    assert {v.moves for v in as_published} == {Moves.UNDECIDED}


def test_stationary_vehicle_has_one_position_and_follows_when_it_starts() -> None:
    rng, graph, told = np.random.default_rng(1), PoseGraph(GraphConfig(), WeightsConfig()), []
    for k in range(70):
        started_s = max(0.0, (k - 45) / 10.0)
        off = rng.multivariate_normal(np.zeros(2), np.diag([0.5, 0.1]))
        place = SE2(60.0 - 0.5 * k + 4.0 * started_s + off[0], 4.0 + off[1])
        seen = new_edge(1, k, place, (0.5, 0.1, 0.01), standing=0.02 if started_s > 0.5 else 0.98)
        told += graph.optimise(step_at(k, SE2(0.5), 1e-8, cv=(seen,))).vehicles
    still = [v for v in told[:45] if v.moves is Moves.STANDING]
    assert len(still) > 30
    at = np.array([(v.T_world_vehicle.x_m, v.T_world_vehicle.y_m) for v in still])
    assert np.linalg.norm(np.diff(at[15:], axis=0), axis=1).max() < 0.2
    assert np.linalg.norm(at[20:] - [60.0, 4.0], axis=1).max() < 0.4
    variances = np.array([v.cov[0] for v in still])
    assert (np.diff(variances) < 1e-6).all()
    assert told[-1].moves is not Moves.STANDING
    assert told[-1].T_world_vehicle.x_m == pytest.approx(60.0 + 4.0 * 2.4, abs=1.5)
    assert told[-1].velocity_mps[0] == pytest.approx(4.0, abs=1.5)


def test_size_error_does_not_average_out() -> None:
    """Vehicles that are all off by their sizes' errors, in each frame alike, and the velocities that come of it."""
    rng, sigma, frames = np.random.default_rng(3), 0.06, 25
    off = sigma * rng.standard_normal(30)
    at = np.column_stack([rng.uniform(50.0, 70.0, 30), rng.choice([-6.0, -3.0, 3.0, 6.0], 30)])
    nees = {}
    for stated in (sigma, 0.0):
        graph = PoseGraph(GraphConfig(), WeightsConfig())
        for k in range(frames):
            places = (at - [k, 0.0]) * np.exp(off)[:, None]
            size = {"depth_per_height": 1.0, "sigma_log_height": stated}
            cv = tuple(new_edge(v, k, SE2(*p), (4.0, 0.04, 0.01), **size) for v, p in enumerate(places.tolist()))
            estimate = graph.optimise(step_at(k, SE2(1.0), 1e-6, cv=cv))
        places_m = [(v.T_world_vehicle.x_m, v.T_world_vehicle.y_m) for v in estimate.vehicles]
        errors = [np.array(place) - at[v.vehicle] for place, v in zip(places_m, estimate.vehicles, strict=True)]
        covs = [np.reshape(v.cov, (3, 3))[:2, :2] for v in estimate.vehicles]
        of_place = np.mean([e @ np.linalg.solve(P, e) for e, P in zip(errors, covs, strict=True)]) / 2.0
        of_velocity = np.mean([v.velocity_mps[0] ** 2 / v.velocity_cov[0] for v in estimate.vehicles])
        nees[stated] = of_place, of_velocity
    assert 0.2 < nees[sigma][0] < 1.2  # along the line of sight alone something is off
    assert nees[0.0][0] > 3.0 * nees[sigma][0]
    assert 0.1 < nees[sigma][1] < 1.5
    assert nees[0.0][1] > nees[sigma][1]


STILL_PX, PX_PER_M, DT_S = ZeroVelocityConfig().still_px, 10.0, 0.03


def ego_that_drove(speed_mps: float, seconds: float = 1.0) -> StandstillDetector:
    standing = StandstillDetector(KITTI, ZeroVelocityConfig(), StillnessConfig(), 8)
    for step_m in [3.0 * STILL_PX / PX_PER_M + 0.1] + [speed_mps * DT_S] * round(seconds / DT_S):
        standing.add_motion(np.full(20, PX_PER_M * step_m), step_m, DT_S)
    return standing


@given(st.floats(0.05, 20.0))
def test_stop_is_reported_after_the_time_to_observe_it(speed_mps: float) -> None:
    standing, sigmas_m = ego_that_drove(speed_mps), []
    while (sigma_m := standing.add_unmoved(DT_S)) and len(sigmas_m) < 100:
        sigmas_m.append(sigma_m)
    would_move_px = PX_PER_M * speed_mps * DT_S * (len(sigmas_m) + 1)
    assert would_move_px > 2.7 * STILL_PX or len(sigmas_m) * DT_S > 0.45
    assert PX_PER_M * speed_mps * DT_S * len(sigmas_m) < 3.3 * STILL_PX
    assert len(sigmas_m) * DT_S < 0.55
    assert all(np.diff(sigmas_m) < 0.0)
    assert standing.add_unmoved(DT_S) == 0.0


def test_unobserved_motion_is_recovered_by_the_next_motion() -> None:
    standing, speed_mps = ego_that_drove(0.2), 0.2
    covered = [standing.add_unmoved(DT_S) for _ in range(4)]
    over_s, earlier_m = standing.add_motion(np.full(20, 0.3), 5 * speed_mps * DT_S, DT_S)
    assert all(speed_mps * DT_S < 2.0 * sigma_m for sigma_m in covered)
    assert over_s == pytest.approx(5 * DT_S)
    assert earlier_m == pytest.approx(4 * speed_mps * DT_S)


def test_initially_stationary_ego_is_stationary_at_once() -> None:
    assert StandstillDetector(KITTI, ZeroVelocityConfig(), StillnessConfig(), 8).add_unmoved(DT_S) == 0.0
