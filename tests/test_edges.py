"""Edges of simulated drives against real ones, and what vehicles' edges may move."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.bench.simulation.drive import DriveConfig, drive
from birdslam.bench.simulation.edge_statistics import SPAN, EdgeStatistics, edge_statistics
from birdslam.bench.simulation.landmark_errors import LandmarkErrors, landmark_errors
from birdslam.bench.simulation.odometry import EXACT, Drift, SimulatedOdometry, SimulationConfig
from birdslam.bench.tracking.benchmark import make_log
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Perception, Ready
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking
from birdslam.types import EgoEdge, LandmarkEdge, Measurements
from tests import tracking_world

# Of KITTI tracking 0002's images by the whole front end, as `python -m perf edges` prints it: 87 spans
REAL = EdgeStatistics(
    spans=87,
    points_per_frame=11.9,
    shared=3.44,
    cc=0.0143,
    cc_later=-0.22,
    cc_tail=0.0,
    cp=0.0518,
    cp_stated=0.0659,
    seen=0.59,
    seen_sigma=1.02,
    common_along_m=0.291,
    common_across_m=0.051,
)

# What landmarks of KITTI tracking 0005 and 0002 and odometry 00 err by (`python -m perf edges`)
REAL_LANDMARKS = {
    "pitch_mrad": (5.0, 4.1, 5.1),
    "pitch_later": (0.36, 0.79, 0.71),
    "roll_mrad": (10.7, 7.6, 11.0),
    "roll_later": (0.32, 0.32, 0.86),
    "own_px": (0.82, 0.68, 0.75),
}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> TrackingSequence:
    return open_tracking(tracking_world.write(tmp_path_factory.mktemp("edges"), frames=150), "0002")


def simulated(sequence: TrackingSequence, config: SimulationConfig, seed: int) -> list[Measurements]:
    odometry = SimulatedOdometry(sequence.camera, sequence.camera_poses, config, np.random.default_rng(seed))
    nothing = Perception(None, None, {"detector": 0}, ())
    frames = range(len(sequence))
    return make_log(sequence, frames, odometry, lambda frame, image: Ready(nothing), None, FrontEndConfig())


def test_simulated_edges_are_worth_what_real_ones_are(sequence: TrackingSequence) -> None:
    """Within what four drives and the 20 independent spans of 0002 let one tell."""
    ego = dict(enumerate(sequence.ego_truth(0)))
    found = [edge_statistics(simulated(sequence, SimulationConfig(), seed), ego) for seed in range(4)]
    drawn = [one for one in found if one is not None]
    assert len(drawn) == len(found)

    def mean(name: str) -> float:
        return float(np.mean([getattr(one, name) for one in drawn]))

    assert mean("points_per_frame") == pytest.approx(REAL.points_per_frame, rel=0.3)
    assert mean("shared") == pytest.approx(REAL.shared, rel=0.5)
    assert mean("cc") == pytest.approx(REAL.cc, rel=0.4)
    assert mean("cp") == pytest.approx(REAL.cp, rel=0.4)
    assert mean("cp_stated") == pytest.approx(REAL.cp_stated, rel=0.5)
    # A landmark knows less of a way's length than the odometry does: this is why CP is worth so little
    assert mean("cp") > 2.0 * mean("cc")
    assert abs(mean("seen") - REAL.seen) < 2.0 * REAL.seen_sigma


def test_simulated_landmarks_err_as_real_ones(sequence: TrackingSequence) -> None:
    """The mean of four drives is within a quarter of what three real ones show: pitch, roll, and how long they last."""
    ego = dict(enumerate(sequence.ego_truth(0)))
    drawn = [landmark_errors(simulated(sequence, SimulationConfig(), seed), ego, sequence.camera) for seed in range(4)]
    for name, real in REAL_LANDMARKS.items():
        found = float(np.mean([getattr(one, name) for one in drawn]))
        assert 0.75 * min(real) < found < 1.25 * max(real), name


def test_what_landmarks_err_by_is_found_whatever_the_axes_of_the_poses(sequence: TrackingSequence) -> None:
    """Pitch, roll and own errors of the sizes that were put in; true poses whose axes are off change none."""
    noise = replace(
        EXACT.noise,
        landmark_pitch_rad=Drift(0.0, 0.004, 20.0),
        landmark_roll_rad=Drift(0.0, 0.012, 20.0),
        landmark_px=0.2,
        landmarks=40.0,
    )
    logs = [simulated(sequence, replace(EXACT, noise=noise), seed) for seed in range(4)]
    ego = dict(enumerate(sequence.ego_truth(0)))
    off = SE2(yaw_rad=0.01)  # between the axes of the true poses and the car's
    turned = {frame: T @ off for frame, T in ego.items()}
    for poses in (ego, turned):
        found = [landmark_errors(log, poses, sequence.camera) for log in logs]

        def mean(name: str, found: list[LandmarkErrors | None] = found) -> float:
            return float(np.mean([getattr(one, name) for one in found]))

        assert mean("pitch_mrad") == pytest.approx(4.0, rel=0.3)
        assert mean("roll_mrad") == pytest.approx(12.0, rel=0.3)
        assert min(mean("pitch_later"), mean("roll_later")) > 0.6
        assert mean("own_px") == pytest.approx(0.2, rel=0.4)


def test_exact_edges_have_no_error(sequence: TrackingSequence) -> None:
    log = simulated(sequence, EXACT, 0)
    found = edge_statistics(log, dict(enumerate(sequence.ego_truth(0))))
    assert found is not None
    assert max(found.cc, found.cp, np.nan_to_num(found.common_along_m), np.nan_to_num(found.common_across_m)) < 1e-3


@pytest.mark.parametrize(("scale_of_points", "seen"), [(1.0, 1.0), (1.05, 0.0)])
def test_landmarks_that_share_the_odometrys_error_see_nothing_of_it(scale_of_points: float, seen: float) -> None:
    """An odometry 4 to 6 % too long, and landmarks where they are or as much farther off."""
    rng, log, cov = np.random.default_rng(0), [], (1e-4, 0.0, 0.0, 1e-4)
    places = [SE2(4.0 + 1.5 * k, (-1.0) ** k) for k in range(80)]
    for k in range(50):
        step = SE2(1.05 + 0.01 * rng.standard_normal())
        cc = EgoEdge(from_frame=k - 1, to_frame=k, T_from_to=step, cov=tuple(0.01 * np.eye(3).ravel())) if k else None
        near = [(i, p.x_m - k, p.y_m) for i, p in enumerate(places) if 3.0 < p.x_m - k < 18.0]
        cp = tuple(
            LandmarkEdge(landmark=i, frame=k, x_m=scale_of_points * x, y_m=scale_of_points * y, cov=cov)
            for i, x, y in near
        )
        t_ns = k * 100_000_000
        log.append(Measurements(frame_id=k, t_source_ns=t_ns, t_capture_ns=t_ns, t_utc_ns=t_ns, cc=cc, cp=cp))
    found = edge_statistics(log, {k: SE2(float(k)) for k in range(50)})
    assert found is not None
    assert found.spans == 50 - SPAN
    assert found.seen == pytest.approx(seen, abs=0.15)
    assert math.exp(found.cc) - 1.0 < 0.02
    assert np.nan_to_num(found.common_along_m) == pytest.approx((scale_of_points - 1.0) * SPAN, abs=1e-6)
    assert np.nan_to_num(found.common_across_m) < 1e-6


def test_a_vehicle_is_where_its_own_edges_say_whoever_else_is_in_sight() -> None:
    """Its estimate without the others' edges is the same; joint, these move it a little, through the ego."""
    world = drive(DriveConfig(frames=40, vehicles=4, landmarks=6, lane_points=0, traffic="convoy"), seed=3)
    chosen = world.measurements[0].cv[0].vehicle
    gaps_m = {}
    for may_move in (False, True):
        settings = GraphConfig(vehicles_move_ego=may_move), WeightsConfig()
        crowd, alone = PoseGraph(*settings), PoseGraph(*settings)
        for m in world.measurements:
            own = replace(m, cv=tuple(e for e in m.cv if e.vehicle == chosen), vv=())
            ends = [graph.optimise(one).vehicles for graph, one in ((crowd, m), (alone, own))]
        (in_crowd,), (by_itself,) = ([v for v in vehicles if v.vehicle == chosen] for vehicles in ends)
        T, other = in_crowd.T_world_vehicle, by_itself.T_world_vehicle
        gaps_m[may_move] = math.hypot(T.x_m - other.x_m, T.y_m - other.y_m)
        if not may_move:
            assert in_crowd.cov == pytest.approx(by_itself.cov, rel=1e-9, abs=1e-12)
            assert in_crowd.velocity_cov == pytest.approx(by_itself.velocity_cov, rel=1e-9, abs=1e-12)
    assert gaps_m[False] < 1e-9
    assert 1e-3 < gaps_m[True] < 1.0


def test_vehicles_edges_leave_the_ego_where_it_is_unless_they_may_move_it() -> None:
    """Its pose and covariance are those without any vehicle; the vehicles' places follow their edges all the same."""
    world = drive(DriveConfig(frames=30, vehicles=3, landmarks=6, lane_points=0), seed=3)
    ends = {}
    for name, may_move, cv in (("apart", False, True), ("joint", True, True), ("alone", False, False)):
        graph = PoseGraph(GraphConfig(vehicles_move_ego=may_move), WeightsConfig())
        ends[name] = [graph.optimise(m if cv else replace(m, cv=(), vv=())) for m in world.measurements][-1]
    assert ends["apart"].T_world_ego.between(ends["alone"].T_world_ego).log() == pytest.approx([0.0] * 3, abs=1e-9)
    assert ends["apart"].cov == pytest.approx(ends["alone"].cov, rel=1e-6, abs=1e-12)
    assert math.dist(ends["joint"].cov, ends["alone"].cov) > 1e-6
    for vehicle in ends["apart"].vehicles:
        T = world.vehicles[vehicle.vehicle][29]
        assert math.hypot(vehicle.T_world_vehicle.x_m - T[0], vehicle.T_world_vehicle.y_m - T[1]) < 5.0
