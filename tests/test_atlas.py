"""The atlas: a whole drive in bounded memory, with full resolution of the recent past."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.lanes.amodal.atlas import Atlas, AtlasConfig
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.queries import MapSnapshot, Trajectory
from birdslam.types import Estimate, MapUpdate, VehicleEstimate
from tests.records import new_vehicle

SMALL = AtlasConfig(key_poses=32, octaves=4, vehicles=3, vehicle_poses=8, map_cells=50, map_octaves=3)


def at(frame: int, pose: SE2, *vehicles: VehicleEstimate, epoch: int = 0, valid: bool = True) -> Estimate:
    t_ns = frame * 100_000_000
    stamps = {"frame_id": frame, "t_source_ns": t_ns, "t_capture_ns": t_ns, "t_utc_ns": t_ns}
    return Estimate(**stamps, epoch=epoch, T_world_ego=pose, cov=(0.0,) * 9, valid=valid, vehicles=vehicles)


def car(vehicle: int, pose: SE2, age_ns: int = 0) -> VehicleEstimate:
    return new_vehicle(vehicle=vehicle, T_world_vehicle=pose, age_ns=age_ns)


def test_the_atlas_returns_the_estimates() -> None:
    graph, atlas, estimates = PoseGraph(GraphConfig(), WeightsConfig()), Atlas(AtlasConfig()), {}
    for m in drive(DriveConfig(frames=300, vehicles=4), seed=3).measurements:
        estimate = estimates[m.frame_id] = graph.optimise(m)
        atlas.add(estimate, graph.map_update())
    way = atlas.trajectory()
    assert way.ego[0].frame_id == 1  # the first frame has no motion and is invalid
    assert way.ego[-1].frame_id == way.frame_id == 299
    for pose in way.ego:
        assert pose.T_world_body == estimates[pose.frame_id].T_world_ego
    seen = {v.vehicle for e in estimates.values() for v in e.vehicles if v.age_ns == 0}
    assert {path.vehicle for path in way.vehicles} == seen
    for path in way.vehicles:
        for pose in path.poses:
            same = [v for v in estimates[pose.frame_id].vehicles if v.vehicle == path.vehicle]
            assert pose.T_world_body == same[0].T_world_vehicle
    everything = atlas.map()
    assert len(everything.landmarks_m) > 20
    assert len(everything.lanes_m) > 100
    for record in (way, everything):
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(record), type=type(record)) == record


def test_nothing_is_known_before_the_first_frame() -> None:
    atlas = Atlas(AtlasConfig())
    assert atlas.trajectory() is None
    assert atlas.map() is None


def test_key_poses_are_spaced_and_include_the_newest() -> None:
    atlas = Atlas(AtlasConfig(key_pose_m=0.5, key_pose_rad=0.1))
    for frame in range(101):
        atlas.add(at(frame, SE2(0.1 * frame)))
    way = atlas.trajectory()
    steps = [b.T_world_body.x_m - a.T_world_body.x_m for a, b in pairwise(way.ego[:-1])]
    assert min(steps) >= 0.5 - 1e-9
    assert max(steps) < 0.6 + 1e-9
    assert way.ego[-1].frame_id == 100
    turned = Atlas(AtlasConfig(key_pose_rad=0.1))
    for frame in range(11):
        turned.add(at(frame, SE2(yaw_rad=0.05 * frame)))
    way = turned.trajectory()
    assert [pose.frame_id for pose in way.ego] == [0, 2, 4, 6, 8, 10]


def test_a_stationary_car_has_one_pose() -> None:
    atlas = Atlas(SMALL)
    for frame in range(500):
        atlas.add(at(frame, SE2(1.0, 2.0, 0.3)))
    way = atlas.trajectory()
    assert [pose.frame_id for pose in way.ego] == [0, 499]


def test_memory_is_bounded_by_a_coarse_past() -> None:
    atlas = Atlas(SMALL)
    for frame in range(4000):
        atlas.add(at(frame, SE2(0.5 * frame)), MapUpdate(epoch=0, frame_id=frame, lanes_m=((0.5 * frame, 1.75),)))
    way, lanes = atlas.trajectory(), atlas.map()
    assert len(way.ego) <= SMALL.key_poses * SMALL.octaves + 1
    frames = [pose.frame_id for pose in way.ego]
    assert frames == sorted(set(frames))
    gaps_m = [0.5 * (b - a) for a, b in pairwise(frames)]
    assert gaps_m == sorted(gaps_m, reverse=True)
    assert gaps_m[0] == 0.5 * 2 ** (SMALL.octaves - 1)
    # Octaves of n poses reach back n * (1 + 2 + 4 + 8) steps
    assert frames[-1] - frames[0] == pytest.approx(SMALL.key_poses * (2**SMALL.octaves - 1), rel=0.05)
    assert len(lanes.lanes_m) <= SMALL.map_cells * SMALL.map_octaves
    assert max(x for x, _ in lanes.lanes_m) == 0.5 * 3999


def test_only_the_last_seconds() -> None:
    atlas = Atlas(AtlasConfig())
    for frame in range(100):
        atlas.add(at(frame, SE2(float(frame)), car(5, SE2(float(frame), 4.0)), *([car(1, SE2())] * (frame < 50))))
    way = atlas.trajectory(last_s=2.0)
    assert [pose.frame_id for pose in way.ego] == list(range(79, 100))
    assert [(path.vehicle, path.poses[0].frame_id) for path in way.vehicles] == [(5, 79)]


def test_vehicles_and_paths_are_bounded_to_the_most_recent() -> None:
    atlas = Atlas(SMALL)
    for frame in range(60):
        seen = [car(k, SE2(float(frame), float(k))) for k in range(6) if k >= 3 or frame < 30]
        atlas.add(at(frame, SE2(), *seen, car(9, SE2(), age_ns=1)))
    way = atlas.trajectory()
    assert [path.vehicle for path in way.vehicles] == [3, 4, 5]
    assert all(len(path.poses) == SMALL.vehicle_poses for path in way.vehicles)
    assert all(path.poses[-1].frame_id == 59 for path in way.vehicles)


def test_epochs_are_separate_and_the_oldest_are_dropped() -> None:
    atlas = Atlas(replace(SMALL, epochs=2))
    for epoch in range(4):
        gained = MapUpdate(epoch=epoch, frame_id=epoch, landmarks_m=((float(epoch), 0.0),))
        atlas.add(at(epoch, SE2(float(epoch)), epoch=epoch), gained)
    assert atlas.epochs == (2, 3)
    assert atlas.trajectory(epoch=1) is None
    for epoch in (2, 3):
        way, points = atlas.trajectory(epoch=epoch), atlas.map(epoch)
        assert [pose.T_world_body for pose in way.ego] == [SE2(float(epoch))]
        assert points.landmarks_m == ((float(epoch), 0.0),)
    assert atlas.trajectory() == atlas.trajectory(epoch=3)


def test_previous_epoch_is_kept_for_its_last_map_updates() -> None:
    atlas = Atlas(AtlasConfig())
    for epoch in range(3):
        atlas.add(at(epoch, SE2(), epoch=epoch))
    late = MapUpdate(epoch=1, frame_id=1, landmarks_m=((1.0, 0.0),))
    atlas.add(at(3, SE2(), epoch=2), late)
    assert atlas.epochs == (1, 2)  # each has as much memory as the newest: the supervisor takes it at its start


def test_an_invalid_estimate_leaves_no_pose() -> None:
    atlas = Atlas(SMALL)
    atlas.add(at(0, SE2()))
    atlas.add(at(1, SE2(50.0), valid=False))
    way = atlas.trajectory()
    assert [pose.frame_id for pose in way.ego] == [0]


@settings(max_examples=20)
@given(st.lists(st.tuples(st.floats(-1e308, 1e308), st.floats(-50.0, 50.0)), max_size=200))
def test_every_point_of_a_road_has_its_cell(points: list[tuple[float, float]]) -> None:
    config = AtlasConfig(map_cells=1000)
    atlas = Atlas(config)
    atlas.add(at(0, SE2()), MapUpdate(epoch=0, frame_id=0, landmarks_m=tuple(points)))
    kept = atlas.map()
    cell = lambda p: tuple(math.floor(v / config.map_cell_m) for v in p)  # noqa: E731
    expected = {cell(p) for p in points if abs(p[0]) + abs(p[1]) <= 1e7}
    assert len(kept.landmarks_m) == len(expected)
    for point in kept.landmarks_m:
        inside = np.array([p for p in points if abs(p[0] - point[0]) < config.map_cell_m])
        assert np.abs(inside - point).max(axis=1).min() <= config.map_cell_m


def test_full_records_stay_under_a_mebibyte() -> None:
    config = AtlasConfig()
    atlas = Atlas(replace(config, key_pose_m=1e-9))  # every pose is a key pose
    rng = np.random.default_rng(0)
    far = rng.uniform(-3e5, 3e5, (12 * config.map_cells, 2))
    atlas.add(at(0, SE2()), MapUpdate(epoch=0, frame_id=0, landmarks_m=far.tolist(), lanes_m=far.tolist()))
    t0 = 10**18
    for frame in range(2**15):
        cars = [car(k, SE2(frame + 0.1, k + 0.1, 0.1)) for k in range(config.vehicles)] if frame % 500 == 0 else ()
        estimate = at(frame, SE2(frame + 0.1, 0.1, 0.1), *cars)
        atlas.add(replace(estimate, frame_id=10**8 + frame, t_source_ns=t0 + estimate.t_source_ns))
    way, points = atlas.trajectory(), atlas.map()
    assert isinstance(way, Trajectory)
    assert isinstance(points, MapSnapshot)
    assert len(points.lanes_m) > 2 * config.map_cells
    assert max(len(msgspec.msgpack.encode(record)) for record in (way, points)) < 2**20


def test_lane_points_keep_the_newest_id_of_their_cell() -> None:
    atlas = Atlas(SMALL)
    side_m = SMALL.map_cell_m
    first = MapUpdate(
        epoch=0,
        frame_id=0,
        lanes_m=((0.1 * side_m, 0.0), (5.5 * side_m, 0.0), (9.5 * side_m, 0.0)),
        lane_ids=(3, 4, -1),
    )
    again = MapUpdate(epoch=0, frame_id=1, lanes_m=((0.2 * side_m, 0.0), (5.6 * side_m, 0.0)), lane_ids=(7, -1))
    atlas.add(at(0, SE2()), first)
    atlas.add(at(1, SE2()), again)
    chart = atlas.map()
    assert {round(x / side_m - 0.5): lane for (x, _), lane in zip(chart.lanes_m, chart.lane_ids, strict=True)} == {
        0: 7,  # seen again under another id
        5: 4,  # seen again, of no lane that is known: it stays
        9: -1,
    }


def test_map_without_lane_ids_has_none() -> None:
    atlas = Atlas(SMALL)
    atlas.add(at(0, SE2()), MapUpdate(epoch=0, frame_id=0, lanes_m=((0.0, 0.0),)))
    chart = atlas.map()
    assert len(chart.lanes_m) == 1
    assert chart.lane_ids == ()
