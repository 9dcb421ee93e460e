"""The road that bends: what a comparison of two images sees of it, and how the filter carries it on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.road.alignment import RoadAlignConfig, RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.kalman_filter import RoadFilter, RoadScaleConfig
from birdslam.perf.accuracy.graded_road import CURVE_M, GradedRoad, Stand

CAMERA = Camera(931, 282, 540.0, 540.0, 456.3, 139.2, height_m=1.65)
GRADE = 0.06


def camera_pose(stand: Stand) -> Pose:
    """In axes x right, y down, z along the way."""
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
    assert fit is not None
    assert fit.correlation > 0.8
    return fit


@pytest.mark.parametrize(
    ("rears_m", "curvature_per_m"), [((28.0, 30.0), GRADE / CURVE_M), ((105.0, 110.0, 115.0, 120.0), -GRADE / CURVE_M)]
)
def test_a_sag_and_a_crest_are_told_apart_by_the_image_of_the_road(
    rears_m: tuple[float, ...], curvature_per_m: float
) -> None:
    """One pair of images knows it to half of itself at best."""
    seen = [float(compared(rear_m, 7.5 * curvature_per_m).state[3]) for rear_m in rears_m]
    assert 0.5 < np.mean(seen) / curvature_per_m < 2.0


def test_the_plane_under_the_camera_turns_with_the_road() -> None:
    """The camera keeps its direction in space over a sag: the road comes up in front of it."""
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    filter_.x[3] = 0.001
    filter_.predict(np.eye(3), 5.0)
    assert 0.001 < filter_.tilt[0] < 0.0051  # the mount holds some of it back
    pitch_rad = float(filter_.chord[0][0])
    assert pitch_rad > filter_.tilt[0]  # and more so against the road further on


@pytest.mark.parametrize("curvature_per_m", [0.001, -0.001])
def test_a_crest_and_a_sag_are_learned_from_the_cars_own_pitching(curvature_per_m: float) -> None:
    """No image of the road at all: a car that pitches on and on follows a road that bends."""
    filter_ = RoadFilter(CAMERA, RoadScaleConfig())
    for _ in range(40):
        filter_.predict(rotation_exp(np.array([curvature_per_m, 0.0, 0.0])), 1.0)  # nose up in a sag
    assert 0.2 < filter_.x[3] / curvature_per_m < 1.2  # the prior, and the walk of the tilt, hold some of it back
    assert abs(filter_.tilt[0]) < math.radians(0.6)


def test_the_mount_is_not_what_the_filter_told_itself() -> None:
    """Comparisons that see nothing of the tilt leave it, and its sigma, where the calibration put it."""
    filter_, config = RoadFilter(CAMERA, RoadScaleConfig()), RoadScaleConfig()
    blind = RoadFit(np.array([0.0, 0.3, 0.3, 0.0]), np.diag([1e-4, 1e4, 1e4, 1e4]), 0.9, 1000)
    for _ in range(200):
        filter_.predict(np.eye(3), 1.0)
        filter_.update_alignment(blind)
    assert np.abs(filter_.x[4:]).max() < 1e-3
    assert filter_.cov[4, 4] >= config.sigma_mount_rad**2


def test_corners_that_err_alike_for_metres_do_not_make_a_tilt_sure() -> None:
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
