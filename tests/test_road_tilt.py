"""The tilt of the road by lines that meet on the horizon, and a knocked or wrongly stated camera mount."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, plane_normal
from birdslam.geometry.pose import rotation_exp
from birdslam.odometry.road.kalman_filter import RoadFilter
from birdslam.odometry.road.mount_change import MountChangeConfig, MountChangeDetector
from birdslam.odometry.road.vanishing_point import VanishingPointConfig, VanishingPointDetector, fit_vanishing_point
from birdslam.odometry.scale_config import RoadScaleConfig

CAMERA = Camera(640, 192, 371.2, 371.2, 319.5, 90.0, height_m=1.65)
CONFIG = VanishingPointConfig()
NO_BOXES = np.zeros((0, 4))
LANES_M = (-5.4, -1.8, 1.8, 5.4)
PIECES_M = ((5.0, 8.0), (8.0, 12.0), (12.0, 18.0), (18.0, 26.0))


def segments(pitch_rad: float, heading_rad: float, curvature_per_m: float = 0.0) -> Floats:
    """(N, 2, 2) px: pieces of straight lane lines on a road that the camera looks at from above."""
    turn = rotation_exp(np.array([pitch_rad, 0.0, 0.0]))  # nose down
    ends = []
    for x_m in LANES_M:
        for near_m, far_m in PIECES_M:
            for z_m in (near_m, far_m):
                along = np.array([x_m + heading_rad * z_m, CAMERA.height_m - 0.5 * curvature_per_m * z_m**2, z_m])
                ends.append(turn @ along)
    points = np.array(ends)
    return CAMERA.to_px(points[:, :2] / points[:, 2:]).reshape(-1, 2, 2)


@given(pitch_rad=st.floats(-0.05, 0.05), heading_rad=st.floats(-0.04, 0.04), off_rad=st.floats(-0.05, 0.05))
@settings(max_examples=60, deadline=None)
def test_without_noise_the_pitch_is_exact_from_a_wrong_guess(
    pitch_rad: float, heading_rad: float, off_rad: float
) -> None:
    lines = fit_vanishing_point(CAMERA, CONFIG, segments(pitch_rad, heading_rad), pitch_rad + off_rad, 0.0, 0.0)
    normal = plane_normal(pitch_rad, 0.0)[0]
    assert abs(float(normal @ lines.direction)) < 0.1 * lines.sigma_rad
    assert np.linalg.norm(lines.direction) == pytest.approx(1.0)
    assert lines.sigma_rad >= CONFIG.sigma_road_rad


def test_other_directions_have_little_effect() -> None:
    """Of three segments one is no line of the road."""
    off = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        road = segments(0.01, 0.02)
        road = road + rng.normal(0.0, CONFIG.sigma_px, road.shape)
        start = rng.uniform([0.0, 120.0], [639.0, 190.0], (8, 2))
        others = np.stack([start, start + rng.normal(0.0, 25.0, (8, 2))], axis=1)
        lines = fit_vanishing_point(CAMERA, CONFIG, np.concatenate([road, others]), -0.01, 0.0, 0.0)
        if lines is not None:
            off.append(abs(float(plane_normal(0.01, 0.0)[0] @ lines.direction)) / lines.sigma_rad)
    assert len(off) > 40
    assert max(off) < 4.0


@pytest.mark.parametrize("curvature_per_m", [0.0008, -0.0008])
def test_lines_meet_higher_in_a_sag(curvature_per_m: float) -> None:
    lines = fit_vanishing_point(CAMERA, CONFIG, segments(0.01, 0.0, curvature_per_m), 0.01, 0.0, 0.0)
    there = plane_normal(0.01 + curvature_per_m * lines.distance_m, 0.0)[0]
    assert abs(float(there @ lines.direction)) < lines.sigma_rad


def test_too_few_lines_give_no_pitch() -> None:
    every = segments(0.01, 0.0)
    assert fit_vanishing_point(CAMERA, CONFIG, every[:0], 0.01, 0.0, 0.0) is None
    assert fit_vanishing_point(CAMERA, CONFIG, every[:3], 0.01, 0.0, 0.0) is None
    level = np.array([[[100.0, v], [500.0, v]] for v in range(120, 180, 4)])  # across the road
    assert fit_vanishing_point(CAMERA, CONFIG, level, 0.01, 0.0, 0.0) is None


def painted(pitch_rad: float) -> NDArray[np.uint8]:
    """Lines of 15 cm, from 5 to 30 m; drawn eight times as large, since a polygon is filled with its border."""
    size, times = (CAMERA.width_px, CAMERA.height_px), 8
    large = np.full((size[1] * times, size[0] * times), 90, np.uint8)
    turn = rotation_exp(np.array([pitch_rad, 0.0, 0.0]))
    for x_m in LANES_M:
        corners = [(x_m - 0.075, 5.0), (x_m + 0.075, 5.0), (x_m + 0.075, 30.0), (x_m - 0.075, 30.0)]
        points = np.array([turn @ [x, CAMERA.height_m, z] for x, z in corners])
        px = (CAMERA.to_px(points[:, :2] / points[:, 2:]) + 0.5) * times - 0.5
        cv2.fillConvexPoly(large, np.round(px).astype(np.int32), 220)
    return np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), np.uint8)


def test_images_are_used_every_few_metres_of_straight_road() -> None:
    detector, image = VanishingPointDetector(CAMERA, CONFIG), painted(0.02)
    first = detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, 0.5)
    assert abs(float(plane_normal(0.02, 0.0)[0] @ first.direction)) < 2.0 * first.sigma_rad
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, 0.9 * CONFIG.every_m) is None
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 2.0 * CONFIG.max_bend_per_m, CONFIG.every_m) is None
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, 0.0) is not None  # the bend is over


@pytest.mark.parametrize("grey", [np.zeros((192, 640), np.uint8), np.full((192, 640), 255, np.uint8)])
def test_image_without_lines_gives_no_pitch(grey: NDArray[np.uint8]) -> None:
    assert VanishingPointDetector(CAMERA, CONFIG).detect(grey, NO_BOXES, 0.0, 0.0, 0.0, 1.0) is None


def test_rate_drops_without_lines() -> None:
    detector, empty, image = VanishingPointDetector(CAMERA, CONFIG), np.full((192, 640), 90, np.uint8), painted(0.02)
    detector.detect(empty, NO_BOXES, 0.0, 0.0, 0.0, 1.0)
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, CONFIG.every_m) is None
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, CONFIG.every_m) is not None
    assert detector.detect(image, NO_BOXES, 0.0, 0.0, 0.0, CONFIG.every_m) is not None  # as often as before


@given(seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_lines_without_common_point_are_rejected(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform([0.0, 110.0], [639.0, 190.0], (40, 2))
    every = np.stack([start, start + rng.normal(0.0, 25.0, (40, 2))], axis=1)
    assert fit_vanishing_point(CAMERA, CONFIG, every, 0.0, 0.0, 0.0) is None


def test_lines_of_vehicles_do_not_count() -> None:
    whole = np.array([[0.0, 0.0, CAMERA.width_px, CAMERA.height_px]])
    assert VanishingPointDetector(CAMERA, CONFIG).detect(painted(0.02), whole, 0.0, 0.0, 0.0, 1.0) is None


def test_filter_uses_pitch_of_lines_and_rejects_outliers() -> None:
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    lines = fit_vanishing_point(CAMERA, CONFIG, segments(0.02, 0.0), 0.0, 0.0, 0.0)
    assert lines is not None
    before = float(filter_.cov[1, 1])
    assert filter_.update_vanishing_point(lines)
    assert filter_.tilt[0] == pytest.approx(0.02, abs=0.003)
    assert filter_.cov[1, 1] < 0.1 * before
    far = fit_vanishing_point(CAMERA, CONFIG, segments(0.02 + math.radians(3.0), 0.0), 0.05, 0.0, 0.0)
    assert far is not None
    x, cov = filter_.x.copy(), filter_.cov.copy()
    assert not filter_.update_vanishing_point(far)
    np.testing.assert_array_equal(filter_.x, x)
    np.testing.assert_array_equal(filter_.cov, cov)


STEP_M = 0.8
MOUNTED = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65, pitch_rad=0.01, tilt_sigma_rad=0.004)


def way(metres: float, seed: int) -> Floats:
    """(N, 2) tilts off the mount, one every STEP_M: bounces of 3 m, and crown and grade of 30 m."""
    rng, n = np.random.default_rng(seed), round(metres / STEP_M)
    out = np.zeros((n, 2))
    for length_m, sigma in ((3.0, (0.003, 0.004)), (30.0, (0.0035, 0.008))):
        keep, x = math.exp(-STEP_M / length_m), rng.standard_normal(2) * sigma
        for k in range(n):
            x = keep * x + math.sqrt(1.0 - keep**2) * rng.standard_normal(2) * sigma
            out[k] += x
    return out


def detect(
    tilts: Floats, camera: Camera = MOUNTED, off: Floats | None = None
) -> tuple[MountChangeDetector, NDArray[np.bool_]]:
    """Of tilts off the mount, which is `off` (N, 2) the file's."""
    detector, out = MountChangeDetector(camera, MountChangeConfig()), []
    for k, tilt in enumerate(tilts):
        shift = np.zeros(2) if off is None else off[k]
        detector.update(np.array([camera.pitch_rad, camera.roll_rad]) + tilt + shift, STEP_M, True)
        out.append(detector.has_drifted)
    return detector, np.array(out)


@pytest.mark.slow
def test_normal_roads_raise_no_alarm() -> None:
    """40 drives of 1.5 km; the file's error matches its sigma."""
    alarms = 0
    for seed in range(40):
        tilts = way(1500.0, seed)
        off = np.random.default_rng([1, seed]).standard_normal(2) * MOUNTED.tilt_sigma_rad
        alarms += bool(detect(tilts, off=np.broadcast_to(off, tilts.shape))[1].any())
    assert alarms <= 1


@pytest.mark.parametrize(("axis", "step_deg"), [(0, 1.5), (0, -1.5), (1, 3.5), (1, -3.5)])
def test_knock_is_detected_for_any_mount(axis: int, step_deg: float) -> None:
    """Also one that brings the camera nearer to level than it was."""
    before_m, found = 60.0, []
    for seed in range(20):
        tilts = way(200.0, seed)
        off = np.zeros(tilts.shape)
        off[:, axis] = np.random.default_rng([2, seed]).uniform(-1.0, 1.0) * MOUNTED.tilt_sigma_rad
        knocked = round(before_m / STEP_M)
        off[knocked:, axis] += math.radians(step_deg)
        detector, drifted = detect(tilts, off=off)
        assert not drifted[:knocked].any()
        if drifted[-1]:
            found.append((np.flatnonzero(drifted)[0] - knocked) * STEP_M)
            mount, sigma = detector.mount
            assert abs(mount[axis] - off[-1, axis]) < 4.0 * sigma[axis]
    assert len(found) == 20
    assert np.median(found) < 12.0


def test_corrected_knock_is_no_longer_reported() -> None:
    tilts = way(400.0, 3)
    off = np.zeros(tilts.shape)
    off[100:250, 0] = math.radians(2.0)
    _, drifted = detect(tilts, off=off)
    assert drifted[130:250].all()
    assert not drifted[300:].any()


@pytest.mark.parametrize(("sigmas", "expected"), [(1.0, False), (5.0, True), (-5.0, True)])
def test_wrong_camera_file_is_detected(sigmas: float, expected: bool) -> None:
    tilts = way(300.0, 5)
    off = np.zeros(tilts.shape)
    off[:, 0] = sigmas * MOUNTED.tilt_sigma_rad
    assert detect(tilts, off=off)[1][-1] == expected


def test_uncertain_camera_file_raises_alarm_late() -> None:
    tilts = way(300.0, 6)
    off = np.full(tilts.shape, 0.02)
    vague = replace(MOUNTED, tilt_sigma_rad=0.015)
    assert detect(tilts, off=off)[1][-1]
    assert not detect(tilts, vague, off)[1].any()


def test_pothole_is_not_a_knock() -> None:
    tilts = way(200.0, 7)
    tilts[100:104, 0] += math.radians(3.0)
    tilts[160:163, 0] -= math.radians(4.0)
    assert not detect(tilts)[1].any()


def test_missing_tilt_is_ignored() -> None:
    detector = MountChangeDetector(MOUNTED, MountChangeConfig())
    before = detector.mount
    for _ in range(200):
        detector.update(np.array([0.2, 0.2]), STEP_M, False)
    np.testing.assert_array_equal(detector.mount, before)
    assert not detector.has_drifted
