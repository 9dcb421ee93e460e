"""The road filter with vertical curvature: image comparisons with their covariance, and propagation."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.road.alignment import RoadAlignConfig, RoadAligner
from birdslam.odometry.road.fit import MOTION, ROAD, Gradients, RoadFit, fit_without_prior, shared_gradient
from birdslam.odometry.road.kalman_filter import RoadFilter
from birdslam.odometry.scale_config import RoadScaleConfig
from tests.graded_road import CURVE_M, GradedRoad, Stand

CAMERA = Camera(931, 282, 540.0, 540.0, 456.3, 139.2, height_m=1.65)
GRADE = 0.06


def camera_pose(stand: Stand) -> Pose:
    """In axes x right, y down, z forward."""
    return Pose(rotation_exp(np.array([-stand.pitch_rad, 0.0, 0.0])), np.array([0.0, -stand.up_m, stand.way_m]))


def compared(rear_m: float, ahead_rad: float) -> RoadFit:
    """Two images 1.1 m apart, with their true motion."""
    road, rng = GradedRoad(CAMERA, GRADE), np.random.default_rng(0)
    then, now = road.stand(rear_m), road.stand(rear_m + 1.1)
    aligner = RoadAligner(CAMERA, RoadAlignConfig(effective_sample_fraction=0.2))
    past, present = (aligner.image(road.render(stand, rng)) for stand in (then, now))
    T = camera_pose(then).between(camera_pose(now))
    px = aligner.samples((ahead_rad, 0.0), np.zeros((0, 4)), None)
    fit = aligner.align(past, present, T, px, np.zeros(4), np.diag(np.square([0.2, 0.03, 0.01, 0.003])))
    assert fit.correlation > 0.8
    return fit


@pytest.mark.parametrize(
    ("rears_m", "curvature_per_m"), [((28.0, 30.0), GRADE / CURVE_M), ((105.0, 110.0, 115.0, 120.0), -GRADE / CURVE_M)]
)
def test_image_comparison_distinguishes_sag_and_crest(rears_m: tuple[float, ...], curvature_per_m: float) -> None:
    """One pair of images determines it to 50 % at best."""
    seen = [float(compared(rear_m, 7.5 * curvature_per_m).state[3]) for rear_m in rears_m]
    assert 0.5 < np.mean(seen) / curvature_per_m < 2.0


def sigma_after(distance_m: float, distortion_sigma: float) -> float:
    """1-sigma of the log scale after a known scale and `distance_m` without an alignment."""
    filter_ = RoadFilter(msgspec.structs.replace(CAMERA, distortion_sigma=distortion_sigma), RoadScaleConfig())
    filter_.reset_scale(0.01)
    for _ in range(round(distance_m)):
        filter_.predict(np.eye(3), 1.0)
    return math.sqrt(filter_.cov[0, 0])


def test_an_uncertain_distortion_is_a_drift_of_the_scale() -> None:
    """A landmark that moves to the edge (r) changes its depth by 2 r^2 times the error of k1."""
    measured, uncertain = sigma_after(20.0, 0.0), sigma_after(20.0, 0.1)
    edge = 0.5 * CAMERA.width_px / CAMERA.fx_px
    assert measured < 0.05
    assert uncertain > 20.0 * 0.1 * edge**2 / 10.0 * math.exp(-20.0 / 100.0)
    assert sigma_after(20.0, 0.2) / uncertain == pytest.approx(2.0, rel=0.05)


def test_the_plane_under_the_camera_turns_with_the_road() -> None:
    """The camera keeps its direction in space over a sag: the road comes up in front of it."""
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    filter_.x[3] = 0.001
    filter_.predict(np.eye(3), 5.0)
    assert 0.001 < filter_.tilt[0] < 0.0051  # the mount holds some of it back
    pitch_rad = float(filter_.chord[0][0])
    assert pitch_rad > filter_.tilt[0]  # and more so against the road further on


@pytest.mark.parametrize("curvature_per_m", [0.001, -0.001])
def test_ego_pitch_determines_crest_and_sag(curvature_per_m: float) -> None:
    """No image of the road at all: a car that pitches on and on follows a road that bends."""
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    for _ in range(40):
        filter_.predict(rotation_exp(np.array([curvature_per_m, 0.0, 0.0])), 1.0)  # nose up in a sag
    assert 0.2 < filter_.x[3] / curvature_per_m < 1.2  # the prior, and the walk of the tilt, hold some of it back
    assert abs(filter_.tilt[0]) < math.radians(0.6)


def test_filter_does_not_reuse_its_own_output_as_mount() -> None:
    """Comparisons that see nothing of the tilt leave it, and its sigma, where the calibration put it."""
    filter_, config = RoadFilter(CAMERA, RoadScaleConfig()), RoadScaleConfig()
    blind = RoadFit(np.array([0.0, 0.3, 0.3, 0.0]), np.diag([1e-4, 1e4, 1e4, 1e4]), 0.9, 1000)
    for _ in range(200):
        filter_.predict(np.eye(3), 1.0)
        filter_.update_alignment(blind)
    assert np.abs(filter_.x[4:]).max() < 1e-3
    assert filter_.cov[4, 4] >= config.sigma_mount_rad**2


def test_correlated_feature_errors_keep_the_tilt_uncertain() -> None:
    """The same landmarks show a direction that is 20 mrad off, and know it to 20 mm: no more than that is learned."""
    filters = {sigma_m: RoadFilter(CAMERA, RoadScaleConfig()) for sigma_m in (0.0, 0.02)}
    wrong = np.array([0.0, -0.02, 1.0])
    before = RoadFilter(CAMERA, RoadScaleConfig()).tilt
    for sigma_across_m, filter_ in filters.items():
        for _ in range(3):
            filter_.predict(np.eye(3), 1.0)
            filter_.update_travel(wrong, 1.0, sigma_across_m)
    off_rad = {sigma_m: abs(float(filter_.tilt[0] - before[0])) for sigma_m, filter_ in filters.items()}
    assert off_rad[0.0] > 0.01  # corners that are sure are followed
    assert off_rad[0.02] < 0.7 * off_rad[0.0]
    filter_ = filters[0.02]
    assert off_rad[0.02] < float(np.sqrt(filter_.cov[1, 1]))


def _of_the_length(sigma_log: float) -> RoadFit:
    """An alignment with sigma `sigma_log` of tilt and length."""
    return RoadFit(np.zeros(4), np.diag([sigma_log**2, 1e-6, 1e-6, 1e-8]), 0.9, 1000)


def test_weak_alignment_hardly_changes_a_carried_scale() -> None:
    config = RoadScaleConfig()
    left = []
    for sigma_log in (0.03, 0.15, 0.5, 1.0):
        filter_ = RoadFilter(CAMERA, config)
        for _ in range(20):
            filter_.predict(np.eye(3), 1.0)
        filter_.update_alignment(_of_the_length(sigma_log))
        left.append(filter_.carried_m / 20.0)
    assert left == sorted(left)
    assert left[0] == 0.0
    assert left[1] < 0.1
    assert left[2] > 0.85
    assert left[3] > 0.95


def test_weak_alignments_add_up_consistently() -> None:
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    for _ in range(20):
        filter_.predict(np.eye(3), 1.0)
        filter_.update_alignment(_of_the_length(0.6))
    assert filter_.carried_m > RoadScaleConfig().carried_after_m
    assert math.sqrt(filter_.cov[0, 0]) > 0.12  # 0.6 over the root of 20


def test_unknown_tilt_hides_the_scale() -> None:
    """The same alignment with strongly correlated length and pitch: it gives the length if the pitch is known."""
    steep = np.array([1.0, 0.1, 0.0, 0.0])  # a tenth of a radian of pitch for all of the length
    fit = RoadFit(np.zeros(4), np.diag([1e-4, 1e-6, 1e-6, 1e-8]) + np.outer(steep, steep), 0.9, 1000)
    unsure, sure = RoadFilter(CAMERA, RoadScaleConfig()), RoadFilter(CAMERA, RoadScaleConfig())
    sure.cov[1:, 1:] = np.diag([1e-6, 1e-6, 1e-8, 1e-6, 1e-6, 1e-6])
    assert unsure.information(fit) < 0.7 * sure.information(fit)


def test_sigma_of_carried_scale_grows() -> None:
    """Its errors are correlated: twice the distance has more than sqrt(2) times the sigma."""
    sigma_rel = []
    for metres in (100, 200):
        filter_ = RoadFilter(CAMERA, RoadScaleConfig())
        filter_.reset_scale(0.0)
        for _ in range(metres):
            filter_.predict(np.eye(3), 1.0)
        sigma_rel.append(math.sqrt(filter_.cov[0, 0]))
    assert 0.06 < sigma_rel[0] < 0.12
    assert sigma_rel[1] > 1.7 * sigma_rel[0]


def pitch_under_drift(config: RoadScaleConfig) -> float:
    """The pitch (rad) after 100 m of a level road, on which the scale shrinks by 0.25 % a metre."""
    steep = np.array([1.0, 0.2, 0.0, 0.0])  # 8 mrad of pitch for 4 % of length
    cov = np.diag([0.005**2, 1e-4, 1e-4, 1e-7]) + 0.5**2 * np.outer(steep, steep)
    filter_, off_log = RoadFilter(CAMERA, config), 0.0
    filter_.reset_scale(0.05)
    for _ in range(100):
        filter_.predict(np.eye(3), 1.0)
        off_log -= 0.0025 + filter_.pending_log
        filter_.pending_log = 0.0
        fit = RoadFit(np.array([off_log, 0.0, 0.0, 0.0]), cov, 0.9, 1000)
        off_log -= math.log(filter_.update_alignment(fit)) + filter_.pending_log
        filter_.pending_log = 0.0
    return abs(float(filter_.tilt[0]))


def test_scale_drift_does_not_tilt_the_road() -> None:
    """Where only lengths walk, the trade of length against pitch gives most of a drift to the pitch."""
    without = pitch_under_drift(RoadScaleConfig(scale_drift_per_m=1e-9))
    assert without > 0.004
    assert pitch_under_drift(RoadScaleConfig()) < without / 3.0


N = 1200
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
