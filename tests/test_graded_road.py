"""The synthetic street with a grade: its geometry matches its stated truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera
from tests.graded_road import GradedRoad

CAMERA = Camera(320, 120, 190.0, 190.0, 160.3, 55.2, height_m=1.65, pitch_rad=0.01)


def test_a_level_road_is_eq_1() -> None:
    road = GradedRoad(CAMERA, 0.06)
    px = np.array([[CAMERA.cx_px, road.pixel_row(road.stand(0.0), 15.0)]])
    ahead_m = bev.pixel_to_ego(CAMERA, CAMERA.ground, px)[0, 0]
    assert ahead_m == pytest.approx(15.0, rel=1e-6)


def test_the_grade_and_the_crest() -> None:
    road = GradedRoad(CAMERA, 0.06)
    held = road.stand(75.0)  # on the rise
    assert held.pitch_rad == pytest.approx(0.01 - math.atan(0.06), abs=1e-4)
    ahead_m = bev.pixel_to_ego(
        CAMERA, CAMERA.ground, np.array([[CAMERA.cx_px, road.pixel_row(held, 10.0)]])
    )[0, 0]  # fmt: skip
    # Along the slope it is farther than on the map; and the camera's foot lies uphill of the camera.
    foot_m = CAMERA.height_m * math.sin(math.atan(0.06))
    assert ahead_m == pytest.approx((10.0 - foot_m) * math.hypot(1.0, 0.06), abs=0.01)
    assert float(road.up_m(road.length_m)) == pytest.approx(float(road.up_m(0.0)), abs=0.01)


def test_the_picture_shows_the_road_where_it_is() -> None:
    road, rng = GradedRoad(CAMERA, 0.06), np.random.default_rng(0)
    stand = road.stand(0.0)
    image = road.render(stand, rng)
    assert image.shape == (CAMERA.height_px, CAMERA.width_px)
    columns = slice(150, 170)
    far = round(road.pixel_row(stand, 100.0))
    assert image[: far - 12, columns].mean() > 195.0  # the sky over it
    assert image[far + 8 :, columns].mean() < 150.0
