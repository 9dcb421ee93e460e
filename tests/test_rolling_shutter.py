"""Rolling shutter: compensated in features and road comparisons, and estimated from a drive."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.calibration.lens_windows import CornersOfImage
from birdslam.calibration.readout import PRIOR, readout_of_drive
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.geometry.rolling_shutter import RollingShutter
from birdslam.odometry.motion import uneven_cov
from birdslam.odometry.road.alignment import RoadAlignConfig, RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.sources.camera_file import camera_text, load_camera
from birdslam.sources.recording import DatasetError

CAMERA = Camera(640, 360, 520.0, 520.0, 319.5, 179.5, height_m=1.35, readout_s=0.03)
FILMS = Path(__file__).parent / "dashcams"
NO_BOXES = np.zeros((0, 4))
SPEED_MPS = 20.0


def test_points_are_moved_to_the_time_of_the_middle_row() -> None:
    """A camera that drives straight on and turns; points at known places, seen by each of its rows in turn."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-5, 5, 50), rng.uniform(-2, 1.3, 50), rng.uniform(6, 40, 50)])
    rate = np.array([0.3, 0.0, SPEED_MPS]), np.array([0.0, 0.2, 0.0])
    shutter, middle = RollingShutter(CAMERA), places[:, :2] / places[:, 2:]
    read, depth = middle.copy(), places[:, 2]
    for _ in range(20):  # which row a point is read in follows from where it is then
        late_s = 0.03 * ((read[:, 1] * 520.0 + 180.0) / 360.0 - 0.5)
        q = np.array([cv2.Rodrigues(-rate[1] * t)[0] @ (X - rate[0] * t) for X, t in zip(places, late_s, strict=True)])
        read, depth = q[:, :2] / q[:, 2:], q[:, 2]
    moved_px = 520.0 * np.abs(read - middle).max()
    assert moved_px > 3.0
    assert np.abs(520.0 * (shutter.at_middle(read, 1.0 / depth, rate) - middle)).max() < 0.02 * moved_px
    assert np.abs(520.0 * (shutter.as_read(middle, 1.0 / places[:, 2], rate) - read)).max() < 0.02 * moved_px


@pytest.mark.parametrize("fisheye", [False, True])
def test_rows_are_those_of_the_raw_image(fisheye: bool) -> None:
    lens = (-0.05, 0.0, 0.0, 0.0) if fisheye else (-0.25, 0.05, 0.0, 0.0)
    camera = msgspec.structs.replace(CAMERA, distortion=lens, fisheye=fisheye)
    u, v = np.array([40.0, 319.5, 600.0, 320.0]), np.array([340.0, 179.5, 20.0, 350.0])
    rows = RollingShutter(camera).row(u, v)
    xy = camera.to_xy(np.column_stack([u, v]))
    if fisheye:
        seen = cv2.fisheye.distortPoints(xy[:, None], camera.K, np.array(lens))
    else:
        rays = np.column_stack([xy, np.ones(4)])
        seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, np.array(lens))[0]
    assert rows == pytest.approx((seen.reshape(-1, 2)[:, 1] + 0.5) / 360 - 0.5, abs=0.012)
    assert abs(rows[0] - ((340.5) / 360 - 0.5)) > 0.02  # the lens bends that one


@functools.cache
def road_read_in_turn(way_m: float, readout_s: float) -> np.ndarray:
    """The image of a level road with blotches, each of whose rows is seen from where the camera is then."""
    v, u = np.mgrid[:360, :640].astype(np.float64)
    below = (v - CAMERA.cy_px) / CAMERA.fy_px
    depth_m = np.where(below > 0.01, CAMERA.height_m / np.maximum(below, 0.01), np.inf)
    along = way_m + SPEED_MPS * readout_s * ((v + 0.5) / 360 - 0.5) + depth_m
    across = (u - CAMERA.cx_px) / CAMERA.fx_px * depth_m
    grey = np.full(u.shape, 128.0)
    near = depth_m < 60.0
    for k, (by_along, by_across, phase) in enumerate(np.random.default_rng(4).uniform(-6.0, 6.0, (40, 3))):
        wave = np.sin(by_along * along[near] + by_across * across[near] + phase)
        grey[near] += (8.0 + 0.1 * k) * wave / math.sqrt(10.0)
    return np.clip(grey, 0, 255).astype(np.uint8)


def test_road_comparison_includes_readout_time() -> None:
    """At 20 m/s and 25 Hz, 30 ms make the road's motion some 3 % too long."""
    at_once, plain, in_turn = (
        compared(readout_s, share) for readout_s, share in ((0.0, 0.0), (0.03, 0.0), (0.03, 0.75))
    )
    assert plain - at_once > 0.025
    assert abs(in_turn - at_once) < 0.2 * (plain - at_once)


def compared(readout_s: float, share: float) -> float:
    """The log of the length over the true one of two images 0.8 m apart."""
    aligner = RoadAligner(CAMERA, RoadAlignConfig())
    past, present = (aligner.image(road_read_in_turn(way_m, readout_s)) for way_m in (0.0, 0.8))
    px = aligner.samples((0.0, 0.0), NO_BOXES, None)
    T = Pose(np.eye(3), np.array([0.0, 0.0, 0.8]))
    prior = np.diag(np.square([0.2, 0.03, 0.01, 0.003]))
    fit = aligner.align(past, present, T, px, np.zeros(4), prior, (0.0, 0.0), share)
    assert fit is not None
    return length_of(fit)


def length_of(fit: RoadFit) -> float:
    """The log of the length, where tilt and curvature are known to be none."""
    return float(fit.state[0] - fit.cov[0, 1:] @ np.linalg.solve(fit.cov[1:, 1:], fit.state[1:]))


def corners(readout_s: float, images: int, seed: int, rate_hz: float = 20.0) -> list[CornersOfImage]:
    """Corners of a road and of facades beside it, by a camera that drives at 20 m/s and whose rows are read in turn."""
    rng = np.random.default_rng(seed)
    n = 40 * images
    side = rng.choice([-1.0, 1.0], n)
    walls = np.column_stack([side * rng.uniform(4, 15, n), rng.uniform(-6, 1.3, n), rng.uniform(3, images + 60, n)])
    road = np.column_stack([rng.uniform(-4, 4, n), np.full(n, 1.35), rng.uniform(3, images + 60, n)])
    places, out = np.vstack([walls, road]), []
    for k in range(images):
        late_s = np.zeros(len(places))
        for _ in range(20):
            q = places - np.outer(k / rate_hz + late_s, [0.0, 0.0, SPEED_MPS])
            ahead = (q[:, 2] > 2.0) & (q[:, 2] < 60.0)
            px = 520.0 * q[:, :2] / np.where(ahead, q[:, 2], 1.0)[:, None] + [319.5, 179.5]
            late_s = readout_s * (np.clip(px[:, 1] + 0.5, 0, 360) / 360 - 0.5)
        seen = ahead & (px > 5.0).all(axis=1) & (px < [634.0, 354.0]).all(axis=1)
        ids = np.flatnonzero(seen)
        out.append(CornersOfImage(ids, px[ids] + rng.normal(0.0, 0.15, (len(ids), 2)), k / rate_hz))
    return out


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_drive_determines_readout_time(readout_s: float) -> None:
    found = readout_of_drive(corners(readout_s, 40, 1), CAMERA)
    by_drive, sigma_s = found.by_drive
    assert sigma_s < 0.006
    assert abs(by_drive - readout_s) < 2.0 * sigma_s
    assert found.sigma_s < min(sigma_s, PRIOR.sigma_s)


def test_prior_readout_time_holds_without_information() -> None:
    standing = [CornersOfImage(each.ids, each.px, 0.05 * k) for k, each in enumerate(corners(0.02, 1, 1) * 30)]
    assert readout_of_drive(standing, CAMERA) == PRIOR
    assert readout_of_drive([], CAMERA) == PRIOR


def test_camera_file_states_readout_time(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(camera_text(CAMERA, ()))
    assert load_camera(path) == CAMERA
    path.write_text(camera_text(CAMERA, ()).replace("readout_s = 0.03", "readout_s = 30"))
    with pytest.raises(DatasetError, match="readout_s"):
        load_camera(path)


def test_changing_turn_rate_grows_the_sigma() -> None:
    """A firm mount's sigma is as it was; one that swings by half a degree at 10 Hz turns otherwise in each image."""
    cov6 = np.diag([1e-4] * 3 + [1e-7] * 3)
    swings_radps = np.array([0.5, 0.0, 0.2])
    np.testing.assert_array_equal(uneven_cov(cov6, 0.0, swings_radps), cov6)
    np.testing.assert_array_equal(uneven_cov(cov6, 0.03, np.zeros(3)), cov6)
    wider = uneven_cov(cov6, 0.03, swings_radps)
    np.testing.assert_array_equal(wider[:3, :3], cov6[:3, :3])
    assert (np.sqrt(np.diag(wider)[3:]) > 1e-3).all()
