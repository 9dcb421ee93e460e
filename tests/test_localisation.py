"""Vehicles in bird's-eye view from boxes that a known world projects."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam import bev
from birdslam.camera import Camera, GroundPlane
from birdslam.localisation import LocalisationConfig, iou, localise

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
GROUND = GroundPlane(1.65, 0.01, 0.0)
CONFIG = LocalisationConfig()


def box_of_car(
    x_m: float, y_m: float, length_m: float = 4.0, width_m: float = 1.7, height_m: float = 1.5
) -> np.ndarray:
    """The 2-D box of a cuboid headed like the ego, its footprint's centre at (x_m, y_m)."""
    length_m, width_m, height_m = 4.0, 1.7, 1.5
    corners = [
        (x_m + sx * length_m / 2, y_m + sy * width_m / 2, z)
        for sx in (-1, 1)
        for sy in (-1, 1)
        for z in (0.0, height_m)
    ]
    px = bev.ego_to_pixel(CAMERA, GROUND, np.array(corners))
    return np.array([*px.min(axis=0), *px.max(axis=0)])


def locate(boxes: list[np.ndarray], labels: tuple[str, ...] | None = None, scores: list[float] | None = None):
    return localise(
        np.array(boxes),
        np.array(scores or [0.9] * len(boxes)),
        labels or ("car",) * len(boxes),
        CAMERA,
        GROUND,
        0.002,
        CONFIG,
    )


@given(st.floats(8.0, 40.0), st.floats(-0.25, 0.25))
def test_a_car_ahead_is_found_at_its_centre(x_m: float, slope: float) -> None:
    y_m = slope * x_m
    (seen,) = locate([box_of_car(x_m, y_m)])
    assert seen.near_m[0] == pytest.approx(x_m - 2.0, rel=0.02)
    assert seen.centre_m[0] == pytest.approx(x_m, rel=0.02)
    assert seen.centre_m[1] == pytest.approx(y_m, abs=0.05)
    error = seen.centre_m - [x_m, y_m]
    assert error @ np.linalg.solve(seen.cov, error) < 9.0


def test_farther_is_less_certain() -> None:
    near, far = sorted(locate([box_of_car(10.0, 0.0), box_of_car(35.0, 3.0)]), key=lambda o: o.centre_m[0])
    assert far.cov[0, 0] > 4.0 * near.cov[0, 0]


def test_a_box_cut_by_the_image_is_less_certain() -> None:
    whole = box_of_car(8.0, 4.0)
    cut = whole.copy()
    cut[0] = 0.0
    assert locate([cut])[0].cov[1, 1] > 4.0 * locate([whole])[0].cov[1, 1]


def test_what_has_no_place_on_the_road_is_left_out() -> None:
    flying = np.array([600.0, 50.0, 700.0, 120.0])
    assert locate([flying]) == []
    assert locate([box_of_car(10.0, 0.0)], labels=("person",)) == []


def test_one_vehicle_with_two_labels_is_one() -> None:
    box = box_of_car(12.0, 0.0)
    (seen,) = locate([box, box + 1.0], labels=("car", "truck"), scores=[0.6, 0.8])
    assert seen.label == "truck"


def test_iou() -> None:
    a = np.array([[0.0, 0.0, 2.0, 2.0]])
    np.testing.assert_allclose(iou(a, np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6.0]])), [[1.0, 1 / 3, 0.0]])
    assert math.isfinite(float(iou(a * 0.0, a * 0.0)[0, 0]))
