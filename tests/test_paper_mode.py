"""Paper mode: the information that each edge adds, and nothing else."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.bench.tracking.benchmark import PAPER
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.edges import CvEdges
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.factors.vehicle_landmarks import VehicleLandmarks
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.graph.window import Window
from birdslam.perf.latency.drive import Drive, DriveConfig, drive
from birdslam.slam import SlamConfig
from birdslam.types import Estimate, LandmarkEdge, Measurements, Status
from tests.batch_se2 import ego_key, solve, vehicle_key

# Sec. 3.3.2 of the paper
LAMBDA_CP, LAMBDA_CV = 10_000.0, (10.0, 1_000.0)
THRESHOLD_M = 20.0
EXACT = DriveConfig(frames=40, rate_hz=10.0, vehicles=3, landmarks=12, lane_points=0, noise=0.0, traffic="convoy")
FRAMES = range(5, 40)  # before, what is known of the first pose leaves nothing to be inverted


def told_of_more(world: Drive) -> list[Measurements]:
    """The log with what the paper's graph does not listen to: an error of the scale that lasts, and standstill."""
    return [
        replace(m, scale_sigma_rel=0.03, status=(*m.status, Status.STANDSTILL) if m.frame_id % 7 == 6 else m.status)
        for m in world.measurements
    ]


def run(log: list[Measurements]) -> list[Estimate]:
    graph = PoseGraph(PAPER.graph, PAPER.weights)
    return [graph.optimise(m) for m in log]


class Probe(Factor):
    """Says nothing itself: what the window knew of the newest frame before and after the others' steps."""

    equation = ""

    def __init__(self, name: str) -> None:
        self.name = name

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        self.before = window.P.copy()
        return None

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        self.frame, self.after = frame, window.P.copy()
        self.at, self.world = list(window.at), window.world


def added(log: list[Measurements]) -> list[tuple[Window, CvEdges, Floats]]:
    """What the edges of each frame add to the information about the state: the window, its CV edges, (n, n)."""
    probe, out = Probe("probe"), []
    without_vehicles_cp = replace(PAPER.weights, cp_vehicles=None)
    graph = PoseGraph(
        PAPER.graph, without_vehicles_cp, factors=[probe, *standard_factors(PAPER.graph, without_vehicles_cp)]
    )
    for m in log:
        graph.optimise(m)
        assert graph.window is not None
        more = np.zeros_like(probe.after)
        if m.frame_id in FRAMES:
            more = np.linalg.inv(probe.after) - np.linalg.inv(probe.before)
        out.append((graph.window, probe.frame.associations.cv, more))
    return out


def test_each_edge_adds_exactly_its_lambda() -> None:
    log = told_of_more(drive(EXACT, 2))
    landmarks = [{e.landmark for e in m.cp if e.x_m <= THRESHOLD_M} for m in log]
    summed = 0
    for m, (window, cv, more) in zip(log, added(log), strict=True):
        if m.frame_id not in FRAMES:
            continue
        expected = np.zeros_like(more)
        known = len(
            landmarks[m.frame_id] & landmarks[m.frame_id - 1]
        )  # those that the world has, from their first sight
        summed += known
        expected[[0, 1], [0, 1]] = LAMBDA_CP * known  # of the ego's place in the world: not its yaw, no other pose
        assert len(cv.rows) == len(m.cv) == 3
        far_to_near = sorted(zip(-cv.at.real, cv.rows, strict=True))
        weights = []
        for _, row in far_to_near:
            rows = window.layout.poses[row]
            weights.append(more[rows[0], rows[0]])
            expected[rows, rows] = weights[-1]
        np.testing.assert_allclose(more, expected, rtol=2e-3, atol=1e-3 * LAMBDA_CP * max(known, 1))
        np.testing.assert_allclose(*(np.diag(one)[window.layout.poses] for one in (more, expected)), rtol=1e-2)
        assert LAMBDA_CV[0] <= weights[0] * 1.01
        assert weights[-1] <= LAMBDA_CV[1] * 1.01
        assert weights == sorted(weights)
    assert summed > 100


def test_cc_cv_and_vv_are_the_batch_of_the_papers_edges() -> None:
    """gtsam's marginals on a log with standstill and a scale error, which the batch ignores."""
    log = told_of_more(drive(replace(EXACT, landmarks=0), 2))
    estimate = run(log)[-1]
    batch = solve(log, GraphConfig(constant_velocity=False), PAPER.weights)
    marginals = gtsam.Marginals(batch.factors, batch.values)
    last = log[-1].frame_id
    covs = np.reshape(estimate.cov, (3, 3)), marginals.marginalCovariance(ego_key(last))
    np.testing.assert_allclose(*covs, rtol=0.01, atol=1e-3 * covs[1].max())
    assert len(estimate.vehicles) == 3
    for v in estimate.vehicles:
        covs = np.reshape(v.cov, (3, 3)), marginals.marginalCovariance(vehicle_key(v.vehicle, last))
        np.testing.assert_allclose(*covs, rtol=0.02, atol=1e-2 * covs[1].max())


def test_landmark_is_fixed_at_first_observation() -> None:
    """Without noise except for one ego step 0.5 m too long: a landmark seen before and after it takes
    the ego back by the share of its weight, and so do the frames after, since X_p of Eq. 3 moves with none of them."""
    log = drive(replace(EXACT, vehicles=0, landmarks=0), 2).measurements
    poses = [SE2()]
    for m in log[1:]:
        poses.append(poses[-1] @ m.cc.T_from_to)
    seen = range(20, 26)
    for k in seen:
        x_m, y_m = (poses[k].inverse() @ (poses[20] @ np.array([15.0, 2.0]))).tolist()
        log[k] = replace(log[k], cp=(LandmarkEdge(landmark=1, frame=k, x_m=x_m, y_m=y_m, cov=(1.0, 0.0, 0.0, 1.0)),))
    step = log[22].cc
    assert step is not None
    log[22] = replace(log[22], cc=replace(step, T_from_to=SE2(0.5) @ step.T_from_to))
    graph = PoseGraph(PAPER.graph, PAPER.weights)
    errors_m = []
    for m, pose in zip(log, poses, strict=True):
        gap = pose.inverse() @ graph.optimise(m).T_world_ego
        errors_m.append(gap.x_m)
    assert abs(errors_m[21]) < 1e-6
    # CC and CP weigh alike: two CC edges and the CP edge between them leave the ego's place 1.95 of their variance
    assert errors_m[22] == pytest.approx(0.5 * 1.0 / 2.95, rel=0.02)
    assert max(map(abs, errors_m[23:])) < 0.5 * errors_m[22]  # and nothing brings it back


def test_reversed_yaw_is_used_as_measured() -> None:
    """One detection the wrong way round turns the vehicle by its weight, not by half a turn at no cost."""
    log = drive(replace(EXACT, landmarks=0), 2).measurements
    edge = log[20].cv[0]
    about = replace(edge, T_ego_vehicle=edge.T_ego_vehicle @ SE2(0.0, 0.0, 3.0))
    (before,), (after,) = (
        [v.T_world_vehicle for v in run([*log[:20], one])[-1].vehicles if v.vehicle == edge.vehicle]
        for one in (log[20], replace(log[20], cv=(about, *log[20].cv[1:])))
    )
    assert 2.9 < abs(before.between(after).yaw_rad) < 2.99  # CV outweighs VV, but does not silence it
    default = PoseGraph(replace(PAPER.graph, front_back_ambiguity=True), PAPER.weights)
    for m in log[:20]:
        default.optimise(m)
    turned = default.optimise(replace(log[20], cv=(about, *log[20].cv[1:])))
    (there,) = (v.T_world_vehicle for v in turned.vehicles if v.vehicle == edge.vehicle)
    assert abs(before.between(there).yaw_rad) == pytest.approx(3.0, abs=0.005)  # half a turn, and a bit back


@pytest.mark.parametrize("kind", ["cv", "cp"])
def test_no_edge_is_an_outlier(kind: str) -> None:
    """Twenty times the error of one edge moves the estimate twenty times as far."""
    log = drive(EXACT, 2).measurements

    def moved_m(error_m: float) -> float:
        m = log[20]
        if kind == "cv":
            edge = replace(m.cv[0], T_ego_vehicle=SE2(error_m) @ m.cv[0].T_ego_vehicle)
            m = replace(m, cv=(edge, *m.cv[1:]))
        else:
            m = replace(m, cp=(replace(m.cp[0], x_m=m.cp[0].x_m - error_m), *m.cp[1:]))
        (before,), (after,) = ([e for e in run([*log[:20], one]) if e.frame_id == 20] for one in (log[20], m))
        if kind == "cv":
            poses = [
                next(v.T_world_vehicle for v in e.vehicles if v.vehicle == m.cv[0].vehicle) for e in (before, after)
            ]
        else:
            poses = [before.T_world_ego, after.T_world_ego]
        return float(np.hypot(poses[1].x_m - poses[0].x_m, poses[1].y_m - poses[0].y_m))

    assert moved_m(0.5) > 0.02
    assert moved_m(10.0) == pytest.approx(20.0 * moved_m(0.5), rel=0.05)


def test_cp_of_vehicles_adds_lambda_to_world_position() -> None:
    """Eq. 7 with A a vehicle: one edge for each known landmark, to the place, of no agent the orientation."""
    log = drive(EXACT, 2).measurements
    landmarks = [{e.landmark for e in m.cp if e.x_m <= THRESHOLD_M} for m in log]
    weights, checked = replace(PAPER.weights, cp_vehicles=LAMBDA_CP), 0
    before, after, factors = Probe("before"), Probe("after"), standard_factors(PAPER.graph, weights)
    (k,) = (k for k, factor in enumerate(factors) if isinstance(factor, VehicleLandmarks))
    graph = PoseGraph(PAPER.graph, weights, factors=[*factors[:k], before, factors[k], after, *factors[k + 1 :]])
    estimates = []
    for m in log:
        estimates.append(graph.optimise(m))
        if m.frame_id not in FRAMES:
            continue
        np.testing.assert_allclose(after.at, before.at, atol=1e-6)  # nothing errs
        known = len(landmarks[m.frame_id] & landmarks[m.frame_id - 1])
        more = np.linalg.inv(after.after) - np.linalg.inv(before.after)
        expected = np.zeros_like(more)
        for row in graph.window.layout.poses if known else ():
            at = before.at[graph.window.nodes + (row[0] - graph.window.layout.poses[0, 0]) // 6]
            H = np.zeros((2, len(more)))
            H[:, [0, 1]] = H[:, row[:2]] = np.eye(2)
            H[:, 2] = -at.imag, at.real
            expected += LAMBDA_CP * known * H.T @ H
        np.testing.assert_allclose(more, expected, rtol=2e-3, atol=1e-3 * max(expected.max(), 1.0))
        checked += known
    assert checked > 100
    for with_them, without in zip(estimates, run(log), strict=True):
        assert with_them.T_world_ego.between(without.T_world_ego).log() == pytest.approx(np.zeros(3), abs=1e-6)


def test_cp_of_a_vehicle_moves_it_to_its_landmark() -> None:
    """One CV edge that is 1 m off, against a landmark seen with it: the car goes there by CP's share of the weights."""
    log = drive(replace(EXACT, vehicles=1, landmarks=12), 2).measurements
    last = log[-1]
    (edge,) = last.cv
    off = replace(
        edge, T_ego_vehicle=SE2(edge.T_ego_vehicle.x_m + 1.0, edge.T_ego_vehicle.y_m, edge.T_ego_vehicle.yaw_rad)
    )
    log[-1] = replace(last, cv=(off,))
    moved = []
    for weight in (None, LAMBDA_CP):
        graph = PoseGraph(PAPER.graph, replace(PAPER.weights, cp_vehicles=weight))
        seen = [graph.optimise(m) for m in log][-1]
        T = seen.T_world_ego.between(seen.vehicles[0].T_world_vehicle)
        moved.append(T.x_m - edge.T_ego_vehicle.x_m)
    left = 1.0 - np.array(moved)  # what the vehicle's way until then still counts
    assert left[0] > 0.005
    assert abs(left[1]) < 0.1 * left[0]  # CP's weight beside CV's is ten times as large, and more


def test_cp_of_vehicles_needs_landmarks_in_the_world() -> None:
    with pytest.raises(ValueError, match="first_sight"):
        PoseGraph(GraphConfig(), WeightsConfig(cp_vehicles=1.0))
    with pytest.raises(ValueError, match="first_sight"):
        SlamConfig(weights=WeightsConfig(cp_vehicles=1.0))
