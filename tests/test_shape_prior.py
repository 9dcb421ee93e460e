"""The shape prior finds the pose and the size that its own wireframe was drawn with."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.bench.baselines.shape_prior import fitted, project
from birdslam.geometry.se2 import SE2
from birdslam.types import Measurements, VehicleEdge
from tests.recordings import KITTI as CAMERA

COV = (0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.04)


def sight(T: SE2, length_m: float, width_m: float, height_m: float, told: SE2 | None = None) -> VehicleEdge:
    """An edge with the box of a wireframe, told to stand at `told`."""
    drawn = np.array([[T.x_m, T.y_m, T.yaw_rad, math.log(length_m), math.log(width_m), math.log(height_m)]])
    (left, right, high), bottom = project(drawn, CAMERA)[0].tolist(), 300.0
    return VehicleEdge(
        vehicle=1,
        frame=0,
        T_ego_vehicle=told or T,
        cov=COV,
        box_px=(left, bottom - high, right, bottom),
        length_m=3.9,
        width_m=1.63,
        log_height=math.log(1.53),
        sigma_log_height=0.08,
    )


def fit(edge: VehicleEdge) -> VehicleEdge:
    log = [Measurements(frame_id=0, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, cv=(edge,))]
    return fitted(log, CAMERA)[0].cv[0]


@given(st.floats(10.0, 50.0), st.floats(-0.25, 0.25), st.floats(-math.pi, math.pi))
def test_what_is_drawn_as_it_is_told_stays(away_m: float, bearing_rad: float, yaw_rad: float) -> None:
    T = SE2(away_m, away_m * math.tan(bearing_rad), yaw_rad)
    found = fit(sight(T, 3.9, 1.63, 1.53)).T_ego_vehicle
    assert found.between(T).log() == pytest.approx(np.zeros(3), abs=1e-6)


@given(st.floats(10.0, 50.0), st.floats(-0.25, 0.25), st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3))
def test_a_bearing_that_is_off_is_set_right_by_the_box(
    away_m: float, bearing_rad: float, yaw_rad: float, off_m: float
) -> None:
    T = SE2(away_m, away_m * math.tan(bearing_rad), yaw_rad)
    told = SE2(T.x_m, T.y_m + off_m, yaw_rad)
    found = fit(sight(T, 3.9, 1.63, 1.53, told)).T_ego_vehicle
    across = [math.atan2(p.y_m, p.x_m) * away_m for p in (found, T)]
    assert across[0] == pytest.approx(across[1], abs=0.06 + 0.2 * abs(off_m))


def test_a_longer_car_seen_from_the_side_is_found_longer() -> None:
    found = fit(sight(SE2(20.0, 0.0, math.pi / 2), 4.6, 1.63, 1.53))
    assert 4.3 < found.length_m < 4.6
    assert found.T_ego_vehicle.yaw_rad == pytest.approx(math.pi / 2, abs=0.02)


def test_a_higher_box_is_a_higher_or_a_nearer_car() -> None:
    """By the sigmas of height (8 %) and distance (0.5 m of 20): mostly higher."""
    found = fit(sight(SE2(20.0, 0.0, 0.0), 3.9, 1.63, 1.53 * 1.05))
    assert 19.4 < found.T_ego_vehicle.x_m < 20.0


def test_edges_that_the_image_cuts_say_nothing() -> None:
    T = SE2(8.0, 0.0, 0.3)
    edge = sight(T, 3.9, 1.63, 1.53)
    left, top, right, bottom = edge.box_px
    cut = replace(edge, box_px=(0.0, top, right, bottom))
    found = fit(cut).T_ego_vehicle
    assert math.hypot(found.x_m - T.x_m, found.y_m - T.y_m) < 0.05
    assert left > 4.0
