"""The shipped drive, and its report: the truth has no error, and known errors are reported with their size."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.bench.tracking.shipped_drive import VEHICLES, DemoGrade, grade, match, mount_pose_of, true_egos
from birdslam.geometry import bev
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_video import SideBySide
from birdslam.runtime.configuration import load
from birdslam.runtime.supervision.demo_report import DemoReport, rows
from birdslam.runtime.supervision.final_results import FinalResults
from birdslam.runtime.supervision.final_results import rows as final_rows
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import COLUMNS, DIRECTORY, DemoRecording, write_drive
from birdslam.trajectory import as_poses, inverse, split_pose
from birdslam.types import IN_SIGHT_NS, Estimate, Moves
from tests.records import new_estimate, new_vehicle


@pytest.fixture(scope="module")
def demo() -> DemoRecording:
    recording = open_recording("demo")
    assert isinstance(recording, DemoRecording)
    return recording


def test_drive_is_half_a_minute_at_33_hz_below_12_mb(demo: DemoRecording) -> None:
    assert len(demo) == 1000
    assert demo.rate_hz == pytest.approx(33.0)
    assert sum(path.stat().st_size for path in DIRECTORY.iterdir()) < 12_000_000


def test_its_frames_are_deterministic_and_fit_its_camera(demo: DemoRecording) -> None:
    frame = next(demo.frames(500))
    assert frame.index == 500
    assert frame.t_source_ns == round(500 / 33.0 * 1e9)
    assert frame.image.shape == (demo.camera.height_px, demo.camera.width_px, 3)
    again = next(open_recording("demo:").frames(500))
    assert frame.image.tobytes() == again.image.tobytes()
    assert float(frame.image.std()) > 20.0


def test_a_stride_keeps_times_and_truth_together() -> None:
    third = open_recording("demo", stride=3)
    assert len(third) == 334
    assert third.rate_hz == pytest.approx(11.0)
    assert next(third.frames(10)).t_source_ns == round(30 / 33.0 * 1e9)
    every = open_recording("demo").truth_poses()
    poses = third.truth_poses()
    assert poses is not None
    np.testing.assert_array_equal(poses, every[::3])


def test_bodies_project_into_their_boxes(demo: DemoRecording) -> None:
    checked, hidden = 0, 0
    for index in range(0, 1000, 50):
        plane = demo.truth_ground(index)
        ground = GroundPlane(plane.height_m, plane.pitch_rad, plane.roll_rad)
        for body in demo.truth_bodies(index):
            hidden += body.visible == 0.0
            if 8.0 < body.T_ego_body.x_m < 20.0 and body.truncated == 0.0:
                u, v = bev.ego_to_pixel(demo.camera, ground, np.array([[body.T_ego_body.x_m, body.T_ego_body.y_m]]))[0]
                x1, y1, x2, y2 = body.box_px
                assert x1 - 3.0 <= u <= x2 + 3.0
                assert y1 <= v <= y2 + 0.35 * (y2 - y1) + 3.0
                checked += 1
    assert checked > 10
    assert hidden > 0


@pytest.mark.processes
def test_drive_is_read_without_renderer() -> None:
    code = (
        "import sys; sys.modules['numba'] = sys.modules['torch'] = None\n"
        "from birdslam.sources.opening import open_recording\n"
        "assert next(open_recording('demo').frames()).image is not None"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


def test_a_drive_written_is_the_drive_read(tmp_path: Path, demo: DemoRecording) -> None:
    image = next(demo.frames()).image
    assert image is not None
    camera = (DIRECTORY / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(camera)
    data = cv2.imencode(".jpg", image)[1]
    poses = np.tile(np.eye(4)[:3], (2, 1, 1))
    row = [1, 7, 3, 12.0, -2.0, 0.1, 11.0, 2.5, 3.0, 5.0, 0.5, 0.25, 0.5, 1.0, 2.0, 30.0, 40.0]
    assert len(row) == len(COLUMNS)
    write_drive(tmp_path, [data.tobytes(), b"torn"], 20.0, poses, np.array([[1.5, 0.01, 0.0]] * 2), np.array([row]))
    drive = DemoRecording(directory=tmp_path)
    first, second = drive.frames()
    assert first.image.tobytes() == cv2.imdecode(data, cv2.IMREAD_COLOR).tobytes()
    assert second.image is None
    assert second.error is not None
    assert "image 1 can't be decoded" in second.error
    (body,) = drive.truth_bodies(1)
    assert (body.body, body.label, body.T_ego_body.x_m, body.visible) == (7, "bus", 12.0, 0.25)
    assert drive.truth_bodies(0) == ()
    assert drive.truth_ground(0).height_m == 1.5


@pytest.mark.parametrize("content", [b"", b"no zip at all", None])
def test_a_torn_drive_is_named(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "drive.npz").write_bytes(content)
    with pytest.raises(DatasetError, match=r"drive\.npz"):
        DemoRecording(directory=tmp_path)


FRAMES = range(0, 90, 3)


@pytest.fixture(scope="module")
def truthful(demo: DemoRecording) -> list[Estimate]:
    """Estimates equal to the truth."""
    poses, out = as_poses(demo.truth_poses()), []
    T_world_first, T_cam_ego = mount_pose_of(demo, 0), inverse(mount_pose_of(demo, 0))
    for k in FRAMES:
        # The world that the recorder's constant mount makes of the camera's poses (trajectory.py)
        ego, attitude = split_pose(T_world_first @ poses[k] @ T_cam_ego)
        vehicles = tuple(
            new_vehicle(
                vehicle=body.body, T_world_vehicle=ego @ body.T_ego_body, length_m=body.length_m, width_m=body.width_m
            )
            for body in demo.truth_bodies(k)
            if body.label in VEHICLES
        )
        out.append(new_estimate(frame_id=k, T_world_ego=ego, vehicles=vehicles, attitude=attitude))
    return out


def stretched(estimate: Estimate, factor: float) -> Estimate:
    """The same trajectory scaled by a factor; vehicles keep their positions relative to the ego."""
    pose = estimate.T_world_ego
    ego = SE2(factor * pose.x_m, factor * pose.y_m, pose.yaw_rad)
    vehicles = tuple(
        msgspec.structs.replace(v, T_world_vehicle=ego @ pose.between(v.T_world_vehicle)) for v in estimate.vehicles
    )
    return msgspec.structs.replace(estimate, T_world_ego=ego, vehicles=vehicles)


def test_the_truth_has_no_errors(demo: DemoRecording, truthful: list[Estimate]) -> None:
    found = grade(demo, truthful)
    assert found.frames == len(FRAMES)
    assert found.ego_ate_m < 0.05  # the springs of the camera alone
    assert found.vehicles > 5
    assert found.vehicle_ate_m < 0.05
    assert found.vehicle_centre_m == pytest.approx(0.0, abs=1e-9)
    assert found.found == 1.0


def test_scale_error_is_found_and_not_counted_relative_to_ego(demo: DemoRecording, truthful: list[Estimate]) -> None:
    found = grade(demo, [stretched(estimate, 1.05) for estimate in truthful])
    assert found.ego_scale_error == pytest.approx(0.05, abs=0.005)
    assert found.ego_ate_m > 0.02 * found.path_m
    assert found.vehicle_ate_m > 0.2
    assert found.vehicle_centre_m == pytest.approx(0.0, abs=1e-9)


def test_new_epoch_continues_at_last_pose(demo: DemoRecording, truthful: list[Estimate]) -> None:
    half = len(truthful) // 2
    whole, cut = grade(demo, truthful), [*truthful[:half]]
    origin = truthful[half].T_world_ego.inverse()
    for estimate in truthful[half:]:
        vehicles = tuple(
            msgspec.structs.replace(v, T_world_vehicle=origin @ v.T_world_vehicle) for v in estimate.vehicles
        )
        moved = origin @ estimate.T_world_ego
        cut.append(msgspec.structs.replace(estimate, epoch=1, T_world_ego=moved, vehicles=vehicles))
    step = truthful[half - 1].T_world_ego.between(truthful[half].T_world_ego)
    found = grade(demo, cut)  # shorter by one unobserved step
    assert whole.ego_ate_m < found.ego_ate_m < math.hypot(step.x_m, step.y_m)
    assert found.vehicle_centre_m == pytest.approx(0.0, abs=1e-9)


def test_a_vehicle_out_of_range_or_hidden_matches_no_track(demo: DemoRecording, truthful: list[Estimate]) -> None:
    estimate, body = truthful[0], next(b for b in demo.truth_bodies(0) if b.label in VEHICLES)
    (vehicle,) = (v for v in estimate.vehicles if v.vehicle == body.body)
    assert [v.vehicle for _, v in match(estimate, [body], [vehicle])] == [body.body]
    range_m = math.hypot(body.T_ego_body.x_m, body.T_ego_body.y_m)
    away = SE2(max(2.0, 0.2 * range_m) + 0.1, 0.0, 0.0) @ vehicle.T_world_vehicle
    assert match(estimate, [body], [msgspec.structs.replace(vehicle, T_world_vehicle=away)]) == []


def test_predicted_vehicle_counts_as_reported_not_detected(demo: DemoRecording, truthful: list[Estimate]) -> None:
    def aged(age_ns: int) -> DemoGrade:
        vehicles = tuple(msgspec.structs.replace(v, age_ns=age_ns) for v in truthful[0].vehicles)
        return grade(demo, [msgspec.structs.replace(truthful[0], vehicles=vehicles)])

    assert (aged(0).found, aged(0).reported) == (1.0, 1.0)
    assert (aged(1).found, aged(1).reported) == (0.0, 1.0)
    assert (aged(IN_SIGHT_NS + 1).found, aged(IN_SIGHT_NS + 1).reported) == (0.0, 0.0)


def test_drive_without_vehicles_has_no_vehicle_results(demo: DemoRecording, truthful: list[Estimate]) -> None:
    found = grade(demo, [msgspec.structs.replace(estimate, vehicles=()) for estimate in truthful])
    assert (found.vehicles, found.vehicle_ate_m, found.vehicle_centre_m, found.found) == (0, None, None, 0.0)
    text = dict(rows({"truth": msgspec.to_builtins(found)}))
    assert text["ATE of vehicles"].startswith("- m")
    assert "can't write" in dict(final_rows({"video": None}))["video"]


def test_true_ego_starts_at_origin_and_moves_forward(demo: DemoRecording) -> None:
    egos = true_egos(demo)
    assert len(egos) == len(demo)
    np.testing.assert_allclose([egos[0].x_m, egos[0].y_m, egos[0].yaw_rad], 0.0, atol=1e-9)
    assert egos[30].x_m > 8.0


def test_run_writes_video_and_results(demo: DemoRecording, truthful: list[Estimate], tmp_path: Path) -> None:
    configuration = load(None, {"source.uri": "demo", "output": str(tmp_path)})
    report = DemoReport.of(configuration)
    assert report.grade() is None
    assert FinalResults(configuration, report).write(()) == {}
    for estimate in truthful:
        report.add(estimate)
    summary = {"truth": msgspec.to_builtins(report.grade()), **FinalResults(configuration, report).write(())}
    told = [name for name, _ in (*rows(summary), *final_rows(summary))]
    assert told == ["ATE of the ego", "ATE of vehicles", "  from the ego", "movers", "video"]
    video = cv2.VideoCapture(summary["video"])
    shown, picture = video.read()
    video.release()
    assert shown
    assert picture.shape[1::-1] == SideBySide(demo.camera).size_px


def test_the_picture_shows_vehicles_in_both_views(demo: DemoRecording, truthful: list[Estimate]) -> None:
    image = next(demo.frames(0)).image
    assert image is not None
    with_them = SideBySide(demo.camera).draw(image, truthful[0], [], [])
    without = SideBySide(demo.camera).draw(image, msgspec.structs.replace(truthful[0], vehicles=()), [], [])
    changed = (with_them != without).any(axis=2)
    width_px = round(demo.camera.width_px * 1.5)
    assert changed[:, :width_px].any()
    assert changed[:, width_px:].any()


@pytest.mark.parametrize("settings", [{"source.uri": "kitti:nowhere"}, {"source.uri": "demo", "source.loop": True}])
def test_a_run_without_truth_or_without_end_has_no_report(settings: dict[str, object]) -> None:
    assert DemoReport.of(load(None, settings)) is None
    assert rows({}) == []


def test_movers_are_evaluated_at_any_range(demo: DemoRecording) -> None:
    """Moving vehicles are reported as moving; then all vehicles, at distances a third too large."""

    def told(everything: bool, factor: float) -> DemoGrade:
        estimates = []
        for k, ego in enumerate(true_egos(demo)[:90]):
            vehicles = tuple(
                new_vehicle(
                    vehicle=body.body,
                    T_world_vehicle=ego @ SE2(factor * body.T_ego_body.x_m, factor * body.T_ego_body.y_m),
                    velocity_mps=(5.0, 0.0),
                    length_m=body.length_m,
                    width_m=body.width_m,
                    moves=Moves.DRIVING if everything or math.hypot(*body.velocity_mps) > 1.0 else Moves.STANDING,
                )
                for body in demo.truth_bodies(k)
                if body.label in VEHICLES
            )
            estimates.append(new_estimate(frame_id=k, T_world_ego=ego, vehicles=vehicles))
        return grade(demo, estimates)

    right, wrong = told(False, 1.0), told(True, 1.33)
    assert right.standing > 3
    assert right.driving > 1
    assert (right.false_movers, right.missed_movers, right.movers_soon) == (0, 0, right.driving)
    assert wrong.false_movers > 0.8 * right.standing
