"""The posterior of an unknown metric scale: evidence adds up, and no single measurement decides."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.scale_likelihood import landmark_log_likelihood
from birdslam.odometry.road.scale_posterior import P_WRONG, ScalePosterior

CAMERA = Camera(1242, 375, 720.0, 720.0, 620.0, 180.0, height_m=1.65)


def _measure(posterior: ScalePosterior, log_scale: float, times: int = 1, gain: float = 20.0) -> None:
    """Images of the road whose best match is at this scale."""
    for _ in range(times):
        posterior.update(gain * np.exp(-0.5 * np.square((posterior.log_factors - log_scale) / 0.05)))


def test_one_image_does_not_find_a_scale_and_agreeing_ones_do() -> None:
    posterior = ScalePosterior()
    _measure(posterior, 1.2)
    assert posterior.mode().log == pytest.approx(1.2, abs=0.05)
    assert posterior.mode().probability < 1.0 - P_WRONG
    _measure(posterior, 1.2, 2)
    assert posterior.mode().probability > 1.0 - P_WRONG
    assert posterior.mode().log == pytest.approx(1.2, abs=0.05)


@pytest.mark.parametrize("wrong", [-1.5, 0.9])
def test_an_outlier_among_images_that_agree_is_ignored(wrong: float) -> None:
    posterior = ScalePosterior()
    _measure(posterior, 0.0, 2)
    _measure(posterior, wrong, gain=50.0)
    _measure(posterior, 0.0)
    assert posterior.mode().log == pytest.approx(0.0, abs=0.05)


def test_a_known_scale_yields_to_more_evidence_than_an_unknown_one() -> None:
    known, unknown = ScalePosterior(), ScalePosterior()
    known.reset(0.05)
    counts = []
    for posterior in (known, unknown):
        count = 0
        while abs(posterior.mode().log - 0.9) > 0.1:
            _measure(posterior, 0.9)
            count += 1
        counts.append(count)
    assert counts[0] > counts[1] == 1


def test_repeated_images_of_the_same_road_add_nothing() -> None:
    posterior = ScalePosterior()
    before = posterior.mode()
    posterior.update(np.random.default_rng(1).normal(size=len(posterior.log_factors)), independence=0.0)
    assert posterior.mode() == before


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_posterior_follows_a_rescaled_window(log_scale: float, log_factor: float) -> None:
    posterior = ScalePosterior()
    _measure(posterior, log_scale, 3)
    posterior.rescale(log_factor)
    _measure(posterior, log_scale - log_factor)
    mode = posterior.mode()
    assert mode.log == pytest.approx(log_scale - log_factor, abs=0.05)
    assert mode.probability > 1.0 - P_WRONG


@given(st.lists(st.tuples(st.floats(-4.0, 4.0), st.floats(0.0, 200.0), st.floats(0.0, 0.1)), max_size=30))
def test_any_measurements_leave_probabilities(measurements: list[tuple[float, float, float]]) -> None:
    posterior = ScalePosterior()
    for log_scale, gain, var_log in measurements:
        _measure(posterior, log_scale, gain=gain)
        posterior.diffuse(var_log)
        for mode in (posterior.mode(), posterior.at_present()):
            assert 0.0 <= mode.probability <= 1.0 + 1e-9
            assert math.isfinite(mode.log)
            assert mode.sigma_log > 0.0
    assert posterior.plausible(1e-6).any()


def test_landmarks_below_the_road_bound_the_scale() -> None:
    """The window is at half its true scale; landmarks lie on the road and above it."""
    rng, log_factors = np.random.default_rng(3), np.linspace(-2.0, 2.0, 81)
    z, x = rng.uniform(5.0, 25.0, 60), rng.uniform(-4.0, 4.0, 60)
    height_m = np.where(np.arange(60) < 20, 0.0, rng.uniform(0.0, 1.2, 60))
    at = np.column_stack([x, CAMERA.height_m - height_m, z]) / 2.0
    window = SlidingWindow(720.0, 0.35, 2.0)
    ids = np.arange(60)
    window.append(0, Pose(np.eye(3), np.zeros(3)), ids, at[:, :2] / at[:, 2:])
    window.rho, window.rho_sigma = 1.0 / at[:, 2], 0.02 / at[:, 2]
    found = landmark_log_likelihood(CAMERA, (0.0, 0.0), window, log_factors, 1.0)
    assert found is not None
    assert log_factors[found.argmax()] == pytest.approx(math.log(2.0), abs=0.1)
    assert found[log_factors > math.log(2.0) + 0.5].max() < found.max() - 10.0
    few = SlidingWindow(720.0, 0.35, 2.0)
    few.append(0, Pose(np.eye(3), np.zeros(3)), ids[:3], at[:3, :2] / at[:3, 2:])
    assert landmark_log_likelihood(CAMERA, (0.0, 0.0), few, log_factors, 1.0) is None
