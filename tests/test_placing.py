"""Placing by the lower edge: truncated boxes, and where tyres touch the road."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from birdslam.geometry import bev
from birdslam.geometry.se2 import SE2
from birdslam.perception.manifest import LowerEdge
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import (
    DIMENSIONS,
    Dimensions,
    LocalisationConfig,
    Observation,
    corners_of,
    observe_boxes,
)
from birdslam.road_users.placement.tyre_contact import bottom_at_face
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


CONTACT_CAR = DIMENSIONS["car"]
ends = st.floats(4.0, 80.0)  # depth of the nearest face
yaws = st.floats(-math.pi, math.pi)
kinds = st.sampled_from(sorted(DIMENSIONS))
heights = st.floats(1.0, 3.0)


def seen(slope: float, dimensions: Dimensions = CONTACT_CAR, lower_edge: LowerEdge = "tyres") -> Observation:
    """An observation with this slope of its lower edge."""
    box = np.array([[600.0, 150.0, 700.0, 230.0]])
    (found,) = observe_boxes(box, np.ones(1), ("car",), CAMERA, CAMERA.ground, CONFIG, None, lower_edge)
    return msgspec.structs.replace(found, slope_bottom=slope, sigma_bottom=0.01 * slope, dimensions=dimensions)


def lowest_slope(face_m: float, yaw_rad: float, dimensions: Dimensions, height_m: float) -> float:
    """Of all that a body on four tyres shows: the lower edge of its nearest corner, and its nearest tyre's contact."""
    axles = msgspec.structs.replace(dimensions, length_m=dimensions.length_m * (1.0 - 2.0 * CONFIG.overhang_rel))
    reach_m, to_tyre_m = (-min(x for x, _ in corners_of(d, yaw_rad)) for d in (dimensions, axles))
    bumper = (height_m - CONFIG.clearance_m) / face_m
    return max(bumper, height_m / (face_m + reach_m - to_tyre_m))


@given(ends, yaws, kinds, heights)
def test_the_face_of_a_body_on_tyres_is_found_at_any_yaw(
    face_m: float, yaw_rad: float, kind: str, height_m: float
) -> None:
    dimensions = DIMENSIONS[kind]
    slope = lowest_slope(face_m, yaw_rad, dimensions, height_m)
    found = bottom_at_face(seen(slope, dimensions), yaw_rad, height_m, CONFIG)
    assert bev.meet_road(np.ones(1), np.array([found.slope_bottom]), height_m)[0] == pytest.approx(face_m, rel=1e-9)


@given(ends, yaws, heights)
def test_face_is_within_the_overhang_before_the_tyre(face_m: float, yaw_rad: float, height_m: float) -> None:
    found = bottom_at_face(seen(height_m / face_m), yaw_rad, height_m, CONFIG)
    nearer_m = face_m - height_m / found.slope_bottom
    assert -1e-9 <= nearer_m <= CONFIG.overhang_rel * CONTACT_CAR.length_m + 1e-9


@given(ends, yaws, heights)
def test_sigma_scales_with_the_slope(face_m: float, yaw_rad: float, height_m: float) -> None:
    slope, step = height_m / face_m, 1e-7
    low, here, high = (bottom_at_face(seen(s), yaw_rad, height_m, CONFIG) for s in (slope - step, slope, slope + step))
    derivative = (high.slope_bottom - low.slope_bottom) / (2.0 * step)
    at_kink = (
        abs(CONFIG.overhang_rel * CONTACT_CAR.length_m * abs(math.cos(yaw_rad)) * slope - CONFIG.clearance_m) < 1e-5
    )
    assert at_kink or here.sigma_bottom == pytest.approx(0.01 * slope * derivative, rel=1e-4)


@given(ends, yaws)
def test_box_of_the_body_is_not_changed(face_m: float, yaw_rad: float) -> None:
    of_body = seen(CAMERA.height_m / face_m, lower_edge="body")
    assert bottom_at_face(of_body, yaw_rad, CAMERA.height_m, CONFIG) is of_body


@given(ends, yaws)
def test_correction_is_applied_once(face_m: float, yaw_rad: float) -> None:
    once = bottom_at_face(seen(CAMERA.height_m / face_m), yaw_rad, CAMERA.height_m, CONFIG)
    assert bottom_at_face(once, yaw_rad, CAMERA.height_m, CONFIG) is once


def test_lower_edge_above_the_horizon_is_not_changed() -> None:
    above = seen(-0.01)
    assert bottom_at_face(above, 0.0, CAMERA.height_m, CONFIG) is above


def test_position_does_not_depend_on_the_lower_edge_type() -> None:
    face_m, found = 9.0, {}
    for lower_edge in ("body", "tyres"):
        ground_size = GroundSizeFilter(CAMERA, GroundSizeConfig())
        placing = Placing(ground_size, CONFIG, PseudoLidarConfig(), HeadingConfig())
        height_m = CAMERA.height_m
        observation = seen(height_m / face_m, lower_edge="body")
        if lower_edge == "tyres":
            observation = seen(lowest_slope(face_m, 0.0, CONTACT_CAR, height_m))
        top = (height_m - CONTACT_CAR.height_m) / face_m
        half = CONTACT_CAR.width_m / face_m / 2.0
        observation = msgspec.structs.replace(
            observation, slope_top=top, left=half, right=-half, sigma_bottom=0.002, sigma_top=0.002
        )
        assignment = Assignment(0, None, observation)
        (found[lower_edge],) = placing.locate([assignment], SE2())
    assert found["tyres"].depth_m == pytest.approx(found["body"].depth_m, rel=0.005)
    assert found["body"].depth_m == pytest.approx(face_m, rel=0.02)
