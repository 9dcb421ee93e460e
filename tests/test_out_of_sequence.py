"""Late detections: the same vehicles as with detections in time, predicted to the present."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Detections, Perception, Ready
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.road_users.out_of_sequence import OpenFrame, OutOfSequenceConfig, OutOfSequenceTracker
from birdslam.road_users.placement.localisation import LocalisationConfig, iou
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig
from birdslam.road_users.tracking import Tracker
from birdslam.types import Measurements
from tests.boxes import CAR, car_px
from tests.test_frontend import CAMERA, ScriptedOdometry, frame, motion

STEP = SE2(0.8, 0.0, 0.01)  # of the ego, a frame of 0.1 s
PERIOD_NS = 100_000_000
FRAMES = 25


def ego(k: int) -> SE2:
    pose = SE2()
    for _ in range(k):
        pose = pose @ STEP
    return pose


EGO = [ego(k) for k in range(FRAMES)]


def cars(k: int) -> list[SE2]:
    """In the world of frame 0: one parked, one driving on ahead, one that comes."""
    return [SE2(40.0, 5.0, 0.0), SE2(15.0 + 1.1 * k, 0.5, 0.0), SE2(75.0 - 1.0 * k, 10.0, math.pi)]


def detections(k: int, noise_px: float = 0.0, seed: int = 0, heights_m: tuple[float, ...] = (1.53,) * 3) -> Detections:
    rng = np.random.default_rng([seed, k])
    boxes = []
    for pose, height_m in zip(cars(k), heights_m, strict=True):
        box = car_px(EGO[k].between(pose), height_m, CAMERA.ground)
        boxes.append(box + noise_px * rng.standard_normal(4))
    return Detections(np.array(boxes), np.full(3, 0.9), ("car",) * 3)


def out_of_sequence(config: OutOfSequenceConfig | None = None) -> OutOfSequenceTracker:
    ground_size = GroundSizeFilter(CAMERA, GroundSizeConfig())
    tracker = Tracker(CAMERA, TrackingConfig(), LocalisationConfig(), ground_size)
    return OutOfSequenceTracker(tracker, config or OutOfSequenceConfig())


def open_frame(k: int) -> OpenFrame:
    ground = GroundPlane(CAMERA.height_m, CAMERA.pitch_rad + 1e-4 * k)
    return OpenFrame(EgoFrame(k, k * PERIOD_NS, EGO[k]), 0.1, 0.0, ground, 0.003)


def follow(used: list[int | None], noise_px: float = 0.5) -> tuple[list[tuple[float, ...]], list[GroundPlane]]:
    """Observations if frame k has the detections of frame used[k], and the road under the camera in each frame."""
    vehicles, seen, roads = out_of_sequence(), [], []
    for k, source in enumerate(used):
        vehicles.open_frame(open_frame(k))
        tracks = vehicles.ingest_detections(
            None if source is None else detections(source, noise_px), -1 if source is None else source
        )
        seen += [
            (t.frame.frame_id, t.number, *t.predicted_m, *t.velocity_mps, *t.kinematic_cov.ravel()) for t in tracks
        ]
        roads.append(vehicles.road.ground)
    return seen, roads


@given(st.lists(st.integers(0, 4), min_size=FRAMES, max_size=FRAMES))
@settings(max_examples=5)
def test_late_detections_give_the_same_vehicles(delays: list[int]) -> None:
    used: list[int | None] = []
    at_work: tuple[int, int] | None = None
    found: int | None = None
    for k, delay in enumerate(delays):
        at_work = at_work or (k, k + delay)
        if at_work[1] <= k:
            found, at_work = at_work[0], None
        used.append(found)
    in_time: list[int | None] = [k if k in used else None for k in range(FRAMES)]
    late, roads = follow(used)
    punctual, punctual_roads = follow(in_time)
    assert late == [seen for seen in punctual if seen[0] in used]
    whole = [k for k in range(FRAMES) if used[k] == k]
    assert [roads[k] for k in whole] == [punctual_roads[k] for k in whole]


@pytest.mark.parametrize(("every", "delay"), [(3, 2), (4, 1), (2, 1), (5, 0)])
def test_frames_without_detector_are_processed_before_next_detections(every: int, delay: int) -> None:
    """Where they settle changes nothing but when the work is done: the tracks and the road are those of before."""

    def drive(told: bool) -> tuple[list[list[float]], list[GroundPlane], list[int]]:
        vehicles, seen, roads, settled = out_of_sequence(), [], [], []
        localise, work = vehicles.tracker.localise_vehicles, []
        vehicles.tracker.localise_vehicles = lambda *a: work.append(a) or localise(*a)
        for k in range(FRAMES):
            look = k // every * every
            known = look if k - look >= delay else look - every
            work.clear()
            vehicles.open_frame(open_frame(k))
            found = detections(known) if known >= 0 else None
            tracks = vehicles.ingest_detections(
                found, known, awaited_from=(look if known < look else k + 1) if told else 0
            )
            seen += [
                [t.frame.frame_id, t.number, *t.predicted_m, *t.velocity_mps, *t.kinematic_cov.ravel()] for t in tracks
            ]
            roads.append(vehicles.road.ground)
            settled.append(len(work))
        return seen, roads, settled

    told, kept_open = drive(True), drive(False)
    assert told[0] == kept_open[0]
    assert told[0]
    for one, other in zip(told[1], kept_open[1], strict=True):
        assert (one.height_m, one.pitch_rad, one.roll_rad) == pytest.approx(
            (other.height_m, other.pitch_rad, other.roll_rad), rel=0, abs=1e-15
        )
    assert sum(told[2]) >= sum(kept_open[2])
    arrives = range(every + delay, FRAMES, every)
    assert max(told[2][k] for k in arrives) < max(kept_open[2][k] for k in arrives)


def test_each_result_is_used_once() -> None:
    seen, _ = follow([0, 1, 2, 2, 2, 2, 6])
    assert sorted({row[0] for row in seen}) == [1, 2, 6]
    vehicles = out_of_sequence(OutOfSequenceConfig(latest_ms=250.0))
    tracks: list[int] = []
    for k, source in enumerate([0, 1, 2, 2, 2, 2, 2, 2, 2, 2, 3, 8, 8]):  # 3 is 0.7 s old, 8 is 0.3 s old when it comes
        vehicles.open_frame(open_frame(k))
        tracks += [t.frame.frame_id for t in vehicles.ingest_detections(detections(source), source)]
    assert sorted(set(tracks)) == [1, 2]


def test_an_older_result_does_not_follow_a_newer_one() -> None:
    seen, _ = follow([0, 1, 2, 3, 4, 3, 6])
    assert sorted({row[0] for row in seen}) == [1, 2, 3, 4, 6]


def test_restarted_source_discards_pending_detections() -> None:
    vehicles = out_of_sequence()
    for k in range(6):
        vehicles.open_frame(open_frame(k))
        vehicles.ingest_detections(detections(min(k, 4)), min(k, 4))
    vehicles.open_frame(open_frame(0))
    assert vehicles.ingest_detections(detections(5), 5) == []
    vehicles.ingest_detections(detections(0), 0)
    assert vehicles.road is vehicles.ground_size


def drive(delay: int, seed: int, noise_px: float, heights_m: tuple[float, ...], **config: float) -> list[Measurements]:
    """The front end with detections that are `delay` frames late."""
    script = {k: motion(k, STEP) for k in range(1, FRAMES)}
    tracking = TrackingConfig(**config)
    front = FrontEnd(CAMERA, FrontEndConfig(tracking=tracking), ScriptedOdometry(script))
    out = []
    for k in range(FRAMES):
        perception = Perception()
        if k >= delay:
            perception = Perception(detections(k - delay, noise_px, seed, heights_m), None, {"detector": delay}, ())
        out.append(front.measure(frame(k), Ready(perception)))
    return out


def deviations(log: list[Measurements]) -> tuple[np.ndarray, np.ndarray]:
    """Of CV edges from where the vehicles truly are in the edge's frame: Mahalanobis distances squared; metres."""
    squared, metres = [], []
    for m in log[12:]:
        for edge in m.cv:
            assert edge.frame == m.frame_id
            gaps = [EGO[m.frame_id].between(car) for car in cars(m.frame_id)]
            truth = min(
                gaps, key=lambda t, e=edge: math.hypot(t.x_m - e.T_ego_vehicle.x_m, t.y_m - e.T_ego_vehicle.y_m)
            )
            R = edge.T_ego_vehicle.rotation()
            error = R.T @ [edge.T_ego_vehicle.x_m - truth.x_m, edge.T_ego_vehicle.y_m - truth.y_m]
            squared.append(float(error @ np.linalg.solve(np.reshape(edge.cov, (3, 3))[:2, :2], error)))
            metres.append(float(np.linalg.norm(error)))
    return np.array(squared), np.array(metres)


def sizes(seed: int) -> tuple[float, ...]:
    return tuple(CAR.height_m * np.exp(CAR.sigma_height_rel * np.random.default_rng(seed).standard_normal(3)))


@pytest.mark.parametrize("delay", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_late_vehicles_are_within_their_covariance(delay: int) -> None:
    late = [deviations(drive(delay, seed, 1.0, sizes(seed))) for seed in range(4)]
    punctual = [deviations(drive(0, seed, 1.0, sizes(seed))) for seed in range(4)]
    squared, metres = (np.concatenate(numbers) for numbers in zip(*late, strict=True))
    _, metres_punctual = (np.concatenate(numbers) for numbers in zip(*punctual, strict=True))
    assert len(metres) > 0.9 * len(metres_punctual)
    assert 0.1 < squared.mean() < 2.0  # of two degrees of freedom
    assert np.mean(squared < 6.18) > 0.954
    assert np.median(metres) < 1.5 * np.median(metres_punctual)


def test_late_edges_end_in_the_current_frame_and_chain() -> None:
    log = drive(2, 0, 0.0, (CAR.height_m,) * 3)
    last: dict[int, int] = {}
    for m in log:
        assert {edge.vehicle for edge in m.vv} <= {edge.vehicle for edge in m.cv}
        for vv in m.vv:
            assert (vv.from_frame, vv.to_frame) == (last[vv.vehicle], m.frame_id)
        last |= {edge.vehicle: m.frame_id for edge in m.cv}
        boxes_px = np.array([edge.box_px for edge in m.cv]).reshape(-1, 4)
        if m.frame_id > 12:
            goal_px, stale_px = detections(m.frame_id).boxes_px, detections(m.frame_id - 2).boxes_px
            assert iou(goal_px, boxes_px).max(axis=1).mean() > iou(goal_px, stale_px).max(axis=1).mean()
    assert len(last) == 3
    assert [edge.T_from_to.x_m for edge in log[-1].vv] == pytest.approx([0.0, 1.1, 1.0], abs=0.05)


@pytest.mark.parametrize("delay", [0, 2])
def test_estimate_reports_the_age_of_its_measurements(delay: int) -> None:
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    estimates = [graph.optimise(m) for m in drive(delay, 0, 0.0, (CAR.height_m,) * 3)]
    assert len(estimates[-1].vehicles) == 3
    for estimate in estimates:
        assert {v.age_ns + v.delay_ns for v in estimate.vehicles} <= {delay * PERIOD_NS}


def test_late_vehicle_without_velocity_is_not_reported() -> None:
    shown = [len(m.cv) for m in drive(1, 0, 0.5, (CAR.height_m,) * 3, late_sigma_m=0.45)]
    assert shown[4] < 3
    assert shown[-1] == 3


def test_larger_edge_sigma_gives_larger_covariance() -> None:
    """`Detections.edge_sigma` takes the place of the configuration's own."""
    config = LocalisationConfig()
    own, poor = EdgeSigma((config.sigma_box_rel,) * 4, config.sigma_box_px), EdgeSigma((0.2,) * 4, 10.0)
    low = EdgeSigma((*own.rel[:3], 0.2), own.px)  # the lower edge alone is poor
    covs = {}
    for said in (None, own, poor, low):
        front = out_of_sequence()
        for k in range(4):
            front.open_frame(open_frame(k))
            tracks = front.ingest_detections(replace(detections(k), edge_sigma=said), k)
        covs[said] = tracks[0].place.cov
    np.testing.assert_array_equal(covs[None], covs[own])
    assert np.linalg.eigvalsh(covs[poor] - covs[None]).min() > 0.0
    assert covs[None][0, 0] < covs[low][0, 0] < covs[poor][0, 0]
