"""Images with poses and points: geometry, formats, and the export of a drive's folder."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_files import Recorder, ResultsError
from birdslam.outputs.posed_images import PosedImage, PosedImages
from birdslam.runtime.batch.drive_export import FORMATS, export_drive
from birdslam.runtime.cli.main import main
from birdslam.sources.opening import open_recording
from birdslam.trajectory import ego_pose, inverse, mount_pose, read_kitti, read_tum
from birdslam.types import Attitude
from tests.records import new_estimate

CAMERA = Camera(640, 192, 400.0, 410.0, 320.0, 96.0, 1.65, pitch_rad=0.01)
COV3 = (0.0,) * 9


def views(points: np.ndarray, poses: list[np.ndarray], camera: Camera = CAMERA) -> PosedImages:
    """Exact images of points (N, 3) in world from camera poses (4, 4)."""
    posed = PosedImages(camera)
    for k, pose in enumerate(poses):
        q = (points - pose[:3, 3]) @ pose[:3, :3]
        px = q[:, :2] / q[:, 2:] * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
        image = np.full((camera.height_px, camera.width_px, 3), (1, 2, 3), np.uint8)
        posed.add(PosedImage(f"{k:06d}.jpg", 30_000_000 * k, pose, np.arange(len(points)), px), image)
    return posed


def ahead(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(12, 25, count), rng.uniform(-8, 8, count), rng.uniform(-1, 4, count)])


def along(count: int, turn_rad: float = 0.0) -> list[np.ndarray]:
    return [ego_pose(SE2(0.8 * k, 0.0, turn_rad * k), Attitude()) @ mount_pose(CAMERA.ground) for k in range(count)]


@given(st.integers(0, 1000), st.floats(-0.01, 0.01))
def test_exact_images_give_exact_points(seed: int, turn_rad: float) -> None:
    points = ahead(20, seed)
    found = views(points, along(6, turn_rad)).points()
    assert found
    for point in found:
        assert np.abs(point.p_world - points[point.track[0][1]]).max() < 1e-6
        assert point.error_px < 1e-6


def test_moving_feature_is_not_a_point() -> None:
    posed = views(ahead(1), along(6))
    for k, image in enumerate(posed.images):
        image.px[0, 1] += 15.0 * k
    assert not posed.points()


def read_colmap(model: Path) -> tuple[list[float], dict[str, tuple[np.ndarray, np.ndarray]], dict[int, np.ndarray]]:
    """Intrinsics, T_cam_world and (N, 3) x, y, point id of each image, points by id, by COLMAP's documentation."""

    def rows(name: str) -> list[list[str]]:
        lines = (model / name).read_text().splitlines()
        return [line.split() for line in lines if not line.startswith("#")]

    (camera,) = rows("cameras.txt")
    assert camera[1] == "PINHOLE"
    images, lines = {}, rows("images.txt")
    for head, corners in zip(lines[::2], lines[1::2], strict=True):
        w, x, y, z, *t = map(float, head[1:8])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), t
        images[head[9]] = pose, np.array(corners, np.float64).reshape(-1, 3)
    points = {int(row[0]): np.array(row[1:4], np.float64) for row in rows("points3D.txt")}
    return [float(word) for word in camera[4:]], images, points


def test_colmap_projects_the_points_onto_their_pixels(tmp_path: Path) -> None:
    posed = views(ahead(30), along(5, 0.01))
    assert posed.write_colmap(tmp_path) > 20
    (fx, fy, cx, cy), images, points = read_colmap(tmp_path / "sparse" / "0")
    for T_cam_world, corners in images.values():
        for x, y, number in corners[corners[:, 2] >= 0]:
            q = T_cam_world[:3] @ np.append(points[int(number)], 1.0)
            assert abs(fx * q[0] / q[2] + cx - x) < 0.01
            assert abs(fy * q[1] / q[2] + cy - y) < 0.01


def test_nerfstudio_projects_the_points_onto_their_pixels(tmp_path: Path) -> None:
    posed = views(ahead(30), along(5, 0.01))
    count = posed.write_nerfstudio(tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    lines = (tmp_path / content["ply_file_path"]).read_text().splitlines()
    cloud = np.array([line.split()[:3] for line in lines[lines.index("end_header") + 1 :]], np.float64)
    assert len(cloud) == count > 20
    for image, frame in zip(posed.images, content["frames"], strict=True):
        x, y, z = inverse(np.array(frame["transform_matrix"]))[:3] @ np.column_stack([cloud, np.ones(count)]).T
        px = np.column_stack([content["fl_x"] * x / -z + content["cx"], content["fl_y"] * y / z + content["cy"]]) - 0.5
        distance = np.linalg.norm(px[:, None] - image.px[None], axis=2).min(axis=1)
        assert distance.max() < 0.01  # x right, y up, z back; pixel centres at one half


def recorded(folder: Path, frames: int = 40) -> np.ndarray:
    """The folder of a drive with the true poses of the shipped drive; returns these, (frames, 3, 4) of camera 0."""
    recording = open_recording("demo")
    truth = recording.truth_poses()
    mount = mount_pose(recording.camera.ground)
    with Recorder(folder, recording.camera) as recorder:
        for k, frame in enumerate(recording.frames()):
            if k == frames:
                break
            T = np.eye(4)
            T[:3] = truth[k]
            ego = mount @ T @ inverse(mount)
            pose = SE2(float(ego[0, 3]), float(ego[1, 3]), float(np.arctan2(ego[1, 0], ego[0, 0])))
            recorder.add(new_estimate(frame_id=k, t_source_ns=frame.t_source_ns, T_world_ego=pose, valid=k != 3))
        source = {"uri": "demo", "stride": 1}
        recorder.finish({"configuration": {"camera": msgspec.to_builtins(recording.camera), "source": source}})
    return truth[:frames]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    recorded(folder)
    return folder


def test_a_drive_becomes_a_model_in_metres(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(drive), "--format", "colmap", "--output", str(tmp_path / "model")]) == 0
    said = capsys.readouterr().out
    assert "images and" in said
    assert "left out: 1 frames" in said
    _, images, points = read_colmap(tmp_path / "model" / "sparse" / "0")
    assert set(images) == {path.name for path in (tmp_path / "model" / "images").iterdir()}
    assert "000003.jpg" not in images
    heights_m = np.array(list(points.values()))[:, 2]
    assert len(points) > 50
    assert np.median(heights_m) > -0.5  # on or above the road, as far as tracks and poses go


@pytest.mark.processes
@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_colmap_reads_the_model(tmp_path: Path) -> None:
    views(ahead(30), along(5, 0.01)).write_colmap(tmp_path)
    code = f"import pycolmap; print(pycolmap.Reconstruction({str(tmp_path / 'sparse' / '0')!r}).num_points3D())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 20


def test_trajectories_are_the_cameras(drive: Path, tmp_path: Path) -> None:
    for form in ("tum", "kitti"):
        export_drive(drive, form, tmp_path / form)
    _, poses = read_tum(tmp_path / "tum")
    rows = read_kitti(tmp_path / "kitti")
    assert len(poses) == len(rows) == 39
    steps = np.einsum("ij,njk->nik", inverse(poses[0]), poses)
    assert np.abs(steps[:, :3] - rows).max() < 1e-5


@pytest.mark.parametrize("form", FORMATS)
def test_export_errors_are_one_line(drive: Path, tmp_path: Path, form: str) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    with pytest.raises(ResultsError, match="exists already"):
        export_drive(drive, form, taken)
    with pytest.raises(ResultsError, match="birdslam replay"):
        export_drive(taken, form, tmp_path / "new")
    if form == "geojson":
        with pytest.raises(ResultsError, match="--gnss"):
            export_drive(drive, form, tmp_path / "new")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ResultsError, match="gnss" if form == "geojson" else "finished drive"):
        export_drive(tmp_path / "empty", form, tmp_path / "new")
