"""Vehicles in bird's-eye view from boxes that a known world projects."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import (
    LocalisationConfig,
    Observation,
    Place,
    extent_m,
    hidden_edges,
    iou,
    observe_boxes,
    place,
)
from tests.boxes import CAR, car_px
from tests.recordings import KITTI as CAMERA

GROUND = GroundPlane(1.65, 0.01, 0.0)
CONFIG = LocalisationConfig()


def box_of_car(x_m: float, y_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    """The 2-D box of a cuboid of the class's size, its footprint's centre at (x_m, y_m)."""
    return car_px(SE2(x_m, y_m, yaw_rad), ground=GROUND)


def observe(
    boxes: list[np.ndarray], labels: tuple[str, ...] | None = None, scores: list[float] | None = None
) -> list[Observation]:
    names = labels or ("car",) * len(boxes)
    return observe_boxes(np.array(boxes), np.array(scores or [0.9] * len(boxes)), names, CAMERA, GROUND, CONFIG)


def locate(box: np.ndarray, near_m: float, yaw_rad: float = 0.0) -> Place:
    (seen,) = observe([box])
    return place(seen, math.log(near_m), 0.03**2, yaw_rad, CONFIG)


@given(st.floats(10.0, 40.0), st.floats(-0.4, 0.4), st.floats(-3.2, 3.2))
def test_the_centre_follows_from_the_nearest_face_and_the_yaw(x_m: float, slope: float, yaw_rad: float) -> None:
    box = box_of_car(x_m, slope * x_m, yaw_rad)
    (seen,) = observe([box])
    near_m = GROUND.height_m / seen.slope_bottom  # Eq. 1
    along_m, outline_m = extent_m(CAR, yaw_rad, near_m, seen.bearing)
    assert near_m == pytest.approx(x_m - along_m / 2.0, rel=1e-3)
    if not seen.is_cut_at_side:
        assert outline_m / near_m == pytest.approx(seen.tan_width, rel=0.1)
    found = locate(box, near_m, yaw_rad)
    assert found.centre_m == pytest.approx([x_m, slope * x_m], abs=0.06)


@pytest.mark.parametrize(("x_m", "y_m"), [(3.0, 3.0), (3.5, 3.5), (4.0, -4.0), (4.5, 4.5)])
def test_invisible_part_of_a_car_beside_the_ego_counts(x_m: float, y_m: float) -> None:
    border = (CAMERA.cx_px if y_m > 0.0 else CAMERA.width_px - CAMERA.cx_px) / CAMERA.fx_px
    cut = np.clip(box_of_car(x_m, y_m), 0.0, [CAMERA.width_px, CAMERA.height_px] * 2)
    seen_from_m = (abs(y_m) - CAR.width_m / 2.0) / border  # the ray of the border meets its side
    beyond_m = seen_from_m + CAR.length_m / 2.0 - x_m  # as if that were its nearest face
    found = locate(cut, seen_from_m)
    assert abs(found.centre_m[0] - x_m) < 0.3 * beyond_m
    assert abs(found.centre_m[0] - x_m) < 2.0 * math.sqrt(found.cov[0, 0])


def test_box_truncated_at_the_side_uses_its_other_edge() -> None:
    whole = box_of_car(10.0, 7.0)
    assert whole[0] < 0.0 < whole[2]
    cut = np.maximum(whole, 0.0)
    (seen,) = observe([cut])
    assert seen.is_cut_at_side
    found = locate(cut, 10.0 - CAR.length_m / 2.0)
    assert found.centre_m[1] == pytest.approx(7.0, abs=0.05)
    reach_m = CAR.length_m / 2.0
    of_face = (0.03 * (10.0 - reach_m)) ** 2
    assert found.cov[0, 0] == pytest.approx(of_face + (CONFIG.sigma_reach_side_rel * reach_m) ** 2)
    assert found.cov[0, 0] > 3.0 * locate(box_of_car(10.0, 0.0), 10.0 - reach_m).cov[0, 0]


def test_box_truncated_below_has_the_largest_sigma_to_the_centre() -> None:
    cut = np.clip(box_of_car(5.0, 3.5), 0.0, [CAMERA.width_px, CAMERA.height_px] * 2)
    (seen,) = observe([cut])
    assert seen.is_cut_at_side
    assert seen.sigma_cut is not None
    (beside,) = observe([np.maximum(box_of_car(10.0, 7.0), 0.0)])
    assert beside.is_cut_at_side
    assert beside.sigma_cut is None
    assert CONFIG.sigma_reach_cut_rel > CONFIG.sigma_reach_side_rel > CAR.sigma_length_rel
    of_reach = [math.sqrt(place(o, math.log(5.0), 0.0, 0.0, CONFIG).cov[0, 0]) for o in (seen, beside)]
    reach_m = CAR.length_m / 2.0
    assert of_reach == pytest.approx([CONFIG.sigma_reach_cut_rel * reach_m, CONFIG.sigma_reach_side_rel * reach_m])


def test_a_centre_by_one_edge_moves_along_that_edges_line_of_sight() -> None:
    x_m, y_m = 5.6, 4.4  # an oncoming car: the edge that is seen is of its far end
    cut = np.clip(box_of_car(x_m, y_m), 0.0, [CAMERA.width_px, CAMERA.height_px] * 2)
    (seen,) = observe([cut])
    assert seen.is_cut_at_side
    found = locate(cut, x_m - CAR.length_m / 2.0)
    of_edge = (y_m - CAR.width_m / 2.0) / (x_m + CAR.length_m / 2.0)
    assert found.cov[0, 1] / found.cov[0, 0] == pytest.approx(of_edge, rel=0.05)
    farther = locate(cut, x_m - CAR.length_m / 2.0 + 1.0)
    dx_m, dy_m = farther.centre_m - found.centre_m
    assert dy_m / dx_m == pytest.approx(of_edge, rel=0.05)
    assert found.centre_m[1] / found.centre_m[0] > 1.5 * of_edge  # no error is along the centre's own line
    across = found.cov[1, 1] - found.cov[0, 1] ** 2 / found.cov[0, 0]
    of_width_m = CAR.sigma_width_rel * CAR.width_m / 2.0
    assert math.sqrt(across) == pytest.approx(math.hypot(of_width_m, x_m * seen.sigma_right), rel=0.15)


@pytest.mark.parametrize("near_m", [4.0, 8.0, 30.0])
def test_a_centre_moves_with_its_face_and_is_as_certain(near_m: float) -> None:
    reach_m, sigma = CAR.length_m / 2.0, 0.03
    box = box_of_car(near_m + reach_m, 0.0)
    (seen,) = observe([box])
    seen = msgspec.structs.replace(seen, is_cut_at_side=False)
    here, there = (place(seen, math.log(near_m) + d, sigma**2, 0.0, CONFIG) for d in (-1e-4, 1e-4))
    moved = (there.centre_m[0] - here.centre_m[0]) / 2e-4  # by the log of the face's depth
    of_length = (CAR.sigma_length_rel * reach_m) ** 2
    assert here.cov[0, 0] == pytest.approx((moved * sigma) ** 2 + of_length, rel=1e-3)


def test_edges_occluded_by_a_nearer_box_have_larger_sigma() -> None:
    far, near = np.array([500.0, 170.0, 600.0, 220.0]), np.array([560.0, 160.0, 700.0, 300.0])
    np.testing.assert_array_equal(hidden_edges(np.array([far, near])), [[False, True, True], [False] * 3])
    alone, (_, covered) = observe([far])[0], observe([near, far])
    assert covered.sigma_right > 1.5 * alone.sigma_right
    assert covered.sigma_bottom > 1.2 * alone.sigma_bottom
    assert (covered.sigma_left, covered.sigma_top) == (alone.sigma_left, alone.sigma_top)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_edges_of_a_low_score_box_have_larger_sigma(score: float, other: float) -> None:
    box = box_of_car(20.0, 2.0)[None]
    edges = {}
    for each in (score, other):
        (seen,) = observe_boxes(box, np.array([each]), ("car",), CAMERA, GROUND, CONFIG)
        edges[each] = np.array([seen.sigma_left, seen.sigma_right, seen.sigma_top, seen.sigma_bottom])
    assert (edges[min(score, other)] >= edges[max(score, other)]).all()
    (sure,) = observe_boxes(box, np.ones(1), ("car",), CAMERA, GROUND, CONFIG)
    assert edges[score][3] / sure.sigma_bottom == pytest.approx(1.0 + 2.0 * max(0.0, 0.9 - score))


def test_sigma_grows_with_distance() -> None:
    assert locate(box_of_car(35.0, 3.0), 33.0).cov[0, 0] > 4.0 * locate(box_of_car(10.0, 0.0), 8.0).cov[0, 0]


def test_boxes_without_road_position_are_left_out() -> None:
    flying, flat = np.array([600.0, 50.0, 700.0, 120.0]), np.array([600.0, 200.0, 600.0, 250.0])
    assert observe([flying]) == []
    assert observe([flat]) == []
    assert observe([box_of_car(10.0, 0.0)], labels=("person",)) == []


def test_vehicle_with_two_labels_is_one_detection() -> None:
    box = box_of_car(12.0, 0.0)
    (seen,) = observe([box, box + 1.0], labels=("car", "truck"), scores=[0.6, 0.8])
    assert seen.label == "truck"


def test_iou() -> None:
    a = np.array([[0.0, 0.0, 2.0, 2.0]])
    np.testing.assert_allclose(iou(a, np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6.0]])), [[1.0, 1 / 3, 0.0]])
    assert math.isfinite(float(iou(a * 0.0, a * 0.0)[0, 0]))
