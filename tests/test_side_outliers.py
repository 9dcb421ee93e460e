"""The update with outlying box sides: compared with Kalman's and with each mixture component."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.road_users.state.parallax import Parallax
from birdslam.road_users.state.parallax_config import ParallaxConfig
from birdslam.road_users.state.parallax_measurements import ParallaxMeasurements
from birdslam.road_users.state.side_outliers import update_with_side_outliers

N, FILTERS, STATES, CUES = 2, 3, 5, 4
CAR_HEIGHT_M, CAR_WIDTH_M, CAMERA_M = 1.5, 1.6, 1.65


def problem(seed: int) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    rng = np.random.default_rng(seed)
    root, noise = rng.normal(size=(N, FILTERS, STATES, STATES)), rng.normal(size=(N, FILTERS, CUES, CUES))
    J, innovation = rng.normal(size=(N, FILTERS, CUES, STATES)), rng.normal(size=(N, FILTERS, CUES))
    off = rng.normal(size=(2, N, FILTERS, CUES))
    return root @ root.swapaxes(-1, -2), J, noise @ noise.swapaxes(-1, -2) + np.eye(CUES), innovation, off


def kalman(P: Floats, J: Floats, noise: Floats, innovation: Floats) -> tuple[Floats, Floats, float]:
    S = J @ P @ J.T + noise
    gain = P @ J.T @ np.linalg.inv(S)
    squared = float(innovation @ np.linalg.solve(S, innovation))
    return gain @ innovation, P - gain @ J @ P, -0.5 * (squared + math.log(np.linalg.det(S)))


@given(st.integers(0, 2**32 - 1))
def test_without_outliers_it_is_kalmans_update(seed: int) -> None:
    P, J, noise, innovation, off = problem(seed)
    PJt = P @ J.swapaxes(-1, -2)
    after = update_with_side_outliers(P, PJt, J @ PJt + noise, innovation, off, np.zeros((2, N)))
    for n, f in np.ndindex(N, FILTERS):
        step, cov, log_likelihood = kalman(P[n, f], J[n, f], noise[n, f], innovation[n, f])
        np.testing.assert_allclose(after.step[n, f], step, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(after.cov[n, f], cov, rtol=1e-6, atol=1e-8)
        assert after.log_likelihood[n, f] == pytest.approx(log_likelihood)
    assert (after.outlier < 1e-200).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.3))
def test_update_is_the_mixture_of_three_cases(seed: int, share: float) -> None:
    P, J, noise, innovation, off = problem(seed)
    PJt = P @ J.swapaxes(-1, -2)
    after = update_with_side_outliers(P, PJt, J @ PJt + noise, innovation, off, np.full((2, N), share))
    for n, f in np.ndindex(N, FILTERS):
        more = [np.zeros((CUES, CUES)), *(np.outer(u, u) for u in off[:, n, f])]
        steps, covs, logs = zip(
            *(kalman(P[n, f], J[n, f], noise[n, f] + extra, innovation[n, f]) for extra in more), strict=True
        )
        weight = np.exp(np.array(logs)) * [1.0 - 2.0 * share, share, share]
        total = weight.sum()
        weight /= total
        step = weight @ np.array(steps)
        spread = [np.outer(each - step, each - step) for each in steps]
        np.testing.assert_allclose(after.step[n, f], step, rtol=1e-6, atol=1e-8)
        cov = sum(w * (C + d) for w, C, d in zip(weight, covs, spread, strict=True))
        np.testing.assert_allclose(after.cov[n, f], cov, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(after.outlier[:, n, f], weight[1:], rtol=1e-6, atol=1e-9)
        assert after.log_likelihood[n, f] == pytest.approx(math.log(total))


def seen_at(x_m: float, y_m: float, hidden: float = 0.0) -> ParallaxMeasurements:
    """The box of a car there, whose left side is hidden by that share of its width."""
    z_m = x_m - 1.9
    width = CAR_WIDTH_M / z_m
    return ParallaxMeasurements(
        log_height=np.array([math.log(CAR_HEIGHT_M / z_m)]),
        log_width=np.array([math.log(width * (1.0 - hidden)) - math.log(CAR_WIDTH_M)]),
        bearing=np.array([y_m / x_m - hidden * width / 2.0]),
        sigma=np.array([[0.03, 0.03, 0.001]]),
        depth_m=np.array([z_m]),
        bottom=np.array([CAMERA_M / z_m]),
        sigma_bottom=np.array([0.002]),
        reach_m=np.array([1.9]),
        turned_rad=np.zeros(1),
        yaw_rad=np.zeros(1),
        tan_width=np.array([width * (1.0 - hidden)]),
    )


def drive_past(config: ParallaxConfig, hidden: float) -> tuple[float, Floats]:
    """A parked car 6 m beside the ego, half hidden by a tree for 0.5 s: its motion state and the outliers."""
    parallax = Parallax(config)
    parallax.add_vehicle(np.array([40.0, 6.0]), 0.0, SE2(), math.log(CAR_HEIGHT_M), (0.08, 0.2))
    outlier = np.zeros(2)
    for frame in range(20):
        ego = SE2(x_m=0.8 * frame)
        parallax.predict(0.1, ego, None)
        behind = hidden if frame >= 15 else 0.0
        learned = parallax.learn_sizes([0], seen_at(40.0 - 0.8 * frame, 6.0, behind), ego, CAMERA_M)
        outlier = learned.side_outlier[0]
    return parallax.stationary_probability(0), outlier


def test_partly_hidden_parked_car_stays_stationary() -> None:
    standing, outlier = drive_past(ParallaxConfig(), hidden=0.4)
    assert standing > 0.5
    assert outlier[0] > 0.9
    assert outlier[1] < 0.05
    unaware, _ = drive_past(ParallaxConfig(side_outlier=0.0, own_for_s=1e12), hidden=0.4)
    assert unaware < standing


def test_fully_visible_car_has_no_outlying_side() -> None:
    standing, outlier = drive_past(ParallaxConfig(), hidden=0.0)
    assert standing > 0.9
    assert (outlier < ParallaxConfig().side_outlier).all()
