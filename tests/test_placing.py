"""Vehicles truncated by the lower image border: the true lower edge bounds their distance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import LocalisationConfig, Observation, observe_boxes
from birdslam.road_users.placement.uncertain_yaw import HeadingConfig
from birdslam.road_users.placing import Assignment, Placing, truncate_at_cut
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import Depths, GroundSizeFilter
from tests.boxes import CAR, cuboid_px, footprint_m
from tests.test_frontend import CAMERA

CONFIG = LocalisationConfig()


def seen_at(x_m: float, y_m: float, height_m: float = CAR.height_m) -> Observation:
    """A car headed like the ego, as a detector draws what the image shows of it."""
    on_road = np.maximum(footprint_m(SE2(x_m, y_m)), [0.5, -99.0])  # what is behind the camera is not in the image
    border = np.tile([CAMERA.width_px - 1.0, CAMERA.height_px - 1.0], 2)
    box = np.clip(cuboid_px(on_road, height_m, CAMERA.ground), 0.0, border)
    (found,) = observe_boxes(box[None], np.ones(1), ("car",), CAMERA, CAMERA.ground, CONFIG)
    return found


def depths(log_depth: float, sigma: float) -> Depths:
    return Depths(*(np.array([value]) for value in (log_depth, sigma**2, 0.42, 0.0064, 0.9)))


def test_only_a_truncated_lower_edge_is_a_bound() -> None:
    assert seen_at(20.0, 2.0).sigma_cut is None
    cut = seen_at(5.0, 1.0)
    assert cut.sigma_cut < 0.1 * cut.sigma_bottom
    ground_size, whole = GroundSizeFilter(CAMERA, GroundSizeConfig()), depths(math.log(18.0), 0.1)
    assert truncate_at_cut(whole, [seen_at(20.0, 2.0)], ground_size, 0.0) is whole


@pytest.mark.parametrize(("depth_m", "sigma"), [(12.0, 0.5), (6.0, 0.3), (4.0, 0.2), (3.0, 1.5)])
def test_moments_are_those_of_the_truncated_distribution(depth_m: float, sigma: float) -> None:
    ground_size, cut = GroundSizeFilter(CAMERA, GroundSizeConfig()), seen_at(5.0, 1.0)
    found = truncate_at_cut(depths(math.log(depth_m), sigma), [cut], ground_size, 0.0)
    assert cut.sigma_cut is not None
    sigma_bound = math.hypot(cut.sigma_cut, ground_size.sigma_pitch_rad) / cut.slope_bottom
    sigma_bound = math.hypot(sigma_bound, ground_size.config.sigma_kerb_m / CAMERA.height_m)
    log_z = np.linspace(-12.0, 12.0, 400_001)
    weight = np.exp(-0.5 * ((log_z - math.log(depth_m)) / sigma) ** 2)
    weight *= ndtr((math.log(CAMERA.height_m / cut.slope_bottom) - log_z) / sigma_bound)
    mean = float((log_z * weight).sum() / weight.sum())
    assert found.log_depth[0] == pytest.approx(mean, abs=1e-4)
    assert found.variance[0] == pytest.approx(float(((log_z - mean) ** 2 * weight).sum() / weight.sum()), rel=1e-3)
    assert found.depth_per_height[0] / 0.9 == pytest.approx(found.variance[0] / sigma**2)


def test_depth_far_beyond_the_bound_gives_finite_numbers() -> None:
    ground_size, cut = GroundSizeFilter(CAMERA, GroundSizeConfig()), seen_at(5.0, 1.0)
    found = truncate_at_cut(depths(8.0, 0.01), [cut], ground_size, 0.0)
    assert np.isfinite(found.log_depth).all()
    assert found.log_depth[0] < 8.0
    assert 0.0 < found.variance[0] < 1e-4


def test_cars_beside_the_ego_are_not_placed_far_ahead() -> None:
    errors = []
    for x_m in np.arange(3.5, 7.0, 0.5):
        for side in (-3.3, 3.3):
            for height_m in (1.4, 1.53, 1.66):
                ground_size = GroundSizeFilter(CAMERA, GroundSizeConfig())
                placing = Placing(ground_size, CONFIG, PseudoLidarConfig(), HeadingConfig())
                assignment = Assignment(0, None, seen_at(float(x_m), side, height_m))
                assert assignment.observation.sigma_cut is not None
                (where,) = placing.locate([assignment], SE2())
                errors.append(where.centre_m[0] - x_m)
                assert abs(errors[-1]) < 2.0 * math.sqrt(where.cov[0, 0])
    assert abs(np.mean(errors)) < 1.0
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
