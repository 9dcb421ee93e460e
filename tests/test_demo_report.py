"""The report on the shipped drive: the truth has no error, and known errors are reported with their size."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.bench.tracking.shipped_drive import VEHICLES, DemoGrade, grade, match, mount_pose_of, true_egos
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_video import SideBySide
from birdslam.runtime.configuration import load
from birdslam.runtime.supervision.demo_report import DemoReport, rows
from birdslam.runtime.supervision.final_results import FinalResults
from birdslam.runtime.supervision.final_results import rows as final_rows
from birdslam.sources.opening import open_recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import as_poses, inverse, split_pose
from birdslam.types import IN_SIGHT_NS, Estimate, Moves
from tests.records import new_estimate, new_vehicle

FRAMES = range(0, 90, 3)
COV = (0.0,) * 9


@pytest.fixture(scope="module")
def demo() -> DemoRecording:
    recording = open_recording("demo")
    assert isinstance(recording, DemoRecording)
    return recording


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
