"""Conversion between ego and camera poses; trajectory files and g2o."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.graph.g2o import g2o_lines
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import WeightsConfig
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.trajectory import (
    CameraTrajectory,
    Transform,
    as_poses,
    ego_pose,
    inverse,
    kitti_row,
    mount_pose,
    read_kitti,
    read_tum,
    split_pose,
    tum_row,
)
from birdslam.types import Attitude, Measurements
from tests.batch_se2 import ego_key, solve

metres = st.floats(-1e4, 1e4)
angles = st.floats(-3.1, 3.1)
tilts = st.floats(-0.4, 0.4)
planar = st.builds(SE2, metres, metres, angles)
attitudes = st.builds(Attitude, z_m=metres, pitch_rad=tilts, roll_rad=tilts)
mounts = st.builds(GroundPlane, st.floats(0.5, 3.0), tilts, tilts)


def random_poses(count: int, seed: int, step_m: float = 1.0) -> Transform:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(1, count):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.03, 3)).as_matrix()
        step[:3, 3] = rng.normal([0.0, 0.0, step_m], 0.05)
        poses[i] = poses[i - 1] @ step
    return poses


@given(planar, attitudes)
def test_ego_pose_and_split_pose_are_inverse(T_world_ego: SE2, attitude: Attitude) -> None:
    again, tilt = split_pose(ego_pose(T_world_ego, attitude))
    assert again.between(T_world_ego).log() == pytest.approx(np.zeros(3), abs=1e-9)
    assert (tilt.z_m, tilt.pitch_rad, tilt.roll_rad) == pytest.approx(
        (attitude.z_m, attitude.pitch_rad, attitude.roll_rad), abs=1e-9
    )


def test_positive_pitch_is_nose_down_and_positive_roll_right_side_down() -> None:
    nose = ego_pose(SE2(), Attitude(pitch_rad=0.1)) @ [1.0, 0.0, 0.0, 1.0]
    right = ego_pose(SE2(), Attitude(roll_rad=0.1)) @ [0.0, -1.0, 0.0, 1.0]
    assert nose[2] < -0.09
    assert right[2] < -0.09


@given(planar, attitudes, mounts)
def test_inverse_of_a_pose(T_world_ego: SE2, attitude: Attitude, mount: GroundPlane) -> None:
    T = ego_pose(T_world_ego, attitude) @ mount_pose(mount)
    assert inverse(T) @ T == pytest.approx(np.eye(4), abs=1e-8)


@given(mounts, st.integers(0, 1000))
def test_camera_motion_does_not_depend_on_the_mount(mount: GroundPlane, seed: int) -> None:
    moved = random_poses(20, seed)
    T_ego_cam = mount_pose(mount)
    trajectory = CameraTrajectory(mount)
    for T_first_i in moved:
        T_world_ego = ego_pose(*split_pose(T_ego_cam @ T_first_i @ inverse(T_ego_cam)))
        assert trajectory.add(0, T_world_ego) == pytest.approx(T_first_i, abs=1e-9)


def test_forward_motion_of_a_pitched_camera_climbs_in_its_axes() -> None:
    """KITTI 00 gains 3.2 m over 92 m in camera axes for this reason."""
    trajectory = CameraTrajectory(GroundPlane(1.65, pitch_rad=math.radians(2.0)))
    trajectory.add(0, ego_pose(SE2(), Attitude()))
    x_m, y_m, z_m = trajectory.add(0, ego_pose(SE2(92.0, 0.0, 0.0), Attitude()))[:3, 3]
    assert (x_m, y_m, z_m) == pytest.approx(
        (0.0, -92.0 * math.sin(math.radians(2.0)), 92.0 * math.cos(math.radians(2.0)))
    )


def test_new_epoch_continues_at_last_pose() -> None:
    trajectory = CameraTrajectory(GroundPlane(1.65, 0.02, 0.01))
    trajectory.add(0, ego_pose(SE2(), Attitude()))
    last = trajectory.add(0, ego_pose(SE2(10.0, 1.0, 0.3), Attitude()))
    first = trajectory.add(1, ego_pose(SE2(), Attitude()))
    assert np.array_equal(first, last)
    step = inverse(last) @ trajectory.add(1, ego_pose(SE2(1.0, 0.0, 0.1), Attitude()))
    alone = CameraTrajectory(GroundPlane(1.65, 0.02, 0.01))
    alone.add(0, ego_pose(SE2(), Attitude()))
    assert step == pytest.approx(alone.add(0, ego_pose(SE2(1.0, 0.0, 0.1), Attitude())), abs=1e-12)


def test_files_round_trip(tmp_path: Path) -> None:
    poses = random_poses(30, 4)
    kitti, tum = tmp_path / "a.txt", tmp_path / "b.txt"
    kitti.write_text("".join(kitti_row(T) + "\n" for T in poses))
    times_ns = [1_317_042_735_000_000_001 + i * 100_000_000 for i in range(30)]
    tum.write_text("# a comment\n" + "".join(tum_row(t, T) + "\n" for t, T in zip(times_ns, poses, strict=True)))
    assert as_poses(read_kitti(kitti)) == pytest.approx(poses, abs=1e-8)
    t_s, again = read_tum(tum)
    assert again == pytest.approx(poses, abs=1e-8)
    assert t_s == pytest.approx(np.array(times_ns) * 1e-9)
    assert tum.read_text().splitlines()[1].startswith("1317042735.000000001 ")  # exact: no float passes through


def test_a_time_before_zero_keeps_its_sign() -> None:
    assert tum_row(-1_500_000_000, np.eye(4)).startswith("-1.500000000 ")


def test_the_identity_has_no_negative_zeros() -> None:
    assert "-" not in kitti_row(-0.0 * np.ones((4, 4))).replace("e-", "")
    assert kitti_row(np.eye(4)).split()[0] == "1.000000000e+00"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("1 2 3\n", "line 1"),
        (kitti_row(np.eye(4)) + "\n" + kitti_row(np.eye(4)).replace("1.0", "nan", 1) + "\n", "line 2"),
        ("a " * 12, "line 1"),
        (kitti_row(2.0 * np.eye(4)), "pose 0 has no valid rotation"),
        (kitti_row(np.diag([1.0, 1.0, -1.0, 1.0])), "pose 0 has no valid rotation"),
    ],
)
def test_a_torn_pose_file_is_named(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "00.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=what) as caught:
        read_kitti(path)
    assert str(path) in str(caught.value)


def test_missing_and_binary_pose_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.txt: can't be read"):
        read_kitti(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match=r"b\.txt: is not a text file"):
        read_tum(tmp_path / "b.txt")
    (tmp_path / "c.txt").write_text("0 0 0 0 0 0 0 0\n")
    with pytest.raises(ValueError, match="unit quaternion"):
        read_tum(tmp_path / "c.txt")


CONFIG = DriveConfig(frames=30, rate_hz=10.0, vehicles=2, landmarks=6, traffic="convoy")
LOG = drive(CONFIG, 3).measurements
ALL_EDGES = WeightsConfig(leave_out=())


def lines(log: list[Measurements], weights: WeightsConfig = ALL_EDGES) -> list[list[str]]:
    return [line.split() for line in g2o_lines(log, weights)]


def test_gtsam_reads_the_file_and_finds_the_batch_poses(tmp_path: Path) -> None:
    log = [replace(m, cp=()) for m in LOG]
    path = tmp_path / "drive.g2o"
    path.write_text("\n".join(g2o_lines(log, ALL_EDGES)) + "\n")
    graph, values = gtsam.readG2o(str(path), False)
    assert graph.size() == sum((m.cc is not None) + len(m.cv) + len(m.vv) for m in log)
    egos = [int(line[1]) for line in lines(log) if line[0] == "FIX"]
    assert egos == [0]
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    batch = solve(log, GraphConfig(constant_velocity=False), ALL_EDGES)
    marginals = [gtsam.Marginals(*both) for both in ((graph, found), (batch.factors, batch.values))]
    first_of_frame = {}
    vertex = [line for line in lines(log) if line[0] == "VERTEX_SE2"]
    at = 0
    for m in log:
        first_of_frame[m.frame_id] = int(vertex[at][1])
        at += 1 + len(m.cv)
    for frame in (10, 29):
        key, ours = first_of_frame[frame], batch.ego(frame)
        pose = found.atPose2(key)
        assert [pose.x(), pose.y(), pose.theta()] == pytest.approx([ours.x_m, ours.y_m, ours.yaw_rad], abs=1e-4)
        covs = marginals[0].marginalCovariance(key), marginals[1].marginalCovariance(ego_key(frame))
        np.testing.assert_allclose(*covs, rtol=1e-3, atol=1e-9)


def test_each_observation_of_a_landmark_is_an_edge() -> None:
    found = lines(LOG, replace(ALL_EDGES, depth_threshold_m=None))
    sights = [line for line in found if line[0] == "EDGE_SE2_XY"]
    assert len(sights) == sum(len(m.cp) for m in LOG)
    assert len([line for line in found if line[0] == "VERTEX_XY"]) == len({e.landmark for m in LOG for e in m.cp})
    assert [float(n) for n in sights[0][5:]] == pytest.approx([400.0, 0.0, 400.0])  # 1 / (5 cm)^2


def test_invalid_edges_are_left_out() -> None:
    log = list(LOG)
    log[9] = replace(
        log[9], cv=(replace(log[9].cv[0], cov=(1.0, 9.0, 0.0, 9.0, 1.0, 0.0, 0.0, 0.0, 1.0)), *log[9].cv[1:])
    )
    assert len([line for line in lines(log) if line[0] == "VERTEX_SE2"]) == 3 * CONFIG.frames - 1
    log[20] = replace(log[20], cc=None, cv=(), vv=(), cp=())
    found = lines(log)
    assert all(np.isfinite([float(n) for n in line[1:]]).all() for line in found)
    assert [line[0] for line in found].count("FIX") == 2  # the first pose, and that after the gap
