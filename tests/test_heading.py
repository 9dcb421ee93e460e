"""The effect of an unknown yaw on a vehicle's position, on boxes of a known world."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.bench.tracking.localisation import INSIDE_2_SIGMA
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import LocalisationConfig, Observation, observe_boxes, place
from birdslam.road_users.placement.uncertain_yaw import (
    HeadingConfig,
    YawPrior,
    evaluate_yaws,
    initial_yaw_rad,
    make_fan,
    weigh_yaws,
)
from tests.boxes import CAR, cuboid_px, footprint_m
from tests.recordings import KITTI as CAMERA

CONFIG, LOCALISATION = HeadingConfig(), LocalisationConfig()
SIGMA_DEPTH = 0.03


def car_at(centre_m: Floats, yaw_rad: float, noise_px: Floats, stretch: float = 1.0) -> tuple[Observation, float]:
    """Its box, and the true depth of its nearest face; `stretch` of its length and width."""
    corners = footprint_m(SE2(*centre_m, yaw_rad), stretch * CAR.length_m, stretch * CAR.width_m)
    box = cuboid_px(corners, 1.5) + noise_px
    (seen,) = observe_boxes(box[None], np.ones(1), ("car",), CAMERA, CAMERA.ground, LOCALISATION)
    return seen, float(corners[:, 0].min())


def placed(
    seen: Observation, depth_m: float, headings: YawPrior, localisation: LocalisationConfig = LOCALISATION
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """(centre, cov) without and with the uncertainty of the yaw."""
    log_depth = math.log(depth_m)
    sharp = place(seen, log_depth, SIGMA_DEPTH**2, float(headings.yaw_rad[0]), localisation)
    yaws = make_fan(headings, np.arange(CONFIG.fan, dtype=np.float64) * (math.pi / CONFIG.fan))
    fan = evaluate_yaws([seen], np.array([log_depth]), yaws, localisation.reach_rel)
    shift, cov = fan.marginalised(weigh_yaws(fan, np.array([SIGMA_DEPTH**2]), headings, CONFIG))
    return (sharp.centre_m, sharp.cov), (sharp.centre_m + shift[0], sharp.cov + cov[0])


def thought(yaw_rad: float, sigma_rad: float, outlier: float) -> YawPrior:
    return YawPrior(np.array([yaw_rad]), np.array([sigma_rad]), np.array([outlier]))


@pytest.mark.parametrize("yaw_rad", [-1.0, 0.0, 0.5, 2.0])
def test_known_yaw_changes_nothing(yaw_rad: float) -> None:
    seen, depth_m = car_at(np.array([15.0, 3.0]), yaw_rad, np.zeros(4))
    (centre, cov), (mean, wide) = placed(seen, depth_m, thought(yaw_rad, 0.0, 0.0))
    np.testing.assert_allclose(mean, centre, atol=1e-9)
    np.testing.assert_allclose(wide, cov, atol=1e-9)


def test_the_papers_point_is_the_same_for_every_yaw() -> None:
    seen, depth_m = car_at(np.array([15.0, 3.0]), 0.7, np.zeros(4))
    face = LocalisationConfig(reach_rel=0.0)
    (centre, cov), (mean, wide) = placed(seen, depth_m, thought(0.0, 0.05, 0.25), face)
    np.testing.assert_allclose(mean, centre, atol=1e-9)
    np.testing.assert_allclose(wide, cov, atol=1e-9)


def test_wide_box_is_a_crossing_car() -> None:
    """Its centre is half of its width behind the nearest face; a car at 60 degrees looks nearly as wide."""
    truth = np.array([15.0, 0.0])
    seen, depth_m = car_at(truth, math.pi / 2.0, np.zeros(4))
    (centre, _), (mean, _) = placed(seen, depth_m, thought(0.0, 0.05, 0.25))
    assert centre[0] - truth[0] > 1.0
    assert abs(mean[0] - truth[0]) < 0.7


def test_covariance_covers_any_yaw() -> None:
    """A quarter has any heading, as in `HeadingConfig`; the position assumes the ego's heading."""
    rng, squared = np.random.default_rng(2), []
    for _ in range(600):
        truth = np.array([rng.uniform(7.0, 20.0), 0.0])
        truth[1] = rng.uniform(-0.35, 0.35) * truth[0]
        yaw_rad = rng.uniform(-math.pi, math.pi) if rng.uniform() < 0.25 else 0.05 * rng.standard_normal()
        noise_px = rng.standard_normal(4) * np.array([1.0, 0.0, 1.0, 0.0])
        seen, depth_m = car_at(truth, yaw_rad, noise_px, math.exp(0.09 * rng.standard_normal()))
        depth_m *= math.exp(SIGMA_DEPTH * rng.standard_normal())
        both = placed(seen, depth_m, thought(0.0, 0.05, 0.25))
        squared.append([(mean - truth) @ np.linalg.solve(cov, mean - truth) for mean, cov in both])
    sharp, told = np.array(squared).T
    assert np.mean(sharp) > 2.5  # two degrees of freedom
    assert 1.0 < np.mean(told) < 2.0
    assert np.mean(told <= INSIDE_2_SIGMA) > 0.95


@pytest.mark.parametrize(
    ("yaw_rad", "first"), [(0.0, 0.0), (math.pi, 0.0), (math.pi / 2, math.pi / 2), (-1.5, math.pi / 2)]
)
@pytest.mark.parametrize("x_m", [12.0, 25.0, 45.0])
@pytest.mark.parametrize("y_m", [-5.0, 0.0, 5.0])
def test_box_determines_crossing_cars(yaw_rad: float, first: float, x_m: float, y_m: float) -> None:
    seen, _ = car_at(np.array([x_m, y_m]), yaw_rad, np.zeros(4))
    assert initial_yaw_rad(seen, CONFIG) == first
    assert initial_yaw_rad(seen, HeadingConfig(across=0.0)) == 0.0


def test_truncated_box_does_not_determine_yaw() -> None:
    box = np.array([[2.0, 150.0, 402.0, 300.0]])
    (cut,) = observe_boxes(box, np.ones(1), ("car",), CAMERA, CAMERA.ground, LOCALISATION)
    (whole,) = observe_boxes(box + [400.0, 0.0] * 2, np.ones(1), ("car",), CAMERA, CAMERA.ground, LOCALISATION)
    assert initial_yaw_rad(cut, CONFIG) == 0.0
    assert initial_yaw_rad(whole, CONFIG) == math.pi / 2.0
