"""Calibration files of other projects: the same camera from each, and one clear line for an invalid file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.calibration.camera_files import format_of, read_intrinsics
from birdslam.runtime.cli.main import main
from birdslam.sources.recording import DatasetError

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.001, 0.0005]
  distortion_model: radtan
  intrinsics: [438.5, 437.25, 305.5, 243.75]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
ORB_SLAM3 = """%YAML:1.0
#--------------------------------------------------------------------------------------------
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 438.5
Camera1.fy: 437.25
Camera1.cx: 305.5
Camera1.cy: 243.75
Camera1.k1: -0.3
Camera1.k2: 0.1
Camera1.p1: 0.001
Camera1.p2: 0.0005
Camera.width: 640
Camera.height: 480
Camera.fps: 30
"""
ORB_SLAM2 = ORB_SLAM3.replace("Camera1.", "Camera.").replace('File.version: "1.0"\n', "")
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
1 OPENCV 640 480 438.5 437.25 306 244.25 -0.3 0.1 0.001 0.0005
"""
XML = """<?xml version="1.0"?>
<opencv_storage>
<image_width>640</image_width>
<image_height>480</image_height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>438.5 0. 305.5 0. 437.25 243.75 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>
  <data>-0.3 0.1 0.001 0.0005</data></Distortion_Coefficients>
</opencv_storage>
"""
OPENCV_YAML = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.385e+02, 0., 3.055e+02, 0., 4.3725e+02, 2.4375e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -3.0e-01, 1.0e-01, 1.0e-03, 5.0e-04 ]
"""
ROS = """image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [438.5, 0.0, 305.5, 0.0, 437.25, 243.75, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 4, data: [-0.3, 0.1, 0.001, 0.0005]}
"""
ROS_MESSAGE = """header:
  seq: 0
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.3, 0.1, 0.001, 0.0005]
K: [438.5, 0.0, 305.5, 0.0, 437.25, 243.75, 0.0, 0.0, 1.0]
---
"""
ROS_JSON = """{"image_width": 640, "image_height": 480, "distortion_model": "plumb_bob",
 "D": [-0.3, 0.1, 0.001, 0.0005], "K": [438.5, 0, 305.5, 0, 437.25, 243.75, 0, 0, 1]}"""
NUSCENES = """[{"token": "a", "camera_intrinsic": []},
 {"token": "b", "camera_intrinsic": [[438.5, 0.0, 305.5], [0.0, 437.25, 243.75], [0.0, 0.0, 1.0]]}]"""
FILES = {
    "Kalibr": ("camchain.yaml", KALIBR),
    "ORB-SLAM3": ("settings.yaml", ORB_SLAM3),
    "ORB-SLAM2": ("settings.yaml", ORB_SLAM2),
    "COLMAP": ("cameras.txt", COLMAP),
    "OpenCV": ("camera.xml", XML),
    "OpenCV's YAML": ("out.yml", OPENCV_YAML),
    "ROS": ("camera.yaml", ROS),
    "a message of ROS": ("camera.yaml", ROS_MESSAGE),
    "ROS as JSON": ("camera_info.json", ROS_JSON),
}


def written(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("kind", FILES)
def test_the_same_camera_comes_from_every_format(tmp_path: Path, kind: str) -> None:
    lens = read_intrinsics(written(tmp_path, *FILES[kind]))
    assert (lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px) == (438.5, 437.25, 305.5, 243.75)
    assert lens.distortion == (-0.3, 0.1, 0.001, 0.0005)
    assert (lens.width_px, lens.height_px, lens.fisheye) == (640, 480, False)


def test_an_undistorted_camera_of_kitti(tmp_path: Path) -> None:
    lens = read_intrinsics(written(tmp_path, "calib.txt", "P2: 721.5 0 609.5 44.8 0 721.5 172.8 0.2 0 0 1 0.002\n"))
    assert (lens.fx_px, lens.cx_px, lens.distortion, lens.width_px) == (721.5, 609.5, (), None)


def test_a_camera_of_kitti_raw_has_the_size_of_its_rectified_images(tmp_path: Path) -> None:
    text = "S_00: 1392 512\nS_rect_00: 1.242e+03 3.75e+02\nP_rect_00: 721.5 0 609.5 0 0 721.5 172.8 0 0 0 1 0\n"
    lens = read_intrinsics(written(tmp_path, "calib_cam_to_cam.txt", text))
    assert (lens.fx_px, lens.width_px, lens.height_px) == (721.5, 1242, 375)


def test_an_undistorted_camera_of_nuscenes(tmp_path: Path) -> None:
    lens = read_intrinsics(written(tmp_path, "calibrated_sensor.json", NUSCENES))
    assert (lens.fx_px, lens.fy_px, lens.distortion, lens.width_px) == (438.5, 437.25, (), None)


@pytest.mark.parametrize(
    ("kind", "before", "after"),
    [
        ("Kalibr", "radtan", "equidistant"),
        ("ORB-SLAM3", "PinHole", "KannalaBrandt8"),
        ("COLMAP", "OPENCV ", "OPENCV_FISHEYE "),
        ("ROS as JSON", "plumb_bob", "equidistant"),
    ],
)
def test_a_fisheye_of_every_format_is_equidistant(tmp_path: Path, kind: str, before: str, after: str) -> None:
    name, text = FILES[kind]
    text = text.replace(before, after).replace("Camera1.p1", "Camera1.k3").replace("Camera1.p2", "Camera1.k4")
    lens = read_intrinsics(written(tmp_path, name, text))
    assert lens.fisheye
    assert lens.distortion == (-0.3, 0.1, 0.001, 0.0005)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencvs_models_of_distortion_reach_the_camera(tmp_path: Path, count: int) -> None:
    from birdslam.geometry.camera import Camera

    D = [-0.3, 0.1, 0.001, 0.0005, 0.01, 0.02, 0.005, 0.001, 1e-4, 0.0, 1e-4, 0.0, 1e-3, 1e-3][:count]
    lens = read_intrinsics(written(tmp_path, "c.json", ROS_JSON.replace("-0.3, 0.1, 0.001, 0.0005", str(D)[1:-1])))
    assert lens.distortion == tuple(D)
    camera = Camera(640, 480, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, 1.5, distortion=lens.distortion)
    map_x, _ = cv2.initUndistortRectifyMap(camera.K, np.array(D), None, camera.K, (640, 480), cv2.CV_32FC1)
    assert np.isfinite(map_x).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", KALIBR.replace("pinhole", "omni"), "camera_model omni is not supported"),
        ("a.yaml", KALIBR.replace("radtan", "fov"), "distortion_model fov is not supported"),
        ("a.yaml", KALIBR + KALIBR.replace("cam0", "cam1"), "has 2 cameras; keep one"),
        ("a.yaml", KALIBR.replace("438.5, ", ""), "3 numbers, not 4"),
        ("a.yaml", ORB_SLAM3.replace("PinHole", "Mei"), "Camera.type Mei is not supported"),
        ("a.yaml", ORB_SLAM3.replace("Camera1.cy", "Camera1.cz"), "lacks one of Camera1.fx"),
        ("a.txt", COLMAP.replace("OPENCV ", "FOV "), "camera model FOV is not supported"),
        ("a.txt", COLMAP.replace(" 0.0005", ""), "OPENCV has 7 parameters, not 8"),
        ("a.txt", COLMAP + "2 PINHOLE 640 480 400 400 320 240\n", "2 different cameras"),
        ("a.json", NUSCENES.replace('"camera_intrinsic": []', '"camera_intrinsic": [[1, 0, 2]]'), "2 different"),
        ("a.json", ROS_JSON.replace("438.5, 0, 305.5, 0, 437.25, 243.75, 0, 0, 1", "0,0,0,0,0,0,0,0,0"), "not calib"),
        ("a.json", ROS_JSON.replace("0.0005]", "0.0005, 0, 0]"), "6 distortion coefficients"),
        ("a.xml", XML.replace("</opencv_storage>", "<"), "not an OpenCV storage"),
        ("a.txt", "a film\n", "expected a file of KITTI, ROS"),
        ("a.txt", "P9: 1 2 3\n", "none of P0, P2"),
        ("a.txt", "P2: 1 2 nan 4 5 6 7 8 9 10 11 12\n", "not finite"),
        ("a.yaml", "[1, 2", "not YAML"),
        ("a.yaml", "- 1\n- 2\n", "has no camera"),
        ("a.yaml", "image_width: 3\n", "neither camera_matrix nor K"),
        ("a.yaml", ROS.replace("438.5", ".nan"), "not finite"),
        ("a.yaml", ROS.replace("438.5", "wide"), "not a number"),
        ("a.yaml", ROS.replace("438.5, 0.0,", "438.5, 9.0,"), "skew"),
        ("a.yaml", ROS.replace("438.5, ", ""), "8 numbers"),
        ("a.yaml", ROS.replace("plumb_bob", "mei"), "mei is not supported"),
        ("a.yaml", ROS.replace("image_width: 640", "image_width: wide"), "size 'wide'"),
        ("a.yaml", ROS + "x: !!python/object/apply:sys.exit [3]\n", "not YAML"),
    ],
)
def test_unusable_file_is_a_one_line_error(tmp_path: Path, name: str, text: str, message: str) -> None:
    path = written(tmp_path, name, text)
    with pytest.raises(DatasetError, match=message) as error:
        read_intrinsics(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"a\.yaml: can't be read"):
        read_intrinsics(tmp_path / "a.yaml")


@given(
    kind=st.sampled_from(sorted(FILES)),
    cut=st.integers(0, 400),
    put=st.binary(max_size=12),
    width=st.integers(0, 20),
)
def test_a_damaged_file_is_a_camera_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, kind: str, cut: int, put: bytes, width: int
) -> None:
    name, text = FILES[kind]
    data = text.encode()
    path = written(tmp_path_factory.mktemp("damaged"), name, data[:cut] + put + data[cut + width :])
    error = ""
    try:
        focal_px = read_intrinsics(path).fx_px
    except DatasetError as failure:
        error, focal_px = str(failure), 0.0
    assert focal_px > 0.0 or str(path) in error
    format_of(path)


def test_camera_option_names_missing_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, *FILES["Kalibr"])
    assert main(["run", "--source", "usb:0", "--camera", str(path), "--output", str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert str(path) in text
    assert "birdslam calibrate RECORDING --intrinsics" in text
