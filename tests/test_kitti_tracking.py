"""KITTI tracking's files: poses from GPS/IMU or rows, labels, detections; errors name file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti_tracking import open_tracking, read_detections
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
