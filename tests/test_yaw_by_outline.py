"""Yaw from the widths of boxes at several bearings, for a car without motion or body."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import LocalisationConfig, observe_boxes
from birdslam.road_users.placement.uncertain_yaw import HeadingConfig, evaluate_yaws
from birdslam.road_users.state.yaw_by_outline import YawByOutline
from tests.boxes import CAR, cuboid_px, footprint_m
from tests.recordings import KITTI as CAMERA

CONFIG, LOCALISATION = HeadingConfig(), LocalisationConfig()
SIGMA_DEPTH = 0.05


def look(outline: YawByOutline, T_world_ego: SE2, centre_m: tuple[float, float], yaw_rad: float, scale: float) -> None:
    """One frame, in which the car in row 0 is seen; `scale` of its outline lasts."""
    T_ego_car = T_world_ego.between(SE2(*centre_m, yaw_rad))
    corners = footprint_m(T_ego_car, scale * CAR.length_m, scale * CAR.width_m)
    (seen,) = observe_boxes(cuboid_px(corners)[None], np.ones(1), ("car",), CAMERA, CAMERA.ground, LOCALISATION)
    depth: NDArray[np.float64] = np.array([math.log(corners[:, 0].min())])
    outline.predict(0.1, T_world_ego)
    fan = evaluate_yaws([seen], depth, (outline.grid_rad - T_world_ego.yaw_rad)[None], LOCALISATION.reach_rel)
    outline.weigh([0], fan.residual, fan.box_variance, np.array([SIGMA_DEPTH**2]), np.exp(depth))


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
