"""NEES of 10 m of motion, and the quality of the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.bench.ego import truth_quality
from birdslam.bench.ego.motion_consistency import MotionConsistency, Motions, Nees
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import ego_pose, inverse, mount_pose
from birdslam.types import Attitude, Measurements, Status
from tests.records import step_at

MOUNT = GroundPlane(height_m=1.6, pitch_rad=0.05, roll_rad=-0.02)
COV = np.array([[4e-4, 1e-5, 0.0], [1e-5, 1e-4, 2e-6], [0.0, 2e-6, 1e-6]])


def drive(steps: list[SE2]) -> NDArray[np.float64]:
    """`T_first_i` of the camera that rides on the ego."""
    poses = [SE2()]
    for step in steps:
        poses.append(poses[-1] @ step)
    cameras = np.array([ego_pose(pose, Attitude()) @ mount_pose(MOUNT) for pose in poses])
    out: NDArray[np.float64] = inverse(cameras[0]) @ cameras
    return out


def town(frames: int, rng: np.random.Generator) -> list[SE2]:
    """Steps of a car that speeds up, brakes and steers."""
    at = np.arange(frames)
    speed, turn = 0.9 + 0.3 * np.sin(at / 15.0), 0.03 * np.sin(at / 9.0)
    return [SE2(x, 0.0, yaw + 2e-4 * rng.standard_normal()) for x, yaw in zip(speed, turn, strict=True)]


def measurements(frame: int, step: SE2 | None, cov: NDArray[np.float64], **fields: object) -> Measurements:
    return step_at(frame, step, cov=tuple(cov.ravel().tolist()), **fields)


def told(steps: list[SE2], cov: NDArray[np.float64]) -> Motions:
    motions = Motions(MOUNT)
    for frame, step in enumerate([None, *steps]):
        motions.add(measurements(frame, step, cov))
    return motions


def judged(motions: Motions, truth: NDArray[np.float64]) -> MotionConsistency:
    report = motions.report(truth)
    assert report is not None
    return report


@given(factor=st.floats(0.3, 3.0), seed=st.integers(0, 2**16))
@settings(max_examples=3)
def test_consistent_covariance_has_nees_one_per_frame_and_stretch(factor: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, L = town(200, rng), np.linalg.cholesky(COV)
    erring = [step @ SE2.exp(L @ rng.standard_normal(3)) for step in true]
    report = judged(told(erring, factor**2 * COV), drive(true))
    for nees in (report.frame, report.stretch):
        assert nees.n > 50
        assert 0.2 / factor**2 < nees.mean < 1.5 / factor**2  # less than 1, by the noise of the axes of the truth
        assert 0.1 / factor**2 < nees.median < 1.5 / factor**2


def test_noise_of_the_truth_is_estimated() -> None:
    rng = np.random.default_rng(5)
    true, sigma = town(400, rng), np.array([0.03, 0.01, 1e-3])
    noisy = [step @ SE2.exp(sigma * rng.standard_normal(3)) for step in true]
    np.testing.assert_allclose(truth_quality.step_noise(drive(noisy), MOUNT), sigma, rtol=0.2)


def test_stretches_of_an_interpolated_truth_are_left_out() -> None:
    rng = np.random.default_rng(6)
    true = town(120, rng)
    poses = drive([SE2(0.8, 0.0, 0.002)] * 12 + true[12:])
    assert np.flatnonzero(truth_quality.interpolated(poses)).tolist() == list(range(1, 13))
    some, all_of_them = judged(told(true, COV), poses), judged(told(true, COV), drive(true))
    assert some.stretch.n < all_of_them.stretch.n
    assert some.frame.n == all_of_them.frame.n - 12
    assert some.stretch.mean == pytest.approx(0.0, abs=0.1)


def test_implausible_true_step_is_found_at_both_ends() -> None:
    steps = [SE2(1.0, 0.0, 0.0)] * 10
    steps[4] = SE2(1.2, 0.0, 0.0)  # 20 m/s^2
    t_ns = np.arange(11) * 100_000_000
    assert np.flatnonzero(truth_quality.implausible(drive(steps), t_ns)).tolist() == [4, 5, 6]
    assert truth_quality.doubtful(drive(steps), t_ns)[[4, 5, 6]].all()
    steps[4] = SE2(1.1, 0.0, 0.0)
    assert not truth_quality.implausible(drive(steps), t_ns).any()


def test_only_valid_measured_motions_of_a_moving_car_are_judged() -> None:
    steps = town(8, np.random.default_rng(1))
    motions = Motions(MOUNT)
    status = {3: Status.SCALE_INVALID, 4: Status.ODOMETRY_COASTING, 5: Status.STANDSTILL}
    for frame, step in enumerate([None, *steps]):
        off = step if step is None or frame not in status else SE2(9.0, 0.0, 0.0)
        motions.add(measurements(frame, off, COV, status=(status[frame],) if frame in status else ()))
    motions.add(measurements(9, SE2(9.0, 0.0, 0.0), COV, status=(Status.END_OF_SOURCE,)))
    report = judged(motions, drive(steps))
    assert report.frame.n == 5
    assert report.frame.mean == pytest.approx(0.0, abs=1e-9)
    assert report.stretch == Nees(n=0)


def test_without_measurements_there_are_no_results() -> None:
    assert Motions(MOUNT).report(drive([SE2(1.0, 0.0, 0.0)])) is None
