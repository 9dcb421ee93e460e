"""An unknown yaw: its effect on a position, and what widths of boxes at several bearings tell of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

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
from birdslam.road_users.state.yaw_by_outline import YawByOutline
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


SIGMA_DEPTH_OF_OUTLINE = 0.05


def look(outline: YawByOutline, T_world_ego: SE2, centre_m: tuple[float, float], yaw_rad: float, scale: float) -> None:
    """One frame, in which the car in row 0 is seen; `scale` of its outline lasts."""
    T_ego_car = T_world_ego.between(SE2(*centre_m, yaw_rad))
    corners = footprint_m(T_ego_car, scale * CAR.length_m, scale * CAR.width_m)
    (seen,) = observe_boxes(cuboid_px(corners)[None], np.ones(1), ("car",), CAMERA, CAMERA.ground, LOCALISATION)
    depth: NDArray[np.float64] = np.array([math.log(corners[:, 0].min())])
    outline.predict(0.1, T_world_ego)
    fan = evaluate_yaws([seen], depth, (outline.grid_rad - T_world_ego.yaw_rad)[None], LOCALISATION.reach_rel)
    outline.weigh([0], fan.residual, fan.box_variance, np.array([SIGMA_DEPTH_OF_OUTLINE**2]), np.exp(depth))


def turned(a_rad: float, b_rad: float) -> float:
    """Between two axes: a heading and its opposite are one."""
    return abs(math.remainder(a_rad - b_rad, math.pi))


@pytest.mark.parametrize("yaw_deg", [0.0, 50.0, 70.0, 90.0])
@pytest.mark.parametrize("scale", [0.95, 1.0, 1.05])
def test_passing_a_parked_car_determines_its_yaw(yaw_deg: float, scale: float) -> None:
    outline, yaw_rad, told = YawByOutline(CONFIG), math.radians(yaw_deg), 0.0
    outline.add_vehicle()
    for k in range(30):
        look(outline, SE2(0.8 * k, 0.0, 0.0), (34.0, 6.0), yaw_rad, scale)
        told, sigma_rad = outline.estimate(0, told)
    assert turned(told, yaw_rad) < math.radians(12.0)
    assert turned(told, yaw_rad) < 3.0 * sigma_rad


@pytest.mark.parametrize("yaw_deg", [-60.0, -50.0, -40.0])
def test_ambiguous_yaw_is_uncertain(yaw_deg: float) -> None:
    """Across the line of sight all outlines have equal width, so passing leaves the mirror ambiguity."""
    outline, yaw_rad, told, sigma_rad = YawByOutline(CONFIG), math.radians(yaw_deg), 0.0, 0.0
    outline.add_vehicle()
    for k in range(30):
        look(outline, SE2(0.8 * k, 0.0, 0.0), (34.0, 6.0), yaw_rad, 1.0)
        told, sigma_rad = outline.estimate(0, told)
    assert turned(told, yaw_rad) < 3.0 * sigma_rad


def test_repeated_observation_adds_no_information() -> None:
    weights = []
    for frames in (20, 1000):
        outline = YawByOutline(CONFIG)
        outline.add_vehicle()
        for _ in range(frames):
            look(outline, SE2(), (20.0, 4.0), 0.7, 1.0)
        weights.append(outline.estimate(0, 0.0)[1])
    assert weights[1] == pytest.approx(weights[0], rel=0.2)
    assert weights[1] > math.radians(5.0)


def test_car_ahead_of_a_turning_ego_follows_the_road() -> None:
    """First observed in a turn; it is assumed parallel to the ego only on straight road."""
    outline, told = YawByOutline(CONFIG), 0.0
    outline.add_vehicle()
    pose = SE2(0.0, 0.0, math.radians(-40.0))
    for k in range(30):
        look(outline, pose, (30.0, 4.0), 0.0, 1.0)
        told, sigma_rad = outline.estimate(0, pose.yaw_rad if k == 0 else told)
        pose = pose @ SE2(0.6, 0.0, math.radians(4.0) if k < 10 else 0.0)
    assert turned(told, 0.0) < math.radians(5.0)
    assert sigma_rad < math.radians(15.0)


def test_rows_of_kept_tracks_remain() -> None:
    outline = YawByOutline(CONFIG)
    for _ in range(3):
        outline.add_vehicle()
    look(outline, SE2(), (20.0, 4.0), 1.2, 1.0)
    before = outline.estimate(0, 1.2)
    outline.keep_rows([0, 2])
    assert len(outline) == 2
    assert outline.estimate(0, 1.2) == before
