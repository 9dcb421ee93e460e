"""`birdslam calibrate`: readers of intrinsics, estimators of pitch and roll, the height, and invalid input."""

from __future__ import annotations

import functools
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.calibration.calibration import (
    Calibration,
    CalibrationConfig,
    CalibrationError,
    Observations,
    by_road,
    calibrate,
)
from birdslam.calibration.camera_files import read_intrinsics
from birdslam.calibration.height_check import (
    SPEED,
    HeightCheck,
    HeightCheckConfig,
    VehicleHeightConfig,
    checks_by_length,
    checks_by_vehicles,
    solve_mounting,
)
from birdslam.calibration.intrinsics import from_chessboard
from birdslam.calibration.lane_width import LaneWidth, checks_by_lanes, painted_width_m
from birdslam.calibration.readout import PRIOR
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.lanes.ego_lane import EgoLane
from birdslam.odometry.road.fit import RoadFit
from birdslam.outputs.plain_words import DriveCounts, LengthsBy, verdict
from birdslam.perception import Perception, Ready
from birdslam.road_users.camera_height import BoxHeight
from birdslam.ros.bag import BagTopics
from birdslam.runtime.calibration.given import Given, KnownSize, known_length_of, lens_of
from birdslam.runtime.calibration.height import check_sigma_rel, lengths_by, with_height
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError
from birdslam.sources.camera_file import camera_text, load_camera
from birdslam.sources.recording import DatasetError
from birdslam.sources.speed_file import read_speed_curve
from birdslam.types import Frame, LaneLine, LineKind
from tests.test_camera_files import ROS
from tests.test_odometry import CAMERA, PITCH_RAD, render, street

# --- chessboard ---

LENS = np.array([[520.0, 0, 315.0], [0, 518.0, 236.0], [0, 0, 1]])
SQUARE_M, COLUMNS, ROWS = 0.03, 8, 5


def _board(turn: tuple[float, float, float], at_m: tuple[float, float, float]) -> np.ndarray:
    """A board of COLUMNS x ROWS inner corners, its middle `at_m` in front of the camera, 640x480."""
    side = 40
    pattern = np.full(((ROWS + 3) * side, (COLUMNS + 3) * side), 235, np.uint8)
    for v in range(ROWS + 1):
        for u in range(COLUMNS + 1):
            if (u + v) % 2 == 0:
                pattern[(v + 1) * side : (v + 2) * side, (u + 1) * side : (u + 2) * side] = 25
    to_m = np.array([[SQUARE_M / side, 0, 0], [0, SQUARE_M / side, 0], [0, 0, 1]])
    middle = np.array([(COLUMNS + 3) / 2 * SQUARE_M, (ROWS + 3) / 2 * SQUARE_M, 0.0])
    R, _ = cv2.Rodrigues(np.array(turn))
    t = np.array(at_m) - R @ middle
    H = LENS @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_m
    image = cv2.warpPerspective(pattern, H, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
    return cv2.GaussianBlur(image, (3, 3), 0.7)


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(4)
    for k in range(7):
        turn = (*rng.uniform(-0.5, 0.5, 2), float(rng.uniform(-0.2, 0.2)))
        at = (*rng.uniform(-0.06, 0.06, 2), float(rng.uniform(0.35, 0.5)))
        cv2.imwrite(str(folder / f"{k}.png"), _board(turn, at))
    return folder


def test_a_chessboard_gives_the_lens(boards: Path) -> None:
    lens = from_chessboard(boards, COLUMNS, ROWS, SQUARE_M)
    assert (lens.fx_px, lens.fy_px) == pytest.approx((520.0, 518.0), rel=0.01)
    assert (lens.cx_px, lens.cy_px) == pytest.approx((315.0, 236.0), abs=6.0)
    assert (lens.width_px, lens.height_px, len(lens.distortion)) == (640, 480, 5)
    assert lens.reprojection_px < 0.3


def test_a_bad_chessboard_is_named(boards: Path, tmp_path: Path) -> None:
    two = tmp_path / "two"
    two.mkdir()
    for name in ("0.png", "1.png"):
        (two / name).symlink_to(boards / name)
    small = tmp_path / "small"  # where there is no such board each is searched to the end
    small.mkdir()
    for name in ("0.png", "1.png"):
        cv2.imwrite(str(small / name), cv2.resize(cv2.imread(str(boards / name)), (160, 120)))
    with pytest.raises(DatasetError, match="was found in 0 of 2 images"):
        from_chessboard(small, COLUMNS + 1, ROWS + 1, SQUARE_M)
    with pytest.raises(DatasetError, match="no such directory"):
        from_chessboard(tmp_path / "nowhere", COLUMNS, ROWS, SQUARE_M)
    with pytest.raises(DatasetError, match="no images"):
        from_chessboard(tmp_path, COLUMNS, ROWS, SQUARE_M)
    with pytest.raises(DatasetError, match="invalid"):
        from_chessboard(boards, 2, 0, SQUARE_M)
    flat = tmp_path / "flat"
    flat.mkdir()
    for k in range(6):
        cv2.imwrite(str(flat / f"{k}.png"), _board((0.0, 0.0, 0.01 * k), (0.01 * k, 0.0, 0.4)))
    with pytest.raises(DatasetError, match="tilt the board more"):
        from_chessboard(flat, COLUMNS, ROWS, SQUARE_M)
    (two / "1.png").unlink()
    cv2.imwrite(str(two / "1.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(DatasetError, match=r"1\.png: is 100x100"):
        from_chessboard(two, COLUMNS, ROWS, SQUARE_M)
    (two / "1.png").write_bytes(b"torn")
    with pytest.raises(DatasetError, match=r"1\.png: damaged"):
        from_chessboard(two, COLUMNS, ROWS, SQUARE_M)


# --- the mounting by the vehicles ---


@pytest.mark.parametrize("seed", range(4))
def test_mount_from_vehicles_is_within_its_sigma(seed: int) -> None:
    rng, truth = np.random.default_rng(seed), np.array([1.4, 0.02, -0.01])
    boxes = []
    for vehicle in range(40):
        tall_m, far_m, b = rng.normal(1.53, 0.12), rng.uniform(8, 40), rng.uniform(-0.5, 0.5)
        for k in range(8):
            z = far_m + 0.5 * k
            bottom = truth[0] / z - truth[1] + truth[2] * b + rng.normal(0, 0.002)
            boxes.append(BoxHeight(vehicle, bottom, 0.002, tall_m / z + rng.normal(0, 0.002), 0.002, b, 1.53, 0.08))
    for _ in range(10):  # a detector's ghosts: vehicles that hang in the air
        boxes.append(BoxHeight(100 + len(boxes), -0.05, 0.002, 0.1, 0.002, 0.0, 1.53, 0.08))
    wide = np.diag([1.0, 0.1**2, 0.1**2])
    mounting = solve_mounting(boxes, np.array([1.65, 0.0, 0.0]), wide, VehicleHeightConfig())
    assert np.sqrt(np.diag(mounting.cov)) == pytest.approx([0.11, 0.006, 0.05], rel=0.4)
    assert (np.abs(mounting.state - truth) < 2.5 * np.sqrt(np.diag(mounting.cov))).all()
    assert solve_mounting(boxes[:16], np.array([1.65, 0.0, 0.0]), wide, VehicleHeightConfig()) is None


@pytest.mark.parametrize("seed", range(4))
def test_vehicles_on_a_slope_do_not_give_a_certain_roll(seed: int) -> None:
    """Those on the right stand 0.04 to 0.1 a metre higher, the farther aside the more; on the left is the road."""
    rng, truth = np.random.default_rng(seed), np.array([1.4, 0.0, 0.0])
    boxes = []
    for vehicle in range(24):
        z, b, tall_m = rng.uniform(8, 40), rng.uniform(-0.5, 0.2), rng.normal(1.53, 0.12)
        ground_m = truth[0] - rng.uniform(0.04, 0.1) * max(-b * z - 3.0, 0.0)
        for _ in range(8):
            bottom = ground_m / z + rng.normal(0, 0.002)
            boxes.append(BoxHeight(vehicle, bottom, 0.002, tall_m / z, 0.002, b, 1.53, 0.08))
    mounting = solve_mounting(boxes, np.array([1.4, 0.0, 0.0]), np.diag([0.4, 0.01, 0.01]), VehicleHeightConfig())
    assert (np.abs(mounting.state - truth) < 2.5 * np.sqrt(np.diag(mounting.cov))).all()


@pytest.mark.parametrize("seed", range(4))
def test_slow_passing_cars_do_not_outweigh_those_ahead(seed: int) -> None:
    """Their boxes err alike: as they pass, the lower edge moves by 0.07 of the bearing, for 15 s at 30 Hz."""
    rng, truth_m = np.random.default_rng(seed), 1.35
    boxes = []
    for vehicle in range(10):
        z, tall_m = rng.uniform(15, 40), rng.normal(1.53, 0.08)
        for _ in range(10):
            bottom = truth_m / z + rng.normal(0, 0.002)
            boxes.append(BoxHeight(vehicle, bottom, 0.002, tall_m / z, 0.002, rng.uniform(-0.1, 0.1), 1.53, 0.08))
    for vehicle in (10, 11):
        for z in np.linspace(5.0, 12.0, 450):
            b = 3.5 / z
            bottom = truth_m / z + 0.07 * (b - 0.5) + rng.normal(0, 0.002)
            boxes.append(BoxHeight(vehicle, bottom, 0.002, 1.53 / z, 0.002, b, 1.53, 0.08))
    mounting = solve_mounting(boxes, np.array([1.5, 0.0, 0.0]), np.diag([0.5, 2e-5, 1e-4]), VehicleHeightConfig())
    assert abs(mounting.state[0] - truth_m) < 1.5 * np.sqrt(mounting.cov[0, 0])
    assert abs(mounting.state[2]) < 0.03


def test_scale_error_does_not_average_out_over_comparisons() -> None:
    """Each knows a combination of length and pitch exactly: at a scale 2 % too long all of them tilt alike."""
    by_pitch, off_log = 5.0, 0.02  # of the log length; and by how much the running scale is off
    exact = np.outer([1.0, by_pitch, 0.0, 0.0], [1.0, by_pitch, 0.0, 0.0]) / 0.005**2
    cov = np.linalg.inv(exact + np.diag([1.0, 1.0, 1.0 / 0.01**2, 1.0 / 0.0001**2]))
    pitch_rad = 0.01 + off_log / by_pitch
    sigmas = []
    for count in (40, 400):
        seen = Observations(fits=[(RoadFit(np.array([0.0, pitch_rad, 0.0, 0.0]), cov, 0.9, 1000), 3.0)] * count)
        road = by_road(seen, CAMERA, CalibrationConfig())
        sigmas.append(math.sqrt(road.cov[0]))
        assert abs(road.pitch_rad - 0.01) < 1.5 * sigmas[-1]
    assert sigmas[1] > 0.9 * sigmas[0]


# --- a drive ---


@functools.cache
def _images(steps: int, step_m: float) -> tuple[np.ndarray, ...]:
    return tuple(render(pose, k) for k, pose in enumerate(street([(step_m, 0.0)] * steps)))


def _drive(images: tuple[np.ndarray, ...]) -> Iterator[tuple[Frame, Ready]]:
    for k, image in enumerate(images):
        yield Frame(k, k * 10**8, k, k, image), Ready(Perception())


def test_a_rendered_drive_gives_the_pitch_and_checks_the_height() -> None:
    images = _images(40, 0.8)
    camera = msgspec.structs.replace(CAMERA, height_m=1.5)  # 1.65 is the truth
    found = calibrate(
        lambda: _drive(images), camera, FrontEndConfig(), CalibrationConfig(),
        {"wheels": lambda start, end, start_ns, end_ns: 0.8 * (end - start)},
    )  # fmt: skip
    sigma = np.sqrt(np.diag(np.reshape(found.cov, (2, 2))))
    assert abs(found.camera.pitch_rad - PITCH_RAD) < 2.5 * sigma[0] < math.radians(0.6)
    assert abs(found.camera.roll_rad) < 2.5 * sigma[1]
    assert found.camera.tilt_sigma_rad == pytest.approx(sigma.max())
    assert {w.cue for w in found.estimates} == {"road", "travel"}
    (check,) = found.height_checks
    assert abs(check.height_m - 1.65) < 2.5 * check.sigma_m < 0.15
    assert abs(check.height_m - 1.5) > 2.0 * check.sigma_m  # the wrong one is found out
    assert found.yaw_rad == pytest.approx(0.0, abs=0.01)


def test_too_short_a_drive_is_refused() -> None:
    images = _images(12, 0.8)
    with pytest.raises(CalibrationError, match="too little motion"):
        calibrate(lambda: _drive(images), CAMERA, FrontEndConfig(), CalibrationConfig())


# --- the command ---


def _said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    status = main(["calibrate", *arguments])
    told = capsys.readouterr()
    return status, told.out + told.err


@pytest.mark.parametrize("fisheye", [False, True])
@given(
    st.floats(700.0, 3000.0),
    st.floats(0.3, 4.0),
    st.floats(-0.3, 0.3),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
)
def test_camera_file_round_trips(
    fisheye: bool, focal_px: float, height_m: float, tilt_rad: float, distortion: list[float]
) -> None:
    camera = Camera(
        1242, 375, focal_px, focal_px, 600.5, 180.25, height_m, tilt_rad, -tilt_rad, tuple(distortion), fisheye=fisheye
    )
    text = camera_text(camera, ("by hand", "pitch +1.0 +- 0.2 deg"))
    assert text.startswith("# by hand\n")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.toml"
        path.write_text(text, encoding="utf-8")
        assert load_camera(path) == camera


@pytest.mark.slow
def test_the_command_on_kitti(data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = data_dir / "kitti_odometry" / "sequences" / "06"
    status, told = _said(capsys, str(sequence), "--output", str(tmp_path / "camera.toml"))
    assert status == 0
    assert "by road: pitch" in told
    assert "by travel: pitch" in told
    assert "by poses: 1.6" in told
    assert "DISAGREES" not in told
    camera = load_camera(tmp_path / "camera.toml")
    assert camera.pitch_rad == pytest.approx(math.radians(1.0), abs=math.radians(0.4))
    assert camera.height_m == 1.65
    assert camera.tilt_sigma_rad < 0.01
    # A wrong height is found out by the poses; without one stated, they give it.
    (tmp_path / "lens.yaml").write_text(
        f"image_width: {camera.width_px}\nimage_height: {camera.height_px}\n"
        f"K: [{camera.fx_px}, 0, {camera.cx_px}, 0, {camera.fy_px}, {camera.cy_px}, 0, 0, 1.0]\n"
    )
    lens = ("--intrinsics", str(tmp_path / "lens.yaml"), "--output", str(tmp_path / "b.toml"), "--stride", "2")
    status, told = _said(capsys, str(sequence), *lens, "--height", "1.9")
    assert status == 0
    assert "height 1.900 m, as stated" in told
    assert "DISAGREES" in told
    status, told = _said(capsys, str(sequence), *lens)
    assert status == 0
    assert load_camera(tmp_path / "b.toml").height_m == pytest.approx(1.65, abs=0.08)


def test_bad_input_is_one_line(data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, out = str(data_dir / "kitti_odometry" / "sequences" / "06"), str(tmp_path / "c.toml")
    (tmp_path / "lens.yaml").write_text(ROS)
    (tmp_path / "speed.csv").write_text("1000, 3\n1001, 4\n")
    (tmp_path / "torn.csv").write_text("0, 3\n1, fast\n")
    for arguments, wanted in (
        (("/nowhere", "--output", out), "no such directory"),
        ((sequence, "--output", out, "--intrinsics", str(tmp_path / "lens.yaml")), "but the given camera is 640x480"),
        ((sequence, "--output", out, "--intrinsics", str(tmp_path / "no.yaml")), "no.yaml: can't be read"),
        ((sequence, "--output", out, "--height", "nan"), "expected 0.2 to 5 m above the road"),
        ((sequence, "--output", out, "--speed", str(tmp_path / "speed.csv")), "are outside the recording's"),
        ((sequence, "--output", out, "--speed", str(tmp_path / "torn.csv")), "torn.csv: line 2 is not a time"),
        ((sequence, "--output", out, "--chessboard", str(tmp_path), "--board", "nine"), "expected COLSxROWS"),
        ((str(data_dir / "kitti_raw_clip"), "--stride", "4", "--output", out), "too little motion"),
    ):
        status, told = _said(capsys, *arguments)
        assert status == 2, arguments
        assert wanted in told
        assert told.startswith("birdslam: ") or "run without" in told
    assert not Path(out).exists()


@pytest.mark.parametrize("text", ["", "0 1\n", "0 1\n0 2\n", "0 1\nnan 2\n", "0 1\n1 -2\n", "0 1 2\n"])
def test_a_bad_speed_file_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "speed.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"speed\.txt"):
        read_speed_curve(tmp_path / "speed.txt")


def check_by_late_speed(lag_s: float, swing_mps: float, true_over_estimated: float, end_s: float = 40.0) -> HeightCheck:
    """40 s at 10 Hz; the readings of a speed of 10 m/s that swings over 9 s are late, have noise, and end."""
    t_s = np.arange(400) * 0.1
    rng = np.random.default_rng(1)

    def way_m(at_s: np.ndarray) -> np.ndarray:
        return 10.0 * at_s - swing_mps * 9.0 / (2.0 * np.pi) * np.cos(2.0 * np.pi * at_s / 9.0)

    read_s = np.arange(-5.0, 50.0, 0.1)
    read_m = (way_m(read_s - lag_s) + rng.normal(0.0, 0.02, len(read_s))).tolist()

    def read_at(at_s: float) -> float:
        share, index = math.modf(10.0 * (at_s + 5.0))  # faster than np.interp
        return read_m[int(index)] + share * (read_m[int(index) + 1] - read_m[int(index)])

    steps = [(k, k + 1, float(np.diff(way_m(t_s[k : k + 2]))[0]) / true_over_estimated) for k in range(399)]

    def known(start: int, end: int, start_ns: int, end_ns: int) -> float | None:
        return None if 1e-9 * end_ns > end_s else read_at(1e-9 * end_ns) - read_at(1e-9 * start_ns)

    times_ns = {k: round(at_s * 1e9) for k, at_s in enumerate(t_s)}
    (check,) = checks_by_length({SPEED: known}, steps, times_ns, CAMERA, HeightCheckConfig())
    return check


@given(st.floats(0.0, 3.8), st.floats(0.8, 1.2))
def test_the_lag_of_a_speed_is_estimated(lag_s: float, true_over_estimated: float) -> None:
    check = check_by_late_speed(lag_s, 4.0, true_over_estimated)
    assert abs(check.lag_s - lag_s) < max(0.2, 3.0 * check.lag_sigma_s)
    assert check.lag_sigma_s < 0.5
    assert check.height_m == pytest.approx(CAMERA.height_m * true_over_estimated, rel=0.01)


@pytest.mark.parametrize("end_s", [2.0, 3.0, 5.0])
def test_a_short_file_of_speeds_still_gives_the_height(end_s: float) -> None:
    """Only lags that the file covers are compared."""
    check = check_by_late_speed(0.0, 0.0, 1.1, end_s)
    assert check.height_m == pytest.approx(CAMERA.height_m * 1.1, rel=0.02)
    assert check.lag_sigma_s > 0.0


def test_a_constant_speed_shows_no_lag() -> None:
    check = check_by_late_speed(2.0, 0.0, 1.1)
    assert check.lag_sigma_s > 0.8
    assert check.height_m == pytest.approx(CAMERA.height_m * 1.1, rel=0.01)


def test_an_earlier_camera_file_keeps_the_sigma_of_its_distortion(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(camera_text(msgspec.structs.replace(CAMERA, distortion_sigma=0.05), ()))
    lens, _ = lens_of(Given(camera=path), "demo", BagTopics())
    assert lens.distortion_sigma == 0.05


def calibrated(height_m: float, said: tuple[HeightCheck, ...], speed_mps: float = 0.0) -> Calibration:
    camera = Camera(1280, 720, 1100.0, 1100.0, 639.5, 359.5, height_m)
    nothing = (1e-4, 0.0, 0.0, 1e-4)
    return Calibration(
        camera=camera, cov=nothing, estimates=(), height_checks=said, yaw_rad=None, path_m=90.0, frames=90,
        speed_mps=speed_mps,
    )  # fmt: skip


def test_a_stated_height_that_cars_contradict_is_kept_with_a_sigma_that_covers_both() -> None:
    cars = HeightCheck(cue="vehicles", height_m=0.95, sigma_m=0.05, samples=12)
    camera, by = with_height(calibrated(1.35, (cars,)), True, None, "video:town.mp4")
    assert camera.height_m == 1.35
    assert camera.scale_sigma_rel == pytest.approx(math.log(1.35 / 0.95))
    assert "12 cars gives 0.95 m" in by.contradicted_by
    rests_on = lengths_by(camera, by, None)
    (told,) = (said for said in verdict(counts(rests_on)) if "contradicted" in said)
    assert "0.95 m" in told
    agreed, by = with_height(
        calibrated(1.35, (msgspec.structs.replace(cars, height_m=1.3),)), True, None, "video:town.mp4"
    )
    assert (agreed.scale_sigma_rel, by.contradicted_by) == (0.0, "")
    assert not any("contradicted" in said for said in verdict(counts(lengths_by(agreed, by, None))))


def test_cars_and_lanes_estimate_the_height_and_disagreement_widens_sigma() -> None:
    cars = HeightCheck(cue="vehicles", height_m=1.2, sigma_m=0.06, samples=12)
    lanes = HeightCheck(cue="lanes", height_m=1.3, sigma_m=0.15, samples=300)
    camera, by = with_height(calibrated(1.5, (cars, lanes)), False, None, "video:town.mp4")
    assert 1.2 < camera.height_m < 1.3
    assert "12 cars and the width of lanes" in by.words
    alone, _ = with_height(calibrated(1.5, (cars,)), False, None, "video:town.mp4")
    assert camera.scale_sigma_rel < alone.scale_sigma_rel
    far = msgspec.structs.replace(lanes, height_m=1.9)
    assert with_height(calibrated(1.5, (cars, far)), False, None, "video:f")[0].scale_sigma_rel > alone.scale_sigma_rel


@pytest.mark.parametrize("height_m", [0.9, 1.35, 2.2])
def test_the_height_by_painted_lanes(height_m: float) -> None:
    rng = np.random.default_rng(3)
    seen = [LaneWidth(1.5 / height_m * rng.normal(3.5, 0.1), 0.4) for _ in range(200)]
    (check,) = checks_by_lanes(seen, 1.5, 0.004)
    assert abs(check.height_m - height_m) < check.sigma_m
    assert 0.1 < check.sigma_m / check.height_m < 0.15
    assert checks_by_lanes(seen[:40], 1.5, 0.004) == []


def test_lane_width_needs_paint_on_both_sides() -> None:
    left, right, kerb = (
        LaneLine(line=k, offset_m=y, slope=0.0, curvature_per_m=0.0, curvature_rate_per_m2=0.0, seen_from_m=5.0,
                 cov=tuple((np.eye(4) * 1e-4).ravel()), seen_to_m=30.0, to_m=40.0, kind=kind)
        for k, y, kind in ((1, 1.9, LineKind.SOLID), (2, -1.6, LineKind.DASHED), (3, -1.6, LineKind.EDGE))
    )  # fmt: skip
    assert painted_width_m(EgoLane().lanes((left, right), 0)) == pytest.approx(3.5)
    assert painted_width_m(EgoLane().lanes((left, kerb), 0)) is None
    assert painted_width_m(EgoLane().lanes((left,), 0)) is None
    assert painted_width_m(None) is None


def counts(rests_on: LengthsBy) -> DriveCounts:
    return DriveCounts(
        frames=90, invalid_frames=0, invalid_by={}, statuses={}, speed_sources={}, path_m=90.0, valid_path_m=90.0,
        scale_sigma_rel=0.3, camera_sigma_rel=0.3, lengths_by=rests_on,
    )  # fmt: skip


@pytest.mark.parametrize("width_m", [2.8, 3.4, 3.9])
def test_a_known_lane_width_sets_the_height(width_m: float) -> None:
    """The height is proportional to the width, and the spread of usual widths no longer widens its sigma."""
    seen = [LaneWidth(3.4, 1.0)] * 60
    (usual,) = checks_by_lanes(seen, 1.5, 0.004)
    (known,) = checks_by_lanes(seen, 1.5, 0.004, width_m)
    assert known.height_m == pytest.approx(1.5 * width_m / 3.4)
    assert known.sigma_m / known.height_m < 0.5 * usual.sigma_m / usual.height_m


@pytest.mark.parametrize("height_m", [1.2, 1.45, 2.9])
def test_a_vehicle_of_known_size_sets_the_height(height_m: float) -> None:
    rng = np.random.default_rng(5)
    camera = Camera(1280, 720, 1100.0, 1100.0, 639.5, 359.5, 1.5)
    boxes = [
        BoxHeight(vehicle, 1.4 / z, 0.002, tall_m / z, 0.002, 0.0, 1.53, 0.08)
        for vehicle, tall_m, frames in ((1, height_m, 60), (2, 1.9, 20), (3, 1.2, 30))
        for z in rng.uniform(8.0, 15.0, frames)
    ]
    (known,) = checks_by_vehicles(boxes, camera, np.diag([0.003, 0.01]) ** 2, VehicleHeightConfig(), height_m)
    assert known.height_m == pytest.approx(1.4, abs=known.sigma_m)
    assert known.sigma_m < 0.14  # from the pitch, the ground below the vehicle and the margin of its boxes
    assert check_sigma_rel(known) == known.sigma_m / known.height_m  # without the spread between countries
    assert checks_by_vehicles(boxes, camera, np.diag([0.003, 0.01]) ** 2, VehicleHeightConfig()) == []


@pytest.mark.parametrize(
    "text",
    ["3.5", "lane", "lane=", "lane=nan", "lane=60", "lane=3x2", "car=4.4x1.8", "car=4.4x1.8x9", "bus=3", "car=x"],
)
def test_unusable_known_length_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="expected lane=METRES"):
        known_length_of(text)


def test_known_lengths_are_of_lanes_or_of_a_vehicle() -> None:
    assert known_length_of("lane=3.5") == KnownSize(lane_m=3.5)
    assert known_length_of("car=4.4x1.8x1.45") == KnownSize(car_height_m=1.45)
    assert known_length_of(None) == KnownSize()


def test_sigma_of_a_film_includes_readout_time() -> None:
    """30 ms made 10.8 m/s of a rendered film with 360 rows, f 554 px, 1.35 m too long by 4.5 %.

    15 ms are taken out where nothing shows it: 2 sigma cover the half that may be left.
    """
    camera = Camera(640, 360, 554.3, 554.3, 319.5, 179.5, 1.35)
    found = msgspec.structs.replace(calibrated(1.35, (), 10.8), camera=camera)
    sigma_rel = with_height(found, True, None, "video:f.mp4", readout=PRIOR)[0].scale_sigma_rel
    assert 0.25 * 0.045 < sigma_rel < 0.5 * 0.045
    assert with_height(found, True, None, "kitti:f")[0].scale_sigma_rel == 0.0
    speed = HeightCheck(cue="speed", height_m=1.3, sigma_m=0.03, samples=9)  # has it in
    by_speed = msgspec.structs.replace(found, height_checks=(speed,))
    assert with_height(by_speed, False, None, "video:f.mp4", readout=PRIOR)[0].scale_sigma_rel < 0.03


def test_a_fisheye_calibration_of_opencvs_sample_is_equidistant(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yml"
    text = (
        "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\nflags: 270\nfisheye_model: 1\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 640., 0., 639.5, 0., 640., 359.5, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n"
        "   data: [ -0.02, 0.005, -0.004, 0.001 ]\n"
    )
    path.write_text(text)
    found = read_intrinsics(path)
    assert found.fisheye
    assert found.distortion == (-0.02, 0.005, -0.004, 0.001)
    path.write_text(text.replace("rows: 4", "rows: 5").replace("0.001 ]", "0.001, 0.1 ]"))
    with pytest.raises(DatasetError, match="4 coefficients, not 5"):
        read_intrinsics(path)
    path.write_text(text.replace("fisheye_model: 1", "fisheye_model: 0"))
    assert not read_intrinsics(path).fisheye
