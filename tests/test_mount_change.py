"""Detection of a knocked or wrongly stated camera mount among variations of roads and cars."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.odometry.road.mount_change import MountChangeConfig, MountChangeDetector

STEP_M = 0.8
CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65, pitch_rad=0.01, tilt_sigma_rad=0.004)


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
    tilts: Floats, camera: Camera = CAMERA, off: Floats | None = None
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
        off = np.random.default_rng([1, seed]).standard_normal(2) * CAMERA.tilt_sigma_rad
        alarms += bool(detect(tilts, off=np.broadcast_to(off, tilts.shape))[1].any())
    assert alarms <= 1


@pytest.mark.parametrize(("axis", "step_deg"), [(0, 1.5), (0, -1.5), (1, 3.5), (1, -3.5)])
def test_knock_is_detected_for_any_mount(axis: int, step_deg: float) -> None:
    """Also one that brings the camera nearer to level than it was."""
    before_m, found = 60.0, []
    for seed in range(20):
        tilts = way(200.0, seed)
        off = np.zeros(tilts.shape)
        off[:, axis] = np.random.default_rng([2, seed]).uniform(-1.0, 1.0) * CAMERA.tilt_sigma_rad
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
    off[:, 0] = sigmas * CAMERA.tilt_sigma_rad
    assert detect(tilts, off=off)[1][-1] == expected


def test_uncertain_camera_file_raises_alarm_late() -> None:
    tilts = way(300.0, 6)
    off = np.full(tilts.shape, 0.02)
    vague = replace(CAMERA, tilt_sigma_rad=0.015)
    assert detect(tilts, off=off)[1][-1]
    assert not detect(tilts, vague, off)[1].any()


def test_pothole_is_not_a_knock() -> None:
    tilts = way(200.0, 7)
    tilts[100:104, 0] += math.radians(3.0)
    tilts[160:163, 0] -= math.radians(4.0)
    assert not detect(tilts)[1].any()


def test_missing_tilt_is_ignored() -> None:
    detector = MountChangeDetector(CAMERA, MountChangeConfig())
    before = detector.mount
    for _ in range(200):
        detector.update(np.array([0.2, 0.2]), STEP_M, False)
    np.testing.assert_array_equal(detector.mount, before)
    assert not detector.has_drifted
