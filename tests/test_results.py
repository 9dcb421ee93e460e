"""Results on disk: with gaps, new epochs, long drives, and folders that can't be written."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.outputs import bev_picture
from birdslam.outputs.bev_picture import Track
from birdslam.outputs.drive_files import Recorder, ResultsError, claim_directory
from birdslam.outputs.placed import ROAD_IN_MAP, Place, write_places
from birdslam.outputs.scene_recorder import SceneRecorder, Thinned
from birdslam.trajectory import read_kitti, read_tum
from birdslam.types import Attitude, Estimate, MapUpdate, Moves, SpeedSource, Status, VehicleEstimate
from tests.records import new_vehicle

CAMERA = Camera(640, 192, 400.0, 400.0, 320.0, 96.0, 1.65, pitch_rad=0.01)
COV3, COV2 = (0.0,) * 9, (0.0,) * 4


def estimate(frame_id: int, pose: SE2, epoch: int = 0, **fields: object) -> Estimate:
    return Estimate(
        epoch=epoch,
        frame_id=frame_id,
        t_source_ns=frame_id * 30_000_000,
        t_capture_ns=0,
        t_utc_ns=0,
        T_world_ego=pose,
        cov=COV3,
        valid=Status.FRAME_UNREADABLE not in fields.get("status", ()),
        **fields,
    )


def vehicle(number: int, pose: SE2, frames: int, speed_mps: float = 0.0, **fields: object) -> VehicleEstimate:
    return new_vehicle(
        vehicle=number,
        T_world_vehicle=pose,
        velocity_mps=(speed_mps, 0.0),
        age_ns=fields.pop("age_ns", 0),
        frames=frames,
        **fields,
    )


def test_counts_are_reported_despite_a_disk_failure(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    recorder.add(estimate(0, SE2()))
    write_places(tmp_path, [Place(0, 0, SE2(), SE2())])
    (tmp_path / ROAD_IN_MAP).mkdir()
    with pytest.raises(IsADirectoryError):
        recorder.finish({})
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 1


def test_a_drive(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "out", CAMERA)
    for k in range(30):
        seen = [
            vehicle(1, SE2(20.0, 3.0, math.pi), k + 1),
            vehicle(2, SE2(10.0 + k, 0.0, 0.0), k + 1, 33.0, label="van"),
        ]
        if k >= 20:
            seen[0] = vehicle(1, SE2(99.0, 3.0, 0.0), 20, age_ns=30_000_000)  # predicted, not seen
        attitude = Attitude(z_m=0.01 * k, pitch_rad=0.001 * k)
        recorder.add(estimate(k, SE2(1.0 * k, 0.0, 0.0), vehicles=tuple(seen), attitude=attitude))
        recorder.add_map(
            MapUpdate(
                epoch=0, frame_id=k, landmarks_m=((k + 5.0, -1.0),), lanes_m=((k, 1.75), (k, -1.75)), lane_ids=(4, -1)
            )
        )
    recorder.finish({"rate_hz": 33.0, "age_ms": {"p50": math.nan, "p99": np.float64(3.0)}, "path": Path("x")})

    assert read_kitti(tmp_path / "out" / "ego.kitti.txt").shape == (30, 3, 4)
    t_s, ego = read_tum(tmp_path / "out" / "ego.tum.txt")
    assert t_s[:2].tolist() == [0.0, 0.03]
    assert ego[29, :3, 3] == pytest.approx([29.0, 0.0, 0.29])
    assert sorted(path.name for path in (tmp_path / "out" / "tracks").iterdir()) == ["1.tum.txt", "2.tum.txt"]
    _, parked = read_tum(tmp_path / "out" / "tracks" / "1.tum.txt")
    assert parked.shape == (20, 4, 4)  # only where it was seen
    assert parked[5, :3, 3] == pytest.approx([20.0, 3.0, 0.05])
    assert "# class van, length_m 4.0, width_m 1.7" in (tmp_path / "out" / "tracks" / "2.tum.txt").read_text()
    rows = list(csv.DictReader((tmp_path / "out" / "map.csv").read_text().splitlines()))
    assert [(row["kind"], float(row["x_m"]), float(row["y_m"]), int(row["lane"])) for row in rows[:3]] == [
        ("landmark", 5.0, -1.0, -1),
        ("lane", 0.0, 1.75, 4),
        ("lane", 0.0, -1.75, -1),
    ]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"], summary["tracks"], summary["epochs"], summary["path_m"]) == (30, 2, 1, 29.0)
    assert summary["age_ms"] == {"p50": None, "p99": 3.0}
    assert summary["path"] == "x"


def test_scale_sources_are_counted(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    road, car, carried = SpeedSource.ROAD, SpeedSource.CAR, SpeedSource.CARRIED
    for k, sources in enumerate([(), (road,), (road, car), (road, car), (carried,)]):
        recorder.add(estimate(k, SE2(), speed_sources=sources))
    recorder.finish({})
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["speed_sources"] == {"car": 2, "carried": 1, "road": 3}


def test_changed_class_or_size_is_written_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    for k, (label, length_m) in enumerate([("car", 4.0), ("car", 4.01), ("van", 4.9), ("van", 4.9)]):
        recorder.add(
            estimate(k, SE2(), vehicles=(vehicle(3, SE2(9.0, 0.0, 0.0), k + 1, label=label, length_m=length_m),))
        )
    recorder.finish({})
    comments = [line for line in (tmp_path / "tracks" / "3.tum.txt").read_text().splitlines() if line[0] == "#"]
    assert [line for line in comments if "class" in line] == [
        "# class car, length_m 4.0, width_m 1.7",
        "# class van, length_m 4.9, width_m 1.7",
    ]


def test_row_k_is_frame_k_whatever_was_dropped_or_unreadable(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    recorder.add(estimate(0, SE2()))
    recorder.add(estimate(1, SE2(1.0, 0.0, 0.0)))
    recorder.add(estimate(2, SE2(1.0, 0.0, 0.0), status=(Status.FRAME_UNREADABLE,)))
    recorder.add(estimate(5, SE2(5.0, 0.0, 0.0), status=(Status.FRAMES_DROPPED,)))
    recorder.add(estimate(6, SE2(), status=(Status.END_OF_SOURCE,)))
    recorder.finish({})
    z_m = read_kitti(tmp_path / "ego.kitti.txt")[:, 2, 3]
    assert z_m == pytest.approx(np.array([0.0, 1.0, 1.0, 1.0, 1.0, 5.0]) * math.cos(0.01), abs=1e-8)
    assert len(read_tum(tmp_path / "ego.tum.txt")[0]) == 3  # gaps in times are not filled
    assert "# not valid: 0.060000000 1.000000000 " in (tmp_path / "ego.tum.txt").read_text()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["statuses"] == {"frame_unreadable": 1, "frames_dropped": 1}
    assert summary["invalid_frames"] == 1


def test_restarted_frame_numbers_continue(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    for frame_id in (0, 1, 0, 1, 2, 10**15):
        recorder.add(estimate(frame_id, SE2()))
    recorder.finish({})
    assert len(read_kitti(tmp_path / "ego.kitti.txt")) == 6


def test_a_new_epoch_is_marked_and_the_trajectories_continue(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    seen = (vehicle(4, SE2(12.0, 0.0, 0.0), 9),)
    for k in range(5):
        recorder.add(estimate(k, SE2(1.0 * k, 0.0, 0.0), vehicles=seen))
    for k in range(5):
        recorder.add(estimate(5 + k, SE2(1.0 * k, 0.0, 0.0), epoch=1, vehicles=seen))
    recorder.add_map(MapUpdate(epoch=0, frame_id=4, lanes_m=((1.0, 2.0),)))  # late: in the file, not in the picture
    recorder.finish({})
    z_m = read_kitti(tmp_path / "ego.kitti.txt")[:, 2, 3] / math.cos(0.01)
    assert z_m == pytest.approx([0, 1, 2, 3, 4, 4, 5, 6, 7, 8])
    tum = (tmp_path / "ego.tum.txt").read_text().splitlines()
    mark = tum.index("# epoch 1: a new world frame begins; its poses continue at the last one")
    assert tum[mark + 1].startswith("0.150000000 4.000000000 ")
    _, poses = read_tum(tmp_path / "ego.tum.txt")
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() == pytest.approx(1.0)  # no jump
    track = (tmp_path / "tracks" / "4.tum.txt").read_text().splitlines()
    assert track.count("# epoch 1: a new world frame begins") == 1
    assert json.loads((tmp_path / "summary.json").read_text())["path_m"] == 8.0


def test_rows_are_on_disk_before_the_end(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    recorder.add(estimate(0, SE2(), vehicles=(vehicle(1, SE2(9.0, 0.0, 0.0), 1),)))
    recorder.add_map(MapUpdate(epoch=0, frame_id=0, lanes_m=((1.0, 2.0),)))
    for name in ("ego.kitti.txt", "ego.tum.txt", "tracks/1.tum.txt", "map.csv"):
        assert (tmp_path / name).read_text().endswith("\n"), name
        assert len((tmp_path / name).read_text().splitlines()) >= 1
    recorder.finish({})


def test_a_recorder_left_early_keeps_its_rows(tmp_path: Path) -> None:
    with Recorder(tmp_path, CAMERA) as recorder:
        recorder.add(estimate(0, SE2()))
    assert len(read_kitti(tmp_path / "ego.kitti.txt")) == 1
    assert not (tmp_path / "summary.json").exists()
    with pytest.raises(ValueError, match="closed"):
        recorder.add(estimate(1, SE2()))


def test_results_of_an_earlier_run_are_replaced(tmp_path: Path) -> None:
    for number in (1, 2):
        recorder = Recorder(tmp_path, CAMERA)
        recorder.add(estimate(0, SE2(), vehicles=(vehicle(number, SE2(9.0, 0.0, 0.0), 1),)))
        recorder.finish({})
    assert [path.name for path in (tmp_path / "tracks").iterdir()] == ["2.tum.txt"]
    assert len(read_kitti(tmp_path / "ego.kitti.txt")) == 1


def test_a_directory_that_can_not_be_written_to_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for directory in (file, file / "below"):
        with pytest.raises(ResultsError, match=r"output directory .*file"):
            claim_directory(directory)
    (tmp_path / "out" / "ego.kitti.txt").mkdir(parents=True)
    with pytest.raises(ResultsError, match=r"Is a directory: .*ego\.kitti\.txt"):
        Recorder(tmp_path / "out", CAMERA)


def test_a_drive_without_frames_leaves_empty_results(tmp_path: Path) -> None:
    Recorder(tmp_path, CAMERA).finish({})
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 0
    assert cv2.imread(str(tmp_path / "bev.png")) is not None


@given(st.integers(1, 3000), st.integers(2, 60))
def test_thinned_rows_are_bounded_and_evenly_spread(count: int, keep: int) -> None:
    rows = Thinned(1, keep)
    for number in range(count):
        rows.add(float(number))
    kept = rows.array()[:, 0]
    step = kept[1] - kept[0] if len(kept) > 1 else 1.0 if count <= keep else math.inf
    assert len(kept) <= keep
    assert kept.tolist() == [number for number in range(count) if number % step == 0]
    assert count > keep or step == 1.0


@pytest.mark.slow
def test_memory_of_a_long_drive_is_bounded(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CAMERA)
    for k in range(4500):
        recorder.add(estimate(k, SE2(0.5 * k, 0.0, 0.0), vehicles=(vehicle(k // 3, SE2(0.5 * k, 3.0, 0.0), 9),)))
    assert len(recorder._tracks) <= 1000  # private: what is held in memory shows nowhere else
    assert len(recorder._scene._ego.array()) <= 4000  # private: likewise
    recorder.finish({})
    assert json.loads((tmp_path / "summary.json").read_text())["tracks"] == 1500
    assert len(list((tmp_path / "tracks").iterdir())) == 1500


def test_picture_shows_trajectory_and_moving_car(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bev_picture, "DPI", 160)
    recorder = Recorder(tmp_path, CAMERA)
    for k in range(40):
        seen = (
            vehicle(1, SE2(15.0 + k, 3.5, 0.0), k + 1, 10.0, moves=Moves.DRIVING),
            vehicle(2, SE2(30.0, -4.0, 0.0), k + 1, 0.1),
        )
        recorder.add(estimate(k, SE2(1.0 * k, 0.0, 0.0), vehicles=seen))
    recorder.finish({})
    image = cv2.imread(str(tmp_path / "bev.png"))
    assert max(image.shape) > 1400
    blue, green, red = (image[..., channel].astype(int) for channel in range(3))
    ego = (blue > 200) & (green > 160) & (red < 90)
    rows, columns = np.nonzero(ego[:, : image.shape[1] // 2])
    assert np.ptp(rows) > 4 * np.ptp(columns)  # ahead is up


@pytest.mark.parametrize("moves", list(Moves))
def test_only_moving_vehicles_are_drawn_as_moving(moves: Moves) -> None:
    recorder = SceneRecorder()
    for k in range(30):
        seen = (vehicle(1, SE2(15.0 + k, 3.5, 0.0), k + 1, 10.0, moves=moves),)
        recorder.add(estimate(k, SE2(1.0 * k, 0.0, 0.0), vehicles=seen))
    (track,) = recorder.scene(name="", path_m=0.0, frames=30, track_count=1).tracks
    assert track.is_moving is (moves is Moves.DRIVING)


@pytest.mark.parametrize(("way_m", "speed_mps", "moving"), [(30.0, 8.0, True), (5.0, 8.0, False), (30.0, 0.2, False)])
def test_a_creeping_parked_car_is_not_drawn_as_moving(way_m: float, speed_mps: float, moving: bool) -> None:
    poses = np.column_stack([np.linspace(0.0, way_m, 30), np.zeros(30), np.zeros(30)])
    assert Track(1, "car", 4.0, 1.7, poses, 30, speed_mps, farthest_m=40.0).is_moving is moving
