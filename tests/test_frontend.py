"""The front end: chained motions, edges that name their frames, and statuses without measurements."""

import dataclasses
import functools
import math
from typing import Any

import msgspec
import numpy as np
import pytest

from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane, VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.lanes.amodal.lane_mapper import LaneMapper
from birdslam.odometry.dead_reckoning import DeadReckoning
from birdslam.odometry.odometry import Motion
from birdslam.perception import Detections, Perception, Ready, Segmentation
from birdslam.types import NS_PER_S, Frame, Measurements, Status

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65, pitch_rad=0.01)
IMAGE = np.zeros((375, 1242), np.uint8)


def rotation(pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """(3, 3) ego axes: Rz(yaw) Ry(pitch)."""
    cp, sp, cy, sy = math.cos(pitch_rad), math.sin(pitch_rad), math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])


def motion(frame: int, T: SE2, *, d_pitch_rad: float = 0.0, since: int = 1, **changes: Any) -> Motion:
    """The motion of a camera over a road whose grade changes by `d_pitch_rad` under it."""
    A = CAMERA.ground.R_ego_cam
    T_ego_cam, T_ego = np.eye(4), np.eye(4)
    T_ego_cam[:3, :3], T_ego_cam[2, 3] = A, CAMERA.height_m
    T_ego[:3, :3], T_ego[:2, 3] = rotation(d_pitch_rad, T.yaw_rad), (T.x_m, T.y_m)
    T_cam = np.linalg.inv(T_ego_cam) @ T_ego @ T_ego_cam
    fields: dict[str, Any] = {
        "from_frame": frame - since,
        "to_frame": frame,
        "R_prev_curr": T_cam[:3, :3],
        "t_prev_curr_m": T_cam[:3, 3],
        "T_prev_curr": T,
        "cov": np.diag([1e-4, 1e-4, 1e-6]),
        "scale_sigma_rel": 0.01,
        "ground": CAMERA.ground,
        "tilt_cov": np.eye(2) * 0.003**2,
        "standstill": False,
        "status": (),
    }
    return Motion(**{**fields, **changes})


class ScriptedOdometry:
    """Gives the motions of a script; the corners on the road are given too."""

    def __init__(self, script: dict[int, Motion]) -> None:
        self.script = script
        self.road_tracks = (np.array([7, 9, 11]), np.array([[600.0, 300.0], [700.0, 220.0], [600.0, 100.0]]))
        self.bonnet_px = None
        self.boxes: list[np.ndarray] = []

    def track(self, image: np.ndarray) -> None:
        assert image is IMAGE

    def estimate(
        self, tracks: None, frame_id: int, t_ns: int, boxes: np.ndarray, road: Any, speeds: Any
    ) -> Motion | None:
        self.boxes.append(boxes)
        return self.script.get(frame_id)


def frame(k: int, image: np.ndarray | None = IMAGE, status: tuple[Status, ...] = ()) -> Frame:
    return Frame(k, k * 100_000_000, 5_000 + k, 9_000 + k, image, status)


def seeing(*boxes: list[float], age: int = 0, lane: np.ndarray | None = None) -> Ready:
    detections = Detections(np.array(boxes).reshape(-1, 4), np.full(len(boxes), 0.9), ("car",) * len(boxes))
    segmentation = None if lane is None else Segmentation(road=lane, lane=lane)
    return Ready(Perception(detections, segmentation, {"detector": age, "segmenter": 0}, ()))


def run(script: dict[int, Motion], views: list[Ready], images: dict[int, None] | None = None) -> list[Measurements]:
    front = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry(script))
    return [front.measure(frame(k, (images or {}).get(k, IMAGE)), view) for k, view in enumerate(views)]


def test_only_a_change_of_grade_is_climbed() -> None:
    reckoning = DeadReckoning(CAMERA, memory_m=1e9)
    for k in range(1, 11):
        reckoning.advance(motion(k, SE2(1.0, 0.0, 0.0)))
    assert reckoning.attitude.z_m == pytest.approx(0.0, abs=1e-9)
    reckoning.advance(motion(11, SE2(0.0, 0.0, 0.0), d_pitch_rad=-0.05))  # nose up
    for k in range(12, 22):
        reckoning.advance(motion(k, SE2(1.0, 0.0, 0.0)))
    assert reckoning.attitude.z_m == pytest.approx(10.0 * math.sin(0.05), rel=1e-6)
    assert reckoning.attitude.pitch_rad == pytest.approx(-0.05)


def test_tilt_turns_with_the_road_when_the_ego_turns() -> None:
    """A turn by 90 degrees on an inclined plane makes pitch to roll."""
    reckoning = DeadReckoning(CAMERA, memory_m=1e9)
    reckoning.advance(motion(1, SE2(0.0, 0.0, 0.0), d_pitch_rad=0.04))
    reckoning.advance(motion(2, SE2(0.0, 0.0, math.pi / 2)))
    assert reckoning.attitude.pitch_rad == pytest.approx(0.0, abs=1e-6)
    assert abs(reckoning.attitude.roll_rad) == pytest.approx(0.04, abs=1e-4)


def test_a_measured_motion_supersedes_the_coasted_ones() -> None:
    reckoning = DeadReckoning(CAMERA, memory_m=1e9)
    reckoning.advance(motion(1, SE2(1.0, 0.0, 0.0)))
    reckoning.advance(motion(2, SE2(0.9, 0.0, 0.0)))
    reckoning.advance(motion(3, SE2(1.9, 0.0, 0.0), since=2))  # from frame 1 again
    assert reckoning.T_world_ego.x_m == pytest.approx(2.9)
    reckoning.advance(motion(4, SE2(1.0, 0.0, 0.0)))
    assert reckoning.T_world_ego.x_m == pytest.approx(3.9)


def test_edges_chain_over_blind_frames() -> None:
    script = {1: motion(1, SE2(1.0, 0.0, 0.0))}
    script |= {k: motion(k, SE2(1.1 * (k - 1), 0.0, 0.0), since=k - 1) for k in range(2, 9)}  # coasted, all from 1
    script |= {9: motion(9, SE2(8.0, 0.0, 0.0), since=8), 10: motion(10, SE2(1.0, 0.0, 0.0))}
    edges = [m.cc for m in run(script, [seeing()] * 11)[1:]]
    assert [(e.from_frame, e.to_frame) for e in edges if e] == [(k, k + 1) for k in range(10)]
    assert sum(e.T_from_to.x_m for e in edges if e) == pytest.approx(10.0)


def test_edges_name_their_frames_over_a_gap() -> None:
    front = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry({4: motion(4, SE2(3.0, 0.0, 0.0), since=4)}))
    front.measure(frame(0), seeing())
    after = front.measure(frame(4), seeing())
    assert (after.cc.from_frame, after.cc.to_frame) == (0, 4)
    assert Status.FRAMES_DROPPED in after.status


def test_an_unreadable_frame_has_a_status_and_no_edge() -> None:
    out = run({2: motion(2, SE2(2.0, 0.0, 0.0), since=2)}, [seeing()] * 3, images={1: None})
    assert out[1].cc is None
    assert out[1].cv == out[1].cp == ()
    assert out[2].cc is not None
    assert Status.FRAMES_DROPPED not in out[2].status
    assert [m.frame_id for m in out] == [0, 1, 2]
    assert out[1].t_capture_ns == 5_001


def test_only_confirmed_vehicles_with_boxes_in_this_frame_have_edges() -> None:
    box = [550.0, 180.0, 650.0, 260.0]
    script = {k: motion(k, SE2(0.0, 0.0, 0.0)) for k in range(1, 6)}
    out = run(script, [seeing(box), seeing(box), seeing(box), seeing(box, age=1), seeing(box), seeing(box)])
    assert [len(m.cv) for m in out] == [0, 1, 1, 0, 1, 1]
    (edge,) = out[2].cv
    below_horizon_rad = math.atan2(260.0 - CAMERA.cy_px, CAMERA.fy_px) + CAMERA.pitch_rad
    assert edge.T_ego_vehicle.x_m == pytest.approx(1.65 / math.tan(below_horizon_rad) + 2.0, rel=0.08)
    assert edge.box_px == tuple(box)
    (vv,) = out[4].vv
    assert (vv.from_frame, vv.to_frame) == (2, 4)


def test_landmarks_are_near_features_on_the_road() -> None:
    out = run({1: motion(1, SE2(1.0, 0.0, 0.0))}, [seeing(), seeing()])
    (landmark,) = out[1].cp  # one feature is beyond the depth threshold, one above the horizon
    assert landmark.landmark == 7
    assert 8.0 < landmark.x_m < 10.0


def test_lane_points_exclude_vehicles() -> None:
    lane = np.zeros((375, 1242), bool)
    lane[230:350, 400:404] = lane[230:350, 800:804] = True
    (covered,) = run({}, [seeing([780.0, 200.0, 900.0, 370.0], lane=lane)])
    assert covered.lanes
    assert all(point.y_m > 0 for point in covered.lanes)
    assert len(covered.lanes) <= 64


def test_late_segmentation_is_mapped_once_at_its_own_pose() -> None:
    lane = np.zeros((375, 1242), bool)
    lane[230:350, 400:404] = True
    script = {k: motion(k, SE2(2.0, 0.0, 0.0)) for k in range(1, 4)}
    now = run({}, [seeing(lane=lane)])[0].lanes
    detections = Detections(np.zeros((0, 4)), np.zeros(0), ())
    late = Ready(Perception(detections, Segmentation(lane, lane), {"detector": 0, "segmenter": 2}, ()))
    later = Ready(Perception(detections, Segmentation(lane, lane), {"detector": 0, "segmenter": 3}, ()))
    out = run(script, [seeing(), seeing(), late, later])
    assert not out[0].lanes
    assert not out[3].lanes
    assert [p.y_m for p in out[2].lanes] == pytest.approx([p.y_m for p in now])
    assert [p.x_m for p in out[2].lanes] == pytest.approx([p.x_m - 4.0 for p in now])


@functools.cache
def road_view() -> Ready:
    """A straight road with a line on either side, without vehicles."""
    rows, columns = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    px = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    y_m = bev.pixel_to_ego(CAMERA, CAMERA.ground, px)[:, 1].reshape(rows.shape)
    with np.errstate(invalid="ignore"):
        masks = Segmentation(road=np.abs(y_m) < 6.0, lane=(np.abs(y_m - 3.0) < 0.15) | (np.abs(y_m + 2.0) < 0.15))
    nobody = Detections(np.zeros((0, 4)), np.zeros(0), ())
    return Ready(Perception(nobody, masks, {"detector": 0, "segmenter": 0}, ()))


def test_earlier_observations_are_dropped_after_motion_of_unknown_length() -> None:
    def seen(frames: int, *invalid: int) -> np.ndarray:
        steps = {k: motion(k, SE2(1.0, 0.0, 0.0)) for k in range(1, frames)}
        steps |= {k: msgspec.structs.replace(steps[k], status=(Status.SCALE_INVALID,)) for k in invalid}
        front = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry(steps))
        for k in range(frames):
            front.measure(frame(k), road_view())
        return front.lane_view().seen

    five = seen(5)
    assert np.array_equal(seen(4, 3), seen(1))  # restarts
    assert np.array_equal(seen(8, 3), five)
    assert seen(8).sum() > 1.2 * five.sum()


def test_lanes_keep_ids_until_a_new_epoch() -> None:
    views = [road_view() for _ in range(16)]
    script = {k: motion(k, SE2(1.0, 0.0, 0.0)) for k in range(1, 16) if k != 10}
    out = run(script, views)
    sides = [{p.lane: round(p.y_m) for p in m.lanes if p.lane >= 0} for m in out]
    assert sides[5] == {min(sides[5]): -2, max(sides[5]): 3}
    assert all(side == sides[5] for side in sides[5:10])
    assert all(-0.5 < p.y_m - sides[5][p.lane] < 0.5 for m in out[5:10] for p in m.lanes if p.lane >= 0)
    assert max(p.x_m for p in out[9].lanes if p.lane >= 0) > 10.0
    assert not set(sides[5]) & set(sides[10])  # lost: the identity is unknown
    assert sorted(sides[15].values()) == [-2, 3]


def test_first_frame_is_not_initialised() -> None:
    (first,) = run({}, [seeing()])
    assert first.cc is None
    assert Status.NOT_INITIALISED in first.status
    assert GroundPlane(first.ground.height_m, first.ground.pitch_rad, first.ground.roll_rad) == CAMERA.ground


def test_vehicles_and_lanes_have_one_vertical_curvature(monkeypatch: pytest.MonkeyPatch) -> None:
    crest = VerticalCurvature(-0.002, 1e-4)
    monkeypatch.setattr(LaneMapper, "vertical", property(lambda _: crest))
    frontend = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry({}))
    frontend.measure(Frame(0, 0, 0, 0, IMAGE), Ready(Perception(None, None, {}, ())))
    assert frontend.vehicles.road.vertical_per_m == pytest.approx(crest.per_m, rel=0.1)


@pytest.mark.parametrize("gap_s", [300.0, 86_400.0, 1.6e9, -5.0, -1.6e9])
def test_no_filter_predicts_across_a_gap_in_time(gap_s: float) -> None:
    """A bag that pauses, or whose clock is set: the drive goes on, and a new road user gets a new id."""
    box = [550.0, 180.0, 650.0, 260.0]
    script = {k: motion(k, SE2(0.5, 0.0, 0.0)) for k in (*range(1, 8), *range(9, 16))}
    front = FrontEnd(CAMERA, FrontEndConfig(), ScriptedOdometry(script))
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    out, estimates = [], []
    for k in range(16):
        moved_ns = round(gap_s * NS_PER_S) if k >= 8 else 0
        out.append(front.measure(dataclasses.replace(frame(k), t_source_ns=k * 10**8 + moved_ns), seeing(box)))
        estimates.append(graph.optimise(out[-1]))
    assert Status.FRAMES_DROPPED in out[8].status
    assert not out[8].cv
    assert out[8].cc is None
    assert [len(m.cv) for m in out[10:]] == [1] * 6
    assert {edge.vehicle for m in out[:8] for edge in m.cv}.isdisjoint(edge.vehicle for m in out[8:] for edge in m.cv)
    assert estimates[-1].epoch == estimates[7].epoch + 1
    for vehicle in (v for e in estimates for v in e.vehicles):
        assert np.isfinite([*vehicle.cov, *vehicle.velocity_cov, *vehicle.velocity_mps]).all()
