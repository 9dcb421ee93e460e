"""Laws of the metrics, and the evaluation of made-up pipelines on recordings built small."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from birdslam.bench.ego.car_ahead import CarAhead, lidar_distance_m, near_face_m
from birdslam.bench.ego.trajectory_errors import (
    ate_m,
    compare,
    evaluate_recordings,
    evo_errors,
    from_first,
    in_camera0,
    path_length_m,
    scale_error,
    segment_error_pct,
)
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_files import ResultsError
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.evaluation.odometry import evaluate_odometry
from birdslam.sources.kitti import KittiRecording
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import RecordedFrame, Recording
from birdslam.trajectory import Transform, inverse, mount_pose, split_pose
from birdslam.types import Attitude, Estimate, Ground, MapUpdate, Measurements, Status, VehicleEdge, VehicleEstimate
from tests.records import new_estimate, new_vehicle

CAMERA = Camera(640, 192, 400.0, 400.0, 320.0, 96.0, 1.65)
COV3, COV2 = (0.0,) * 9, (0.0,) * 4
EVO = ("rpe_t_m", "rpe_r_deg", "ate_se3_m", "ate_sim3_m")


def rigid(rng: np.random.Generator, angle: float = 1.0, shift_m: float = 50.0) -> Transform:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, angle, 3)).as_matrix()
    T[:3, 3] = rng.normal(0.0, shift_m, 3)
    return T


def drive(seed: int, count: int = 40) -> Transform:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(count - 1):
        step = rigid(rng, 0.03, 0.05)
        step[2, 3] += 1.0
        poses.append(poses[-1] @ step)
    return np.array(poses)


def shaken(poses: Transform, seed: int) -> Transform:
    rng = np.random.default_rng(seed)
    return np.array([poses[0], *(T @ rigid(rng, 0.01, 0.1) for T in poses[1:])])


seeds = st.integers(0, 10_000)
few = settings(max_examples=10)


@few
@given(seeds)
def test_the_truth_itself_has_no_error(seed: int) -> None:
    truth = drive(seed)
    assert ate_m(truth, truth) == 0.0
    assert scale_error(truth, truth) == 0.0
    assert evo_errors(truth, truth) == pytest.approx(dict.fromkeys(EVO, 0.0), abs=1e-6)


@few
@given(seeds)
def test_errors_do_not_depend_on_where_either_begins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = drive(seed)
    estimated = shaken(truth, seed)
    moved = rigid(rng) @ estimated
    assert ate_m(truth, moved) == pytest.approx(ate_m(truth, estimated), abs=1e-9)
    assert evo_errors(rigid(rng) @ truth, moved) == pytest.approx(evo_errors(truth, estimated), abs=1e-7)
    assert path_length_m(moved) == pytest.approx(path_length_m(estimated))


@few
@given(seeds, st.floats(0.5, 2.0))
def test_a_scaled_path_has_a_scale_error_and_its_shape_none(seed: int, scale: float) -> None:
    truth = drive(seed)
    estimated = truth.copy()
    estimated[:, :3, 3] *= scale
    assert scale_error(truth, estimated) == pytest.approx(scale - 1.0)
    assert evo_errors(truth, estimated)["ate_sim3_m"] < 1e-9
    assert ate_m(truth, estimated) == pytest.approx(abs(scale - 1.0) * np.sqrt((truth[:, :3, 3] ** 2).sum(1).mean()))


def test_segments_do_not_see_what_the_first_pose_lacks() -> None:
    truth = np.tile(np.eye(4), (80, 1, 1))
    truth[:, 2, 3] = np.arange(80.0)
    longer, turned = truth.copy(), truth.copy()
    longer[:, :3, 3] *= 1.02
    assert segment_error_pct(truth, longer) == pytest.approx(2.0)
    turned[1:] = truth[1:] @ np.linalg.inv(truth[1])
    Ry = Rotation.from_euler("y", 1.0, degrees=True).as_matrix()
    turned[1:, :3, 3] = truth[1, :3, 3] + (truth[1:, :3, 3] - truth[1, :3, 3]) @ Ry.T
    turned[1:, :3, :3] = Ry
    found = segment_error_pct(truth, turned)
    assert found < 0.1  # five of the 250 stretches begin at frame 0
    assert ate_m(truth, turned) > 0.7
    assert segment_error_pct(truth[:8], truth[:8]) is None


def test_only_the_frames_asked_for_are_compared() -> None:
    """A truth whose first pose is off by a degree turns the whole way; from the second frame on nothing is left."""
    truth = drive(3)
    estimated = truth.copy()
    estimated[0, :3, :3] = Rotation.from_euler("y", 1.0, degrees=True).as_matrix()
    whole = compare("s", truth, from_first(estimated), {})
    rest = compare("s", truth, from_first(estimated), {}, slice(1, 30))
    assert whole.ate_m > 0.1
    assert rest.frames == 29
    assert rest.ate_m == pytest.approx(0.0, abs=1e-6)
    assert rest.path_m == pytest.approx(float(np.linalg.norm(np.diff(truth[1:30, :3, 3], axis=0), axis=1).sum()))


def test_an_estimate_that_never_moved() -> None:
    truth = drive(1)
    still = np.tile(np.eye(4), (len(truth), 1, 1))
    report = compare("x", truth, still, {})
    assert report.scale_error == -1.0
    assert (report.ate_se3_m, report.ate_sim3_m) == (None, None)
    assert report.rpe_t_m == pytest.approx(1.0, abs=0.1)
    assert compare("x", still, still, {}).scale_error is None


def test_one_pose_and_none() -> None:
    one = np.eye(4)[None]
    assert compare("x", one, one, {}).ate_m == 0.0
    assert compare("x", None, np.zeros((0, 4, 4)), {}).frames == 0
    with pytest.raises(ValueError, match="sequence x: 1 poses estimated for 40 frames"):
        compare("x", drive(1), one, {})


def test_without_evo_the_rest_is_reported_and_the_command_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = drive(1)
    monkeypatch.setattr("birdslam.bench.ego.trajectory_errors.find_spec", lambda name: None)
    report = compare("x", truth, shaken(truth, 1), {})
    assert report.ate_m is not None
    assert (report.rpe_t_m, report.ate_se3_m) == (None, None)
    with pytest.raises(ConfigurationError, match=r"birdslam\[evaluate\]"):
        evaluate_odometry(Configuration(output=str(tmp_path)), ["demo"], slice(None))


@given(seeds)
def test_the_lever_arm_of_camera_2_is_taken_out(seed: int) -> None:
    truth = drive(seed)
    T_cam0_cam = np.eye(4)
    T_cam0_cam[:3, 3] = -0.06, 0.0, -0.003
    camera2 = from_first(truth @ T_cam0_cam)
    assert in_camera0(camera2, T_cam0_cam) == pytest.approx(truth, abs=1e-9)


class Drive(Recording):
    """A recording without images."""

    def __init__(self, name: str, truth: Transform | None, frames: int) -> None:
        self.name, self.camera, self.rate_hz, self._truth, self._frames = name, CAMERA, 10.0, truth, frames

    def __len__(self) -> int:
        return self._frames

    def frames(self) -> Iterator[RecordedFrame]:
        return (RecordedFrame(index, index * 100_000_000, None) for index in range(self._frames))

    def truth_poses(self) -> np.ndarray | None:
        return None if self._truth is None else self._truth[:, :3]


def estimate(frame_id: int, T_world_ego: SE2, **fields: object) -> Estimate:
    return new_estimate(
        frame_id=frame_id,
        t_source_ns=frame_id * 100_000_000,
        T_world_ego=T_world_ego,
        cov=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        **fields,
    )


def perfect(poses: Transform) -> Iterator[Estimate | MapUpdate]:
    T_ego_cam = mount_pose(CAMERA.ground)
    for index, pose in enumerate(poses):
        T_world_ego, attitude = split_pose(T_ego_cam @ pose @ inverse(T_ego_cam))
        status = (Status.ODOMETRY_COASTING,) if index % 2 else ()
        yield estimate(index, T_world_ego, attitude=attitude, status=status)
        yield MapUpdate(epoch=0, frame_id=index, lanes_m=((T_world_ego.x_m, 1.75),))
    yield estimate(len(poses), SE2(), status=(Status.END_OF_SOURCE,))


def test_evaluate_writes_results_and_report(tmp_path: Path) -> None:
    truth = drive(3)
    scaled = truth.copy()
    scaled[:, :3, 3] *= 1.02
    estimates = {"00": truth, "01": scaled, "02": truth}
    recordings = [
        Drive("00", rigid(np.random.default_rng(1)) @ truth, 40),
        Drive("01", truth, 40),
        Drive("02", None, 40),
    ]
    report = evaluate_recordings(recordings, lambda recording: perfect(estimates[recording.name]), tmp_path, {"a": 1})
    assert report[0].ate_m == pytest.approx(0.0, abs=1e-6)
    assert report[0].rpe_r_deg == pytest.approx(0.0, abs=1e-5)
    assert report[1].scale_error == pytest.approx(0.02, abs=1e-6)
    assert report[1].ate_sim3_m == pytest.approx(0.0, abs=1e-6)
    assert (report[2].ate_m, report[2].path_m, report[2].frames) == (None, None, 40)
    written = json.loads((tmp_path / "report.json").read_text())
    assert [row["sequence"] for row in written] == ["00", "01", "02"]
    assert set(written[0]) >= {
        *("sequence", "frames", "path_m", "ate_m", "ate_sim3_m", "scale_error", "rpe_t_m", "rpe_r_deg"),
        *("ate_pct", "statuses"),
    }
    assert written[0]["statuses"] == {"odometry_coasting": 20}
    assert written[2]["scale_error"] is None
    assert len((tmp_path / "01" / "ego.kitti.txt").read_text().splitlines()) == 40
    assert json.loads((tmp_path / "01" / "summary.json").read_text())["a"] == 1


def test_evaluate_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    truth = drive(5)
    for name in ("a", "b"):
        evaluate_recordings([Drive("00", truth, 40)], lambda _: perfect(shaken(truth, 2)), tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 9
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path


def test_evaluate_refuses_before_it_runs(tmp_path: Path) -> None:
    def never(recording: Recording) -> Iterator[Estimate]:
        raise AssertionError(recording.name)

    with pytest.raises(ValueError, match="two recordings of the name 00"):
        evaluate_recordings([Drive("00", None, 1), Drive("00", None, 1)], never, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="is a file"):
        evaluate_recordings([Drive("00", None, 1)], never, tmp_path / "file")


def test_a_run_that_lost_a_frame_is_an_error(tmp_path: Path) -> None:
    truth = drive(3)
    with pytest.raises(ValueError, match="sequence 00: 39 poses estimated for 40 frames"):
        evaluate_recordings([Drive("00", truth, 40)], lambda _: perfect(truth[:39]), tmp_path)


def box_and_returns(distance_m: float, rng: np.random.Generator) -> tuple[tuple[float, ...], np.ndarray]:
    """The rear of a car 1.7 m wide and 1.4 m high, with the road before it and a wall behind, in camera axes."""
    x, height = rng.uniform(-0.85, 0.85, 300), rng.uniform(0.0, 1.4, 300)
    rear = np.column_stack([x, 1.65 - height, distance_m + rng.uniform(0.0, 0.1, 300)])
    z = rng.uniform(3.0, 30.0, 500)
    road = np.column_stack([rng.uniform(-3.0, 3.0, 500), np.full(500, 1.65), z])
    wall = np.column_stack([rng.uniform(-9.0, 9.0, 500), rng.uniform(-3.0, 1.6, 500), np.full(500, 40.0)])
    u = np.array([-0.85, 0.85]) / distance_m * CAMERA.fx_px + CAMERA.cx_px
    v = (1.65 - np.array([1.4, 0.0])) / distance_m * CAMERA.fy_px + CAMERA.cy_px
    return (u[0], v[0], u[1], v[1]), np.vstack([rear, road, wall])


@given(st.floats(5.0, 30.0), seeds)
def test_lidar_distance_is_that_of_the_near_face(distance_m: float, seed: int) -> None:
    box_px, points = box_and_returns(distance_m, np.random.default_rng(seed))
    found = lidar_distance_m(CAMERA, CAMERA.ground, points, box_px)
    assert found == pytest.approx(distance_m, abs=0.15)


def test_a_box_without_returns_has_no_distance() -> None:
    assert lidar_distance_m(CAMERA, CAMERA.ground, np.zeros((0, 3)), (0.0, 0.0, 100.0, 100.0)) is None
    assert lidar_distance_m(CAMERA, GroundPlane(1.65), np.full((50, 3), -1.0), (0.0, 0.0, 640.0, 192.0)) is None


def vehicle(number: int, pose: SE2) -> VehicleEstimate:
    return new_vehicle(vehicle=number, T_world_vehicle=pose, frames=3, length_m=4.0)


def test_near_face_does_not_depend_on_which_way_the_car_looks() -> None:
    ego = SE2(5.0, -3.0, 0.7)
    for yaw_rad in (0.0, math.pi):
        seen = estimate(0, ego)
        assert near_face_m(seen, vehicle(1, ego @ SE2(12.0, 0.3, yaw_rad))) == pytest.approx(10.0)


def test_car_ahead_on_a_clip(tmp_path: Path) -> None:
    import cv2

    rng = np.random.default_rng(2)
    for folder in ("image_02", "lidar_cam0"):
        (tmp_path / folder).mkdir()
    (tmp_path / "calib.txt").write_text("P2: 400 0 320 0 0 400 96 0 0 0 1 0\n")
    boxes = {}
    for number in range(4):
        cv2.imwrite(str(tmp_path / "image_02" / f"{number:06d}.png"), np.zeros((192, 640), np.uint8))
        boxes[number], points = box_and_returns(10.0 + number, rng)
        if number != 3:  # a frame without LiDAR is passed over
            np.save(tmp_path / "lidar_cam0" / f"{number:06d}.npy", points.astype(np.float16))

    def run(recording: Recording) -> Iterator[Measurements | Estimate]:
        for frame in recording.frames():
            true_m = 10.0 + frame.index
            edges = [
                VehicleEdge(vehicle=7, frame=frame.index, T_ego_vehicle=SE2(), cov=COV3, box_px=boxes[frame.index]),
                VehicleEdge(vehicle=8, frame=frame.index, T_ego_vehicle=SE2(), cov=COV3, box_px=(0, 90, 99, 190)),
            ]
            yield Measurements(
                frame_id=frame.index, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, cv=tuple(edges), ground=None
            )
            vehicles = (vehicle(7, SE2(1.05 * true_m + 2.0, 0.0, 0.0)), vehicle(8, SE2(4.0, 5.0, 0.0)))
            ground = Ground(height_m=1.65)
            yield estimate(frame.index, SE2(), vehicles=vehicles, attitude=Attitude(), ground=ground)

    recording = open_recording(f"kitti:{tmp_path}")
    (row,) = evaluate_recordings([recording], run, tmp_path / "out")
    assert row.car_ahead.frames == 3
    assert row.car_ahead.error_median_rel == pytest.approx(0.05, abs=0.012)
    assert row.car_ahead.bias_median_rel == pytest.approx(0.05, abs=0.012)
    assert json.loads((tmp_path / "out" / "report.json").read_text())[0]["car_ahead"]["frames"] == 3


def test_the_real_clip_has_lidar_and_the_real_odometry_has_none(data_dir: Path) -> None:
    clip = open_recording(f"kitti:{data_dir / 'kitti_raw_clip'}")
    assert isinstance(clip, KittiRecording)
    assert CarAhead.of(clip) is not None
    assert CarAhead.of(open_recording(f"kitti:{data_dir / 'kitti_odometry/sequences/06'}")) is None
    points = np.load(clip.directory.parent / "lidar_cam0" / "000060.npy").astype(np.float64)
    box_px = (528.0, 199.0, 789.0, 373.0)  # of the car ahead, while both stand
    assert lidar_distance_m(clip.camera, clip.camera.ground, points, box_px) == pytest.approx(4.2, abs=0.1)
