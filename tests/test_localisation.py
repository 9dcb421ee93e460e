"""Vehicles in bird's-eye view from boxes that a known world projects."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam import bev
from birdslam.camera import Camera, GroundPlane
from birdslam.localisation import (
    DIMENSIONS,
    LocalisationConfig,
    Observation,
    Outline,
    Place,
    fuse,
    iou,
    localise,
    place,
)

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
GROUND = GroundPlane(1.65, 0.01, 0.0)
CONFIG = LocalisationConfig()
CAR = DIMENSIONS["car"]


def box_of_car(x_m: float, y_m: float, height_m: float = CAR.height_m, length_m: float = CAR.length_m) -> np.ndarray:
    """The 2-D box of a cuboid headed like the ego, its footprint's centre at (x_m, y_m)."""
    half_length_m, half_width_m = length_m / 2, CAR.width_m / 2
    corners = [
        (x_m + sx * half_length_m, y_m + sy * half_width_m, z)
        for sx in (-1, 1)
        for sy in (-1, 1)
        for z in (0.0, height_m)
    ]
    px = bev.ego_to_pixel(CAMERA, GROUND, np.array(corners))
    return np.array([*px.min(axis=0), *px.max(axis=0)])


def observe(
    boxes: list[np.ndarray], labels: tuple[str, ...] | None = None, scores: list[float] | None = None
) -> list[Observation]:
    names = labels or ("car",) * len(boxes)
    return localise(np.array(boxes), np.array(scores or [0.9] * len(boxes)), names, CAMERA, GROUND, 0.002, CONFIG)


def locate(box: np.ndarray, outline: Outline | None = None) -> Place:
    (seen,) = observe([box])
    return place(seen, outline or Outline.of_class(CAR), 0.0, CONFIG)[0]


@given(st.floats(9.0, 40.0), st.floats(-0.25, 0.25))
def test_a_car_is_found_at_its_centre(x_m: float, slope: float) -> None:
    y_m = slope * x_m
    (seen,) = observe([box_of_car(x_m, y_m)])
    assert seen.depth_m == pytest.approx(x_m - 2.0, rel=0.02)  # Eq. 1: the nearest face
    found = locate(box_of_car(x_m, y_m))
    assert found.centre_m[0] == pytest.approx(x_m, rel=0.04)
    assert found.centre_m[1] == pytest.approx(y_m, abs=0.05 + 0.04 * abs(y_m))
    error = found.centre_m - [x_m, y_m]
    assert error @ np.linalg.solve(found.cov, error) < 9.0


@given(st.floats(9.0, 30.0), st.floats(1.3, 1.8))
def test_a_height_unlike_its_class_is_learned(x_m: float, height_m: float) -> None:
    outline = Outline.of_class(CAR)
    for k in range(25):
        (seen,) = observe([box_of_car(x_m + 0.1 * k, 0.0, height_m, length_m=0.0)])  # a board: one depth
        _, outline = place(seen, outline, 0.0, CONFIG)
    assert math.exp(outline.log_height) == pytest.approx(height_m, rel=0.04)


def test_a_box_cut_at_the_bottom_is_placed_by_what_was_learned() -> None:
    outline = Outline.of_class(CAR)
    for x_m in np.arange(12.0, 7.9, -0.2):
        (seen,) = observe([box_of_car(x_m, 0.0)])
        _, outline = place(seen, outline, 0.0, CONFIG)
    box = box_of_car(6.0, 0.0)
    assert box[3] > CAMERA.height_px
    box[3] = CAMERA.height_px - 1.0
    (cut,) = observe([box])
    assert cut.depth_m > 1.25 * 4.0  # Eq. 1 alone is fooled
    assert locate(box, outline).depth_m == pytest.approx(4.0, rel=0.08)


def test_farther_is_less_certain() -> None:
    assert locate(box_of_car(35.0, 3.0)).cov[0, 0] > 4.0 * locate(box_of_car(10.0, 0.0)).cov[0, 0]


def test_a_box_cut_at_the_side_is_less_certain_across() -> None:
    whole = box_of_car(9.0, 4.0)
    cut = whole.copy()
    cut[0] = 0.0
    assert locate(cut).cov[1, 1] > 4.0 * locate(whole).cov[1, 1]


def test_what_has_no_place_on_the_road_is_left_out() -> None:
    flying, flat = np.array([600.0, 50.0, 700.0, 120.0]), np.array([600.0, 200.0, 600.0, 250.0])
    assert observe([flying]) == []
    assert observe([flat]) == []
    assert observe([box_of_car(10.0, 0.0)], labels=("person",)) == []


def test_one_vehicle_with_two_labels_is_one() -> None:
    box = box_of_car(12.0, 0.0)
    (seen,) = observe([box, box + 1.0], labels=("car", "truck"), scores=[0.6, 0.8])
    assert seen.label == "truck"


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(0.01, 10)), min_size=1, max_size=4))
def test_fusion_is_surer_than_its_parts_and_lies_between_them(estimates: list[tuple[float, float]]) -> None:
    mean, variance = fuse(*estimates)
    assert variance <= min(v for _, v in estimates) * (1 + 1e-9)
    assert min(m for m, _ in estimates) - 1e-9 <= mean <= max(m for m, _ in estimates) + 1e-9


def test_iou() -> None:
    a = np.array([[0.0, 0.0, 2.0, 2.0]])
    np.testing.assert_allclose(iou(a, np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6.0]])), [[1.0, 1 / 3, 0.0]])
    assert math.isfinite(float(iou(a * 0.0, a * 0.0)[0, 0]))
