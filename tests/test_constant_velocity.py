"""Where the images show no translation: the speed is held, its sigma grows, and the road's return is used at once."""

from __future__ import annotations

import numpy as np
import pytest

from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.motion import Motion
from birdslam.odometry.speed.constant_velocity import ConstantVelocityConfig, ConstantVelocityPrior, largest_sigma_m
from birdslam.types import INVALIDATING, Status
from tests.test_odometry import CAMERA, drive, street

STEP_M, BEFORE, HIDDEN, AFTER = 0.5, 16, 30, 11  # images at 10 Hz


def _far_alone(image: np.ndarray) -> np.ndarray:
    """What lies some 60 m ahead and more; the rest is black, as at night."""
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


def test_the_speed_is_held_with_a_growing_sigma(blinded: list[Motion]) -> None:
    blind = [m for m in blinded if BEFORE <= m.to_frame < BEFORE + HIDDEN]
    assert not any(m.standstill for m in blind)
    for m in blind:
        sigma_m = float(np.sqrt(m.cov[0, 0])) / (m.to_frame - m.from_frame)
        assert abs(_length_m(m) - STEP_M) < max(3.0 * sigma_m, 0.02)
        assert 0.5 * STEP_M < _length_m(m) < 1.5 * STEP_M
    sigma = [m.scale_sigma_rel for m in blind]
    assert sigma[-1] > 2.0 * sigma[0]
    assert sigma[-1] > 3.0 * blinded[BEFORE - 2].scale_sigma_rel


def test_it_is_told_as_carried_and_then_as_invalid(blinded: list[Motion]) -> None:
    blind = [set(m.status) for m in blinded if BEFORE <= m.to_frame < BEFORE + HIDDEN]
    told = [status & {Status.SCALE_CARRIED, Status.ODOMETRY_COASTING} for status in blind]
    assert all(told)
    invalid = [Status.SCALE_INVALID in status for status in blind]
    assert not any(invalid[:3])
    assert invalid[-1]


def test_the_roads_return_is_used_within_a_second(blinded: list[Motion]) -> None:
    back = blinded[-1]
    assert not INVALIDATING & set(back.status)
    assert Status.SCALE_CARRIED not in back.status
    assert _length_m(back) == pytest.approx(STEP_M, rel=0.05)
    assert abs(_length_m(back) - STEP_M) < 2.0 * float(np.sqrt(back.cov[0, 0]))


START = Pose(rotation_exp(np.array([0.0, 0.3, 0.0])), np.zeros(3))


def _poses(ahead_m: float) -> tuple[Pose, Pose]:
    R = START.R
    return Pose(R, R @ np.array([0.0, 0.0, ahead_m])), Pose(R, R @ np.array([0.0, 0.0, 1.0]))


def test_images_that_show_the_way_are_believed() -> None:
    prior_model = ConstantVelocityPrior(ConstantVelocityConfig())
    prior_model.update(0.01, 0.1)
    measured, predicted = _poses(0.6)  # brakes
    assert prior_model.fuse(START, measured, predicted, np.diag([1e4] * 3 + [1e6] * 3), 0.1) is None


def test_without_a_speed_nothing_is_held() -> None:
    measured, predicted = _poses(0.6)
    assert (
        ConstantVelocityPrior(ConstantVelocityConfig()).fuse(START, measured, predicted, np.zeros((6, 6)), 0.1) is None
    )


def test_a_held_step_is_the_last_one_and_its_sigma_grows_by_what_engines_and_brakes_give() -> None:
    config = ConstantVelocityConfig()
    prior_model = ConstantVelocityPrior(config)
    prior_model.update(0.001, 0.1)
    measured, predicted = _poses(0.2)
    sigmas = []
    for _ in range(9):
        found = prior_model.fuse(START, measured, predicted, np.diag([1e6, 1e6, 0.0, 1e6, 1e6, 1e6]), 0.1)
        assert found is not None
        pose, sigma_m = found
        np.testing.assert_allclose(pose.p, predicted.p, atol=2e-3)
        np.testing.assert_allclose(pose.R, measured.R, atol=1e-6)
        prior_model.update(sigma_m, 0.1)
        sigmas.append(sigma_m)
    np.testing.assert_allclose(sigmas, 0.01 * config.acceleration_mps2 * np.sqrt(np.arange(1, 10)), rtol=0.02)


def test_the_worst_sigma_is_that_of_the_direction_known_worst() -> None:
    turn = np.kron(np.eye(2), rotation_exp(np.array([0.2, -0.5, 0.1])))
    info = turn @ np.diag([1e4, 25.0, 1e4, 1e6, 1e6, 1e6]) @ turn.T
    assert largest_sigma_m(info) == pytest.approx(0.2)


def test_a_car_that_drives_off_at_33_hz_is_not_held_back() -> None:
    """A standing car's speed changes by less within 30 ms than corners show; they are believed all the same."""
    prior_model = ConstantVelocityPrior(ConstantVelocityConfig())
    prior_model.update(0.0, 1.0)
    moved = Pose(START.R, START.R @ np.array([0.0, 0.0, 0.02]))
    assert prior_model.fuse(START, moved, START, np.diag([1e4] * 3 + [1e6] * 3), 0.03) is None
