"""The velocity prior: without observable translation the speed is held with a growing sigma."""

from __future__ import annotations

import numpy as np
import pytest

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.geometry.se2 import SE2
from birdslam.odometry.motion import Motion
from birdslam.odometry.speed.constant_velocity import ConstantVelocityConfig, ConstantVelocityPrior, largest_sigma_m
from birdslam.types import INVALIDATING, Status
from tests.test_odometry import CAMERA, drive, street

STEP_M, BEFORE, HIDDEN, AFTER = 0.5, 16, 30, 11  # images at 10 Hz


def _far_alone(image: np.ndarray) -> np.ndarray:
    """Shows only the scene beyond about 60 m; the rest is black, as at night."""
    out, (u, v) = np.full_like(image, 40), (int(CAMERA.cx_px), int(CAMERA.cy_px))
    far = slice(0, v + 4), slice(u - 36, u + 36)
    out[far] = image[far]
    return out


@pytest.fixture(scope="module")
def blinded() -> list[Motion]:
    """A drive of 5 m/s, which for 3 s sees the far end of its street and nothing else."""
    hidden = range(BEFORE, BEFORE + HIDDEN)
    poses = street([(STEP_M, 0.0)] * (BEFORE + HIDDEN + AFTER - 1))
    return drive(poses, edit=lambda k, image: _far_alone(image) if k in hidden else image)[1]


def _length_m(motion: Motion) -> float:
    return float(np.linalg.norm(motion.t_prev_curr_m)) / (motion.to_frame - motion.from_frame)


def test_speed_is_held_with_growing_sigma(blinded: list[Motion]) -> None:
    blind = [m for m in blinded if BEFORE <= m.to_frame < BEFORE + HIDDEN]
    assert not any(m.standstill for m in blind)
    for m in blind:
        sigma_m = float(np.sqrt(m.cov[0, 0])) / (m.to_frame - m.from_frame)
        assert abs(_length_m(m) - STEP_M) < max(3.0 * sigma_m, 0.02)
        assert 0.5 * STEP_M < _length_m(m) < 1.5 * STEP_M
    sigma = [m.scale_sigma_rel for m in blind]
    assert sigma[-1] > 2.0 * sigma[0]
    assert sigma[-1] > 3.0 * blinded[BEFORE - 2].scale_sigma_rel


def test_scale_is_reported_as_carried_then_invalid(blinded: list[Motion]) -> None:
    blind = [set(m.status) for m in blinded if BEFORE <= m.to_frame < BEFORE + HIDDEN]
    told = [status & {Status.SCALE_CARRIED, Status.ODOMETRY_COASTING} for status in blind]
    assert all(told)
    invalid = [Status.SCALE_INVALID in status for status in blind]
    assert not any(invalid[:3])
    assert invalid[-1]


def test_visible_road_is_used_again_within_a_second(blinded: list[Motion]) -> None:
    back = blinded[-1]
    assert not INVALIDATING & set(back.status)
    assert Status.SCALE_CARRIED not in back.status
    assert _length_m(back) == pytest.approx(STEP_M, rel=0.05)
    assert abs(_length_m(back) - STEP_M) < 2.0 * float(np.sqrt(back.cov[0, 0]))


START = Pose(rotation_exp(np.array([0.0, 0.3, 0.0])), np.zeros(3))
LEVEL = GroundPlane(1.5, 0.0, 0.0)
CLEAR = np.diag([1e6] * 6)  # information of a pose that images show well
NO_LENGTH = np.diag([1e6, 1e6, 0.0, 1e6, 1e6, 1e6])


def _ahead(ahead_m: float, right_m: float = 0.0, down_m: float = 0.0) -> Pose:
    return START @ Pose(np.eye(3), np.array([right_m, down_m, ahead_m]))


def _driven(steps: int = 1, step_m: float = 1.0) -> ConstantVelocityPrior:
    """The prior of a car that has driven 10 m/s, in images that show it."""
    prior = ConstantVelocityPrior(ConstantVelocityConfig())
    for _ in range(steps):
        assert prior.fuse(START, _ahead(step_m), CLEAR, 0.1, LEVEL) is None
        prior.update(SE2(step_m, 0.0, 0.0), 0.1)
    return prior


def test_images_with_observable_translation_override_prior() -> None:
    braking = _ahead(0.6)
    assert _driven().fuse(START, braking, np.diag([1e4] * 3 + [1e6] * 3), 0.1, LEVEL) is None


def test_without_speed_there_is_no_prior() -> None:
    prior = ConstantVelocityPrior(ConstantVelocityConfig())
    assert prior.fuse(START, _ahead(0.6), np.zeros((6, 6)), 0.1, LEVEL) is None


def _held(prior: ConstantVelocityPrior, measured: Pose, info: np.ndarray, steps: int) -> list[tuple[Pose, float]]:
    """The steps from START, each fused with the same one by the images."""
    out = []
    for _ in range(steps):
        found = prior.fuse(START, measured, info, 0.1, LEVEL)
        prior.update(SE2(float((START.R.T @ found[0].p)[2]), 0.0, 0.0), 0.1)
        out.append(found)
    return out


def test_held_step_is_the_last_one_with_sigma_from_max_acceleration() -> None:
    """Whoever brakes goes on braking: the speed's sigma grows with the time, at any rate of images."""
    config = ConstantVelocityConfig()
    held = _held(_driven(), _ahead(0.2), NO_LENGTH, 20)
    for pose, _ in held:
        np.testing.assert_allclose(pose.p, _ahead(1.0).p, atol=1e-2)
        np.testing.assert_allclose(pose.R, START.R, atol=1e-6)
    t_s, memory_s = 0.1 * np.arange(1, 21), config.acceleration_memory_s
    lasting = np.sqrt(2.0 * memory_s**2 * (t_s / memory_s - 1.0 + np.exp(-t_s / memory_s)))
    np.testing.assert_allclose([s for _, s in held], 0.1 * config.acceleration_mps2 * lasting, rtol=0.06)


def test_braking_with_weak_images_stays_within_sigma() -> None:
    """The images give steps to 0.2 m; the car brakes at 4 m/s^2."""
    prior, step_m = _driven(10), 1.0
    rng = np.random.default_rng(1)
    for k in range(20):
        step_m -= 0.01 * min(k + 1, 4)  # the brakes take 0.4 s
        seen = _ahead(step_m + float(rng.normal(0.0, 0.2)))
        found = prior.fuse(START, seen, np.diag([25.0] * 3 + [1e8] * 3), 0.1, LEVEL)
        assert found is not None, k
        got_m = float((START.R.T @ found[0].p)[2])
        prior.update(SE2(got_m, 0.0, 0.0), 0.1)
        assert abs(got_m - step_m) < 2.5 * found[1]


def test_held_step_follows_the_road_direction() -> None:
    """Corners that are few point anywhere. A direction taken from the step before would wander off with them."""
    aside = _ahead(1.0, right_m=0.1, down_m=0.1)
    pose, _ = _held(_driven(), aside, np.diag([100.0, 100.0, 1.0, 1e8, 1e8, 1e8]), 20)[-1]
    right, down, ahead = START.R.T @ pose.p
    assert abs(right) < 0.01 * ahead
    assert abs(down) < 0.01 * ahead


def test_yawed_camera_keeps_its_direction_of_travel() -> None:
    prior, way = ConstantVelocityPrior(ConstantVelocityConfig()), _ahead(1.0, right_m=-0.03)
    for _ in range(60):
        assert prior.fuse(START, way, CLEAR, 0.1, LEVEL) is None
        prior.update(SE2(1.0, 0.03, 0.0), 0.1)
    pose, _ = _held(prior, _ahead(1.0), np.diag([100.0, 100.0, 1.0, 1e8, 1e8, 1e8]), 1)[0]
    assert (START.R.T @ pose.p)[0] == pytest.approx(-0.03, abs=0.005)


def test_worst_sigma_is_that_of_the_least_certain_direction() -> None:
    turn = np.kron(np.eye(2), rotation_exp(np.array([0.2, -0.5, 0.1])))
    info = turn @ np.diag([1e4, 25.0, 1e4, 1e6, 1e6, 1e6]) @ turn.T
    assert largest_sigma_m(info) == pytest.approx(0.2)


def test_starting_car_at_33_hz_is_not_held_back() -> None:
    """A standing car's speed changes by less within 30 ms than corners show; they are believed all the same."""
    prior = _driven()
    prior.stop()
    assert prior.fuse(START, _ahead(0.02), np.diag([1e4] * 3 + [1e6] * 3), 0.03, LEVEL) is None
