"""User-defined factors, checked against linear algebra, and the correlated part of a CV edge's error."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.checkpoint import CheckpointError
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.factors.lasting_error import lasting_correlation, line_of_sight_factor
from birdslam.graph.factors.odometry import Odometry
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.state_layout import OF_VEHICLE
from birdslam.graph.weights import WeightsConfig
from birdslam.graph.window import EGO_PLACE, Window
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.types import Estimate
from tests.records import new_edge, step_at

SETTINGS = GraphConfig(), WeightsConfig()
LOG = drive(DriveConfig(frames=60, vehicles=3, landmarks=8), 3).measurements
LOG[-1] = replace(LOG[-1], cv=())  # so that nothing else corrects the last prediction


@dataclass(frozen=True)
class Fix:
    """The ego's place in the world."""

    x_m: float
    y_m: float
    sigma_m: float


class GnssState(msgspec.Struct, frozen=True):
    """When a fix counted last."""

    used_ns: int | None


class Gnss(Factor):
    """A prior on the ego's place. Fixes err alike for a while: one in `every_ns` counts."""

    name = "GNSS"
    equation = "z - p"
    state_type = GnssState

    def __init__(self, gate_sigma: float = 4.0, every_ns: int = 0) -> None:
        self._gate = gate_sigma**2
        self._every_ns = every_ns
        self.begin()

    def begin(self) -> None:
        self._used_ns: int | None = None

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        t_ns, T = frame.measurements.t_source_ns, window.world
        fixes = [record for record in frame.records if isinstance(record, Fix)]
        if not fixes or (self._used_ns is not None and t_ns - self._used_ns < self._every_ns):
            return None
        self._used_ns = t_ns
        gaps = np.array([(fix.x_m - T.x_m, fix.y_m - T.y_m) for fix in fixes]) @ T.rotation()  # in the ego's axes
        covs = np.array([fix.sigma_m**2 * np.eye(2) for fix in fixes])
        return Linearised(gaps.ravel().tolist(), [0, 1] * len(fixes), covs, self._gate)

    def state(self) -> GnssState:
        return GnssState(self._used_ns)

    def resume(self, state: GnssState) -> None:
        self._used_ns = state.used_ns


@dataclass(frozen=True)
class Line:
    """A straight line along x of the world: the ego's distance to its left of it, and its heading against it."""

    offset_m: float
    heading_rad: float
    sigmas: tuple[float, float]


class LaneLine(Factor):
    """Offset and heading, with a general Jacobian."""

    name = "lane line"
    equation = "(d - y, psi - yaw)"

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        T = window.world
        lines = [record for record in frame.records if isinstance(record, Line)]
        if not lines:
            return None
        J = np.zeros((2 * len(lines), window.layout.size))
        J[0::2, :2] = np.sin(T.yaw_rad), np.cos(T.yaw_rad)
        J[1::2, 2] = 1.0
        residual = [number for line in lines for number in (line.offset_m - T.y_m, line.heading_rad - T.yaw_rad)]
        return Linearised(residual, J, np.array([np.diag(np.square(line.sigmas)) for line in lines]))


def graph_with(*more: Factor, epoch: int = 0) -> PoseGraph:
    return PoseGraph(*SETTINGS, epoch, [*standard_factors(*SETTINGS), *more])


def run(graph: PoseGraph, records: dict[int, tuple[object, ...]]) -> list[Estimate]:
    return [graph.optimise(m, records.get(m.frame_id, ())) for m in LOG]


def updated(before: Estimate, J: Floats, residual: Floats, R: Floats) -> tuple[SE2, Floats]:
    """Pose and covariance of the ego after a measurement of it, by the textbook's Kalman update."""
    P = np.reshape(before.cov, (3, 3))
    K = P @ J.T @ np.linalg.inv(J @ P @ J.T + R + 1e-8 * np.eye(len(R)))  # 0.1 mm: no edge is believed to be surer
    return before.T_world_ego @ SE2(*(K @ residual).tolist()), P - K @ J @ P


def assert_is(after: Estimate, expected: tuple[SE2, Floats]) -> None:
    assert after.T_world_ego.between(expected[0]).log() == pytest.approx(np.zeros(3), abs=1e-7)
    np.testing.assert_allclose(np.reshape(after.cov, (3, 3)), expected[1], rtol=1e-4, atol=1e-10)


def fix_at(estimate: Estimate, away_m: tuple[float, float], sigma_m: float) -> Fix:
    T = estimate.T_world_ego
    return Fix(T.x_m + away_m[0], T.y_m + away_m[1], sigma_m)


@pytest.mark.parametrize("sigma_m", [1e-3, 0.05, 10.0])
def test_fix_moves_the_ego_by_its_share_of_information(sigma_m: float) -> None:
    before = run(graph_with(), {})[-1]
    away_m = (0.06, -0.03)
    graph = graph_with(Gnss())
    after = run(graph, {LOG[-1].frame_id: (fix_at(before, away_m, sigma_m),)})[-1]
    J, residual = np.eye(2, 3), before.T_world_ego.rotation().T @ np.array(away_m)
    assert_is(after, updated(before, J, residual, sigma_m**2 * np.eye(2)))
    assert graph.outliers == {"GNSS": []}
    assert np.trace(np.reshape(after.cov, (3, 3))[:2, :2]) < np.trace(np.reshape(before.cov, (3, 3))[:2, :2])
    if sigma_m == 1e-3:
        assert after.T_world_ego.x_m - before.T_world_ego.x_m == pytest.approx(away_m[0], abs=1e-3)
        assert after.T_world_ego.y_m - before.T_world_ego.y_m == pytest.approx(away_m[1], abs=1e-3)


def test_only_the_wrong_fix_of_a_frame_is_an_outlier() -> None:
    before = run(graph_with(), {})[-1]
    good, wild = fix_at(before, (0.05, 0.0), 0.05), fix_at(before, (9.0, 9.0), 0.05)
    last = LOG[-1].frame_id
    graph = graph_with(Gnss())
    both, alone = run(graph, {last: (wild, good)})[-1], run(graph_with(Gnss()), {last: (good,)})[-1]
    assert graph.outliers == {"GNSS": [0]}
    assert both.T_world_ego.between(alone.T_world_ego).log() == pytest.approx(np.zeros(3), abs=1e-6)
    np.testing.assert_allclose(both.cov, alone.cov, rtol=1e-6, atol=1e-10)


def test_fix_beyond_the_gate_weighs_less() -> None:
    before = run(graph_with(), {})[-1]
    P = np.reshape(before.cov, (3, 3))[:2, :2]
    sigma_m = 0.05
    S = P + (sigma_m**2 + 1e-8) * np.eye(2)
    away = before.T_world_ego.rotation() @ np.linalg.cholesky(S) @ np.array([6.0, 0.0])  # 6 sigma: the gate is at 4
    after = run(graph_with(Gnss()), {LOG[-1].frame_id: (fix_at(before, (away[0], away[1]), sigma_m),)})[-1]
    J, residual = np.eye(2, 3), before.T_world_ego.rotation().T @ away
    assert_is(after, updated(before, J, residual, (36.0 / 16.0) ** 2 * sigma_m**2 * np.eye(2)))


@pytest.mark.parametrize("cut", [1, 20, 41])
def test_checkpoint_restores_the_factor(cut: int) -> None:
    """With what it keeps: of a fix in each frame few count, and the next one that does is the same."""
    factors = lambda: [*standard_factors(*SETTINGS), Gnss(every_ns=10**9)]  # noqa: E731
    truth = run(graph_with(), {})
    fixes = {e.frame_id: (fix_at(e, (0.3, 0.0), 0.1),) for e in truth}
    graph = PoseGraph(*SETTINGS, factors=factors())
    for m in LOG[:cut]:
        graph.optimise(m, fixes[m.frame_id])
    data = graph.checkpoint()
    restored = PoseGraph.restore(data, *SETTINGS, factors())
    assert restored.checkpoint() == data
    late, forgetful = ([g.optimise(m, fixes[m.frame_id]) for m in LOG[cut:]] for g in (restored, graph_with(Gnss())))
    assert [graph.optimise(m, fixes[m.frame_id]) for m in LOG[cut:]] == late
    assert late != forgetful
    with pytest.raises(CheckpointError, match=r"was written with factors = .*GNSS.*, this graph has"):
        PoseGraph.restore(data, *SETTINGS)


def test_new_epoch_clears_the_factor_state() -> None:
    log = [*LOG[:5], replace(LOG[5], cc=None, status=())]
    graph = graph_with(Gnss(every_ns=10**12))
    for m in log:
        graph.optimise(m, (Fix(0.0, 0.0, 1.0),))
        assert ("GNSS" in graph.outliers) == (m.frame_id in (LOG[0].frame_id, LOG[5].frame_id))


def test_non_finite_edge_is_left_out() -> None:
    nowhere = Fix(float("nan"), 0.0, 1.0), Line(float("inf"), 0.0, (1.0, 1.0))
    assert run(graph_with(Gnss(), LaneLine()), {m.frame_id: nowhere for m in LOG}) == run(graph_with(), {})


def test_line_constrains_lateral_position_and_heading() -> None:
    before = run(graph_with(), {})[-1]
    T = before.T_world_ego
    assert abs(np.sin(T.yaw_rad)) > 0.05  # the line is not the ego's own x axis
    line = Line(T.y_m + 0.2, T.yaw_rad - 0.02, (0.05, 0.01))
    after = run(graph_with(LaneLine()), {LOG[-1].frame_id: (line,)})[-1]
    J = np.array([[np.sin(T.yaw_rad), np.cos(T.yaw_rad), 0.0], [0.0, 0.0, 1.0]])
    assert_is(after, updated(before, J, np.array([0.2, -0.02]), np.diag(np.square(line.sigmas))))


class Gap(Factor):
    """The ego keeps its distance to the first vehicle, which ties the two."""

    name = "gap"
    equation = "x"

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        if not len(window.velocity):
            return None
        J = np.zeros((1, window.layout.size))
        J[0, [EGO_PLACE[0], window.layout.poses[0, 0]]] = 1.0
        return Linearised([0.01], J, np.full((1, 1, 1), 0.1))


class TyingGap(Gap):
    ties_vehicles = True


def test_vehicles_connected_by_an_edge_share_a_covariance() -> None:
    """Else each vehicle has its own block of P, and one that ties them is refused rather than taken by half."""
    apart, tied = graph_with(), graph_with(TyingGap())
    run(apart, {})
    estimates = run(tied, {})
    assert apart.window.of_vehicles.shape == (3, OF_VEHICLE, OF_VEHICLE)
    assert tied.window.of_vehicles.shape == (1, 3 * OF_VEHICLE, 3 * OF_VEHICLE)
    assert np.linalg.eigvalsh(tied.window.P).min() > -1e-9
    assert len(estimates[-1].vehicles) == 3
    with pytest.raises(ValueError, match="ties_vehicles"):
        run(graph_with(Gap()), {})


def test_line_of_a_vehicle_is_the_same_edge_jointly_and_separately() -> None:
    class Aside(Factor):
        name = "aside"
        equation = "y + yaw"
        of_vehicles = True

        def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
            rows = [*range(len(window.velocity))]
            J = np.tile(np.eye(1, OF_VEHICLE, 1) + np.eye(1, OF_VEHICLE, 2), (len(rows), 1, 1))
            return Linearised([0.05] * len(rows), J, np.full((len(rows), 1, 1), 0.2), vehicles=rows) if rows else None

    class Together(Factor):
        name = "nothing"
        equation = ""
        ties_vehicles = True

    apart, together = graph_with(Aside()), graph_with(Aside(), Together())
    for m in LOG:
        of_one = replace(m, cv=m.cv[:1], vv=m.vv[:1])
        (a,), (b,) = (graph.optimise(of_one).vehicles for graph in (apart, together))
        assert a.cov == pytest.approx(b.cov, rel=1e-6, abs=1e-9)
        assert a.velocity_mps == pytest.approx(b.velocity_mps, rel=1e-6, abs=1e-7)
        assert a.T_world_vehicle.between(b.T_world_vehicle).log() == pytest.approx(np.zeros(3), abs=1e-7)


def test_a_graph_of_odometry_alone_is_dead_reckoning() -> None:
    config = GraphConfig()
    graph, pose = PoseGraph(config, WeightsConfig(), factors=[Odometry(config)]), SE2()
    for m in LOG:
        pose = pose if m.cc is None else pose @ m.cc.T_from_to
        assert graph.optimise(m).T_world_ego.between(pose).log() == pytest.approx(np.zeros(3), abs=1e-12)
        assert graph.outliers == {}


def test_two_factors_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match=r"two factors of one name.*GNSS, GNSS"):
        graph_with(Gnss(), Gnss())


SIGMAS_M = np.array([2.0, 0.3])  # along the line of sight, and across
EXACT = tuple(np.diag([1e-8, 1e-8, 1e-10]).ravel().tolist())
positive, numbers = st.floats(1e-3, 1e2), st.floats(-3.0, 3.0)


@given(st.floats(0.0, 2.0 * math.pi), numbers, numbers, numbers, numbers)
def test_factors_reproduce_covariance_along_line_of_sight(
    bearing_rad: float, a: float, b: float, c: float, d: float
) -> None:
    A = np.array([[a, b], [c, d]])
    covs = np.zeros((1, 3, 3))
    covs[0, :2, :2] = A @ A.T  # singular ones, too
    (xx, xy), (_, yy) = (A @ A.T).tolist()
    columns = line_of_sight_factor(cmath.rect(1.0, bearing_rad), 0.5 * (xx + yy), complex(0.5 * (xx - yy), xy))
    F = np.array([[[c.real for c in columns], [c.imag for c in columns]]])
    np.testing.assert_allclose(F @ F.transpose(0, 2, 1), covs[:, :2, :2], atol=1e-5 * (1.0 + covs.max()))
    across = np.array([-math.sin(bearing_rad), math.cos(bearing_rad)])
    np.testing.assert_allclose(abs(across @ F[0, :, 1]), np.linalg.norm(F[0, :, 1]), rtol=1e-9)


@given(st.tuples(positive, positive), st.tuples(positive, positive), st.floats(0.0, 100.0), positive)
def test_error_is_fully_correlated_without_change(
    now: tuple[float, float], before: tuple[float, float], driven_s: float, memory_s: float
) -> None:
    of, driven = (
        lasting_correlation(np.array([now]), np.array([before]), np.array([driven_s]), memory_s),
        np.array([driven_s]),
    )
    assert (of >= 0.0).all()
    assert (of <= 1.0).all()
    np.testing.assert_array_equal(of, lasting_correlation(np.array([before]), np.array([now]), driven, memory_s))
    np.testing.assert_array_equal(lasting_correlation(np.array([now]), np.array([now]), np.zeros(1), memory_s), 1.0)


def variances(frames: int, ego_mps: float, config: GraphConfig) -> Floats:
    """(2,) of a standing vehicle's place along and across the line of sight, seen in so many frames at 10 Hz."""
    graph = PoseGraph(config, WeightsConfig())
    for k in range(frames):
        step = SE2(ego_mps / 10.0)
        seen = new_edge(1, k, SE2(60.0 - k * step.x_m), (*np.square(SIGMAS_M).tolist(), 0.01))
        (vehicle,) = graph.optimise(step_at(k, step, cov=EXACT, cv=(seen,))).vehicles
    return np.diag(np.reshape(vehicle.cov, (3, 3)))[:2]


def test_correlated_error_does_not_average_out() -> None:
    steady = {"change_forward_mps": 1e-3, "change_sideways_mps": 1e-3, "birth_forward_mps": 1e-2}
    config = GraphConfig(**steady, birth_sideways_mps=1e-2)
    floor = config.lasting_share * np.square(SIGMAS_M)
    assert (variances(300, 0.0, config) > 0.95 * floor).all()  # a stationary ego always observes the same
    driven, standing = (variances(40, mps, config) for mps in (10.0, 0.0))
    assert (driven < standing).all()  # new road, new errors
    assert (variances(300, 0.0, GraphConfig(**steady, birth_sideways_mps=1e-2, lasting_share=0.0)) < 0.1 * floor).all()
