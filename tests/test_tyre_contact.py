"""Boxes that end at the tyres: Eq. 1 on their lower edge gives the tyre, and `bottom_at_face` the nearest face."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from birdslam.road_users.placing import Assignment, Placing
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from tests.test_frontend import CAMERA

CONFIG = LocalisationConfig()
CAR = DIMENSIONS["car"]
ends = st.floats(4.0, 80.0)  # depth of the nearest face
yaws = st.floats(-math.pi, math.pi)
kinds = st.sampled_from(sorted(DIMENSIONS))
heights = st.floats(1.0, 3.0)


def seen(slope: float, dimensions: Dimensions = CAR, lower_edge: LowerEdge = "tyres") -> Observation:
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
    assert -1e-9 <= nearer_m <= CONFIG.overhang_rel * CAR.length_m + 1e-9


@given(ends, yaws, heights)
def test_sigma_scales_with_the_slope(face_m: float, yaw_rad: float, height_m: float) -> None:
    slope, step = height_m / face_m, 1e-7
    low, here, high = (bottom_at_face(seen(s), yaw_rad, height_m, CONFIG) for s in (slope - step, slope, slope + step))
    derivative = (high.slope_bottom - low.slope_bottom) / (2.0 * step)
    at_kink = abs(CONFIG.overhang_rel * CAR.length_m * abs(math.cos(yaw_rad)) * slope - CONFIG.clearance_m) < 1e-5
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
            observation = seen(lowest_slope(face_m, 0.0, CAR, height_m))
        top = (height_m - CAR.height_m) / face_m
        half = CAR.width_m / face_m / 2.0
        observation = msgspec.structs.replace(
            observation, slope_top=top, left=half, right=-half, sigma_bottom=0.002, sigma_top=0.002
        )
        assignment = Assignment(0, None, observation)
        (found[lower_edge],) = placing.locate([assignment], SE2())
    assert found["tyres"].depth_m == pytest.approx(found["body"].depth_m, rel=0.005)
    assert found["body"].depth_m == pytest.approx(face_m, rel=0.02)
