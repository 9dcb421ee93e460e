"""The road comparison's covariance: noise in the gradients neither biases nor sharpens it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.odometry.road.fit import MOTION, ROAD, Gradients, fit_without_prior, shared_gradient

N = 1200
STATES = ROAD + MOTION + 2
TRUE = np.array([0.05, 0.01, -0.01, 0.0])
SCALES = np.array([6.0, 15.0, 15.0, 400.0] + [20.0] * MOTION)  # by how much each moves a residual


def pixels(rng: np.random.Generator) -> NDArray[np.int64]:
    return np.column_stack([rng.integers(0, 640, N), rng.integers(90, 190, N)])


def images(
    rng: np.random.Generator, noise: NDArray[np.float64], sigma: float
) -> tuple[NDArray[np.int64], Gradients, Gradients, Floats]:
    """Samples of a road that lies by TRUE elsewhere than at the state 0: both images' slopes, and the residual.

    `noise` (N,) is that of either image's slopes where what they share has 1.
    """
    px, shared = pixels(rng), rng.normal(size=(2, N))
    geometry = rng.normal(size=(ROAD + MOTION, N)), rng.normal(size=(ROAD + MOTION, N))

    def seen(slopes: Floats) -> Gradients:
        by_state = SCALES[:, None] * (geometry[0] * slopes[0] + geometry[1] * slopes[1])
        return Gradients(slopes[0], slopes[1], np.concatenate([by_state, np.ones((2, N)) * [[-1.0], [-90.0]]]))

    road = seen(shared)
    residual = -(TRUE @ road.derivative[:ROAD]) + rng.normal(0.0, sigma, N)
    past, present = (seen(shared + noise * rng.normal(size=(2, N))) for _ in range(2))
    return px, past, present, residual


def fitted(seed: int, noise: NDArray[np.float64], sigma: float = 0.2) -> tuple[Floats, Floats]:
    px, past, present, residual = images(np.random.default_rng(seed), noise, sigma)
    weights = np.full(N, sigma**-2.0)
    return fit_without_prior(np.zeros(ROAD + MOTION), px, past, present, residual, weights, np.eye(MOTION) * 1e8)


@given(seed=st.integers(0, 500))
@settings(max_examples=30, deadline=None)
def test_common_gradients_give_least_squares(seed: int) -> None:
    px, past, _, residual = images(np.random.default_rng(seed), np.zeros(N), 0.2)
    state, cov = fit_without_prior(
        np.zeros(ROAD + MOTION), px, past, past, residual, np.full(N, 25.0), np.eye(MOTION) * 1e8
    )
    J = past.derivative[[*range(ROAD), -1]].T
    J[:, -1] = 1.0
    expected = np.linalg.lstsq(J, -residual, rcond=None)[0][:ROAD]
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(state, expected, atol=0.3 * float(sigma.max()), rtol=0.0)
    np.testing.assert_allclose(cov, 0.04 * np.linalg.inv(J.T @ J)[:ROAD, :ROAD], atol=0.1 * sigma.max() ** 2)


def test_gradient_noise_does_not_bias_towards_the_guess() -> None:
    """Least squares by noisy slopes finds half of it; with as many noisy pixels as good ones nothing is lost."""
    everywhere = np.array([fitted(seed, np.ones(N))[0] for seed in range(30)])
    assert np.mean(everywhere[:, 0]) == pytest.approx(TRUE[0], rel=0.1)
    _, past, _, residual = images(np.random.default_rng(0), np.ones(N), 0.2)
    J = past.derivative[:ROAD].T
    assert np.linalg.lstsq(J, -residual, rcond=None)[0][0] < 0.7 * TRUE[0]


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_fit_is_consistent_with_its_sigma(noise: float) -> None:
    """Its error over its sigma, squared, in the mean over drives; the slopes' own noise makes the residual's larger."""
    ratios = []
    for seed in range(60):
        state, cov = fitted(seed, np.full(N, noise), sigma=1.0)
        ratios.append(float((state - TRUE) @ np.linalg.solve(cov, state - TRUE)) / ROAD)
    assert 0.4 < np.mean(ratios) < 2.0


def test_texture_in_only_one_image_has_no_weight() -> None:
    rng = np.random.default_rng(1)
    px, past, _, residual = images(rng, np.zeros(N), 0.2)
    _, other, _, _ = images(rng, np.zeros(N), 0.2)
    np.testing.assert_allclose(shared_gradient(px, past, past), 1.0)
    assert np.mean(shared_gradient(px, past, other)) < 0.2
    weights, motion_info = np.full(N, 25.0), np.eye(MOTION) * 1e8
    sure, vague = (
        fit_without_prior(np.zeros(ROAD + MOTION), px, past, present, residual, weights, motion_info)[1]
        for present in (past, other)
    )
    assert (np.diag(vague) > 9.0 * np.diag(sure)).all()


def test_paint_counts_without_texture() -> None:
    """Pixels on the left have slopes that both images share, those on the right have noise alone."""
    px, past, present, _ = images(np.random.default_rng(2), np.zeros(N), 0.2)
    right = px[:, 0] >= 320
    rng = np.random.default_rng(3)
    past, present = (
        Gradients(
            np.where(right, rng.normal(size=N), image.x), np.where(right, rng.normal(size=N), image.y), image.derivative
        )
        for image in (past, present)
    )
    share = shared_gradient(px, past, present)
    assert share[~right].min() == pytest.approx(1.0)
    assert share[right].mean() < 0.3
