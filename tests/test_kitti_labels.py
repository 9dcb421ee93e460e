"""KITTI labels: tracking and road data, and labels projected into the cameras."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.bench.simulation.odometry import EXACT, OdometryNoise, SimulatedOdometry
from birdslam.bench.simulation.tilt_from_images import TiltFromImages
from birdslam.bench.tracking.labelled_road import labelled_grounds
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti_tracking import TrackingSequence, camera_with_images, open_tracking, read_detections
from birdslam.sources.label_projection import Label, hull_px, project_labels
from birdslam.sources.recording import DatasetError
from tests import tracking_world


def test_oxts_and_pose_rows_agree(tmp_path: Path) -> None:
    by_rows = open_tracking(tracking_world.write(tmp_path / "a"), "0002")
    by_oxts = open_tracking(tracking_world.write(tmp_path / "b", with_oxts=True), "0002")
    np.testing.assert_allclose(by_oxts.poses, by_rows.poses, atol=1e-6)
    assert len(by_rows) == 40
    assert (by_rows.camera.fx_px, by_rows.camera.height_m) == (tracking_world.FX, 1.65)


def test_truth_is_seen_from_the_first_frame(tmp_path: Path) -> None:
    sequence = open_tracking(tracking_world.write(tmp_path), "0002")
    ego = sequence.ego_truth(5)
    assert ego[5] == SE2()
    assert ego[15].x_m == pytest.approx(10 * tracking_world.EGO_STEP_M)
    label = next(label for label in sequence.labels_of(5) if label.track == 7)
    truth = sequence.vehicle_truth(label, 5)
    assert (truth.x_m, truth.y_m) == pytest.approx((20.0 + 5 * 0.1, 4.0))
    assert truth.yaw_rad == pytest.approx(0.0, abs=1e-9)


def test_camera_2_is_beside_camera_0(tmp_path: Path) -> None:
    root = tracking_world.write(tmp_path)
    path = root / "calib" / "0002.txt"
    path.write_text(path.read_text().replace(f"{tracking_world.CX} 0 0", f"{tracking_world.CX} 43.3 0", 1))
    sequence = open_tracking(root, "0002")
    assert sequence.T_cam0_camera[0, 3] == pytest.approx(-43.3 / tracking_world.FX)
    label = sequence.labels_of(0)[0]
    assert sequence.vehicle_truth(label, 0).y_m == pytest.approx(-43.3 / tracking_world.FX)  # now further right


@pytest.mark.parametrize(
    ("focal_px", "size_px"), [(721.5377, (1242, 375)), (707.0493, (1224, 370)), (718.856, (1241, 376))]
)
def test_missing_images_have_the_size_of_their_day(tmp_path: Path, focal_px: float, size_px: tuple[int, int]) -> None:
    root = tracking_world.write(tmp_path)
    path = root / "calib" / "0002.txt"
    path.write_text(path.read_text().replace(str(tracking_world.FX), str(focal_px)))
    camera = open_tracking(root, "0002").camera
    assert camera.fx_px == focal_px
    assert (camera.width_px, camera.height_px) == size_px


def test_detections_by_frame_best_first(tmp_path: Path) -> None:
    folder = tmp_path / "det"
    (folder / "Car").mkdir(parents=True)
    (folder / "Pedestrian").mkdir()
    (folder / "Car" / "0001.txt").write_text("1,0,0,10,10,0.2\n1,5,5,20,20,0.9\n")
    (folder / "Pedestrian" / "0001.txt").write_text("1,30,30,40,60,0.5\n")
    none, some = read_detections(folder, "0001", 2)
    assert len(none) == 0
    assert some.labels == ("car", "person", "car")
    assert some.scores.tolist() == [0.9, 0.5, 0.2]


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("label_02/0002.txt", "0 1 Car 0 0\n", "line 1 has 5 columns"),
        ("label_02/0002.txt", "0 1 Car 0 0 x 1 1 2 2 1 1 1 1 1 1 1\n", "line 1 is not a label"),
        ("label_02/0002.txt", "0 1 Car 0 0 nan 1 1 2 2 1 1 1 1 1 1 1\n", "line 1 has invalid numbers"),
        ("label_02/0002.txt", "99 1 Car 0 0 0 1 1 2 2 1 1 1 1 1 1 1\n", "40 poses, but its labels end at frame 99"),
        ("pose_cam0/0002.txt", "1 0 0\n", "line 1 is not a KITTI pose"),
        ("pose_cam0/0002.txt", "", "has no poses"),
        ("calib/0002.txt", "P0: 1\n", "has no P2"),
        ("oxts/0002.txt", "1 2 3\n", "line 1 is not a GPS/IMU reading of 30"),
        ("oxts/0002.txt", "", "has no readings"),
    ],
)
def test_a_broken_file_is_named(tmp_path: Path, file: str, text: str, said: str) -> None:
    root = tracking_world.write(tmp_path)
    (root / file).parent.mkdir(exist_ok=True)
    (root / file).write_text(text)
    with pytest.raises(DatasetError, match=said) as error:
        open_tracking(root, "0002")
    assert "0002" in str(error.value)


def test_missing_things_are_named(tmp_path: Path) -> None:
    root = tracking_world.write(tmp_path)
    with pytest.raises(DatasetError, match=r"nowhere: no such directory"):
        open_tracking(tmp_path / "nowhere", "0002")
    with pytest.raises(DatasetError, match=r"0009"):
        open_tracking(root, "0009")
    with pytest.raises(DatasetError, match=r"no detections of sequence 0009"):
        read_detections(root / "det_02_rrc", "0009", 3)
    (root / "det_02_rrc" / "Car" / "0002.txt").write_text("0,1,2,3\n")
    with pytest.raises(DatasetError, match=r"Car/0002\.txt: line 1 is not a detection"):
        read_detections(root / "det_02_rrc", "0002", 3)
    (root / "pose_cam0" / "0002.txt").unlink()
    with pytest.raises(DatasetError, match=r"neither oxts/0002\.txt nor pose_cam0/0002\.txt"):
        open_tracking(root, "0002")


BASELINE_M = 0.532
KITTI = Path(os.environ.get("BIRDSLAM_DATA", Path(__file__).parents[2] / "shared" / "data")) / "kitti_tracking/training"


def with_right_camera(root: Path, frames: int = 2, suffix: str = ".jpg") -> Path:
    """The tracking world with a second colour camera at its right, whose images are there."""
    tracking_world.write(root)
    fx, cx, cy = tracking_world.FX, tracking_world.CX, tracking_world.CY
    calibration = root / "calib" / "0002.txt"
    calibration.write_text(f"{calibration.read_text()}P3: {fx} 0 {cx} {-fx * BASELINE_M} 0 {fx} {cy} 0 0 0 1 0\n")
    folder = root / "image_03" / "0002"
    folder.mkdir(parents=True)
    image = np.full((tracking_world.HEIGHT_PX, tracking_world.WIDTH_PX, 3), 90, np.uint8)
    for number in range(frames):
        cv2.imwrite(str(folder / f"{number:06d}{suffix}"), image)
    return root


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_camera_that_has_images_is_opened(tmp_path: Path, suffix: str) -> None:
    root = with_right_camera(tmp_path, suffix=suffix)
    assert camera_with_images(root, "0002") == 3
    assert camera_with_images(root, "0007") is None
    right, left = open_tracking(root, "0002"), open_tracking(root, "0002", 2)
    assert (right.number, left.number, left.images) == (3, 2, None)
    assert right.images == root / "image_03" / "0002"
    assert right.T_cam0_camera[0, 3] == pytest.approx(BASELINE_M)
    ours, theirs = (s.vehicle_truth(s.labels_of(0)[0], 0) for s in (right, left))
    assert ours.y_m == pytest.approx(theirs.y_m + BASELINE_M)  # seen from further right it is further left


def test_boxes_are_where_the_camera_sees_the_cars(tmp_path: Path) -> None:
    right = open_tracking(with_right_camera(tmp_path), "0002")
    for car in tracking_world.CARS:
        label = next(label for label in right.labels_of(0) if label.track == car.track)
        assert label.box_px == pytest.approx(tracking_world.box(car.z_m, car.x_m - BASELINE_M))
        assert label.truncated == 0


def test_labels_outside_the_image_are_truncated_or_dropped(tmp_path: Path) -> None:
    right = open_tracking(with_right_camera(tmp_path), "0002")
    label, T = right.labels_of(0)[0], right.T_cam0_camera

    def seen(x_m: float, z_m: float, **changed: object) -> list[tuple[tuple[float, ...], float]]:
        moved = replace(label, place_m=(x_m, tracking_world.HEIGHT_M, z_m), **changed)
        return [(found.box_px, found.truncated) for found in project_labels([moved], right.camera, T)]

    ((box, truncated),) = seen(-8.0, 9.5)
    assert (box[0], truncated) == (0.0, 1.0)
    assert seen(-40.0, 9.5) == []
    assert seen(0.0, -20.0) == []
    ((box, truncated),) = seen(1.5, 1.0)  # beside the camera: half of it is behind
    assert truncated == 1.0
    assert box[2:] == (tracking_world.WIDTH_PX, tracking_world.HEIGHT_PX)
    assert all(map(math.isfinite, box))
    region = replace(label, kind="DontCare", track=-1, place_m=(-1000.0, -1000.0, -1000.0))
    assert project_labels([region], right.camera, T) == [region]


@pytest.mark.skipif(not (KITTI / "image_03" / "0005").is_dir(), reason=f"no real images in {KITTI}")
def test_real_bodies_project_to_the_boxes_that_were_drawn() -> None:
    """In camera 2, whose boxes were drawn, hulls and labels must be one."""
    drawn = open_tracking(KITTI, "0005", 2)
    whole = [label for label in drawn.labels if label.kind == "Car" and label.truncated <= 0 and label.occluded == 0]
    apart = []
    for label in whole:
        hull = hull_px(label, drawn.camera, drawn.T_cam0_camera)
        apart.append((hull - label.box_px) / (label.box_px[3] - label.box_px[1]))
    assert np.abs(np.median(apart, axis=0)).max() < 0.02
    assert np.percentile(np.abs(apart), 95) < 0.05
    assert open_tracking(KITTI, "0005").number == 3


CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
FRAMES = 40
PITCH_RAD, ROLL_RAD = 0.012, 0.03
SPEEDS_MPS = (0.0, 0.0, 8.0)  # of three cars


def labelled(track: int, frame: int) -> Label:
    x_m, y_m = 15.0 + 8.0 * track + SPEEDS_MPS[track] * frame / 10.0, 4.0 - 4.0 * track
    down_m = 1.65 + x_m * (-PITCH_RAD + ROLL_RAD * y_m / x_m)
    box = (100.0 * track, 100.0, 100.0 * track + 60.0, 150.0)
    return Label(frame, track, "Car", 0.0, 0, box, 1.5, 1.6, 3.9, (-y_m, down_m, x_m), -math.pi / 2)


def sequence_of(ego_mps: float = 0.0) -> TrackingSequence:
    labels = [labelled(track, frame) for frame in range(FRAMES) for track in range(3)]
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 2, 3] = ego_mps / 10.0 * np.arange(FRAMES)
    return TrackingSequence("9999", CAMERA, np.eye(4), poses, tuple(labels), None)


def test_labels_tell_the_road_and_images_err_from_it_as_they_do() -> None:
    sequence = sequence_of(ego_mps=5.0)
    grounds = labelled_grounds(sequence)
    for ground in grounds:
        assert ground.pitch_rad == pytest.approx(PITCH_RAD, abs=0.01)
        assert ground.roll_rad == pytest.approx(ROLL_RAD, abs=0.02)
    errors, noise = [], OdometryNoise()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        odometry = TiltFromImages(SimulatedOdometry(CAMERA, sequence.camera_poses, EXACT, rng), grounds, noise, rng)
        motions = [odometry.estimate(None, frame, 0, np.zeros((0, 4))) for frame in range(FRAMES)]
        assert motions[0] is None
        last = motions[-1]
        errors.append((last.ground.pitch_rad - grounds[-1].pitch_rad) / last.pitch_sigma_rad)
    assert 0.6 < float(np.std(errors)) < 1.4
