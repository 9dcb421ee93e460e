"""Motion and sizes of vehicles from the growth of their boxes, by the filter of all road users."""

import copy
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_boxes import BEARING, BOTTOM, WIDE, Boxes, Cases, edge_covariance, expected_boxes
from birdslam.road_users.models.user_filter import SIGMA_SCALE_REL, GrownSize, RoadStep, UserFilter
from birdslam.road_users.models.user_state import merge_mixture
from birdslam.road_users.placement.vehicle_boxes import (
    ITERATIONS,
    KINDS,
    SIDE_OUTLIER_RATIO,
    SIGMA_ODD_REL,
    SIGMA_SIDE_OUTLIER_REL,
    VEHICLE,
    vehicle_kinds,
)

HEIGHT_M = 1.65  # of the camera
REACH_M = 2.0
CLASS_M = 1.53
SIGMAS = (0.08, 0.2)
SIZES = np.array([[(CLASS_M, SIGMAS[0]), (CLASS_M, SIGMA_ODD_REL)]])
ROAD = RoadProfile(HEIGHT_M)
STEP = RoadStep(0.0, 1.0, 0.98)


def measured(at: np.ndarray, height_m: float, noise: np.ndarray, hidden: float = 0.0, face_m: float = 1.0) -> Boxes:
    """Of one vehicle whose centre is at (2,) in ego.

    `noise` (4,) is standard normal, of middle, lower and upper edge and log width; `hidden` is a fraction of the width,
    `face_m` the 1-sigma of the depth of its edges.
    """
    depth = float(at[0]) - REACH_M
    tall, wide = height_m / depth, 1.0 / depth
    sigmas = np.array([0.001, 0.0005, 0.0005, 0.04])
    middle, lower, upper, width = sigmas * noise
    z = [
        at[1] / at[0] - hidden * wide / 2.0 + middle,
        HEIGHT_M / depth + lower,
        math.log(tall + lower - upper),
        math.log(wide * (1.0 - hidden)) + width,
    ]
    side = np.zeros((1, 3, 4))
    side[:, 1:, WIDE] = SIGMA_SIDE_OUTLIER_REL
    side[:, 1:, BEARING] = SIGMA_SIDE_OUTLIER_REL * wide / 2.0 * np.array([1.0, -1.0])
    prior = np.array([[1.0 - 2.0 * SIDE_OUTLIER_RATIO, SIDE_OUTLIER_RATIO, SIDE_OUTLIER_RATIO]])
    return Boxes(
        z=np.array([z]),
        R=edge_covariance(np.array([tall]), sigmas[None]),
        reach_m=np.array([REACH_M]),
        top_m=np.zeros(1),
        cases=Cases(prior, np.zeros((1, 3, 4)), side, np.zeros((3, 1))),
        direction_rad=np.zeros(1),
        outline_var=np.zeros(1),
        face_var=np.array([(face_m / depth) ** 2]),
    )


class Road:
    """An ego at `ego_mps` and one vehicle at (x_m, y_m) in world; errors of boxes are white unless `errors_last`."""

    def __init__(
        self,
        height_m: float,
        x_m: float = 70.0,
        y_m: float = 4.0,
        ego_mps: float = 9.0,
        seed: int = 0,
        hz: float = 10.0,
        errors_last: bool = False,
    ) -> None:
        white = [msgspec.structs.replace(k, box_memory_s=1.0 / hz, view_memory_s=1.0 / hz) for k in KINDS]
        self.users = UserFilter(KINDS if errors_last else white)
        self.errors_last = errors_last
        self.height_m, self.ego_mps, self.dt_s = height_m, ego_mps, 1.0 / hz
        self.rng = np.random.default_rng(seed)
        self.at, self.ego_m = np.array([x_m, y_m]), 0.0
        self.cases = np.zeros(3)

    @property
    def standing(self) -> float:
        return float(self.users.stationary_probability()[0])

    def drive(self, seconds: float, mps: tuple[float, float] = (0.0, 0.0), hidden: float = 0.0) -> GrownSize:
        for _ in range(round(seconds / self.dt_s)):
            T_world_ego = SE2(self.ego_m, 0.0, 0.0)
            noise = np.zeros(4) if self.errors_last else self.rng.standard_normal(4)
            face_m = 1.0 if self.errors_last else 0.0
            boxes = measured(self.at - [self.ego_m, 0.0], self.height_m, noise, hidden, face_m)
            self.users.predict(self.dt_s, T_world_ego, None, STEP)
            if not len(self.users):
                kind = vehicle_kinds((self.at - [self.ego_m, 0.0])[None])
                self.users.add(kind, boxes, SIZES, np.array([SIGMAS[1]]), T_world_ego)
            (self.cases,) = self.users.correct([0], boxes, T_world_ego, ROAD, ITERATIONS)
            self.at = self.at + np.array(mps) * self.dt_s
            self.ego_m += self.ego_mps * self.dt_s
        return self.users.sizes_by_growth([0], boxes, T_world_ego)


def height(learned: GrownSize) -> float:
    """The posterior mean with the class prior."""
    gain = SIGMAS[0] ** 2 / (SIGMAS[0] ** 2 + learned.variance[0]) * learned.stationary[0]
    return CLASS_M * math.exp(float(gain * (learned.log_height[0] - math.log(CLASS_M))))


@pytest.mark.parametrize("height_m", [1.40, 1.53, 1.70])
def test_growth_determines_size_of_a_parked_car(height_m: float) -> None:
    road = Road(height_m)
    learned = road.drive(5.5)
    assert road.standing > 0.95
    assert height(learned) == pytest.approx(height_m, rel=0.03)


def test_unusual_size_of_a_stationary_vehicle_is_found() -> None:
    road = Road(2.45)
    learned = road.drive(5.5)
    assert road.standing > 0.9
    assert learned.log_height[0] == pytest.approx(math.log(2.45), abs=0.25)


@pytest.mark.parametrize("mps", [(9.0, 0.0), (12.0, 0.0), (-9.0, 0.0), (0.0, 4.0)])
def test_moving_vehicle_keeps_the_class_size(mps: tuple[float, float]) -> None:
    road = Road(1.53, x_m=60.0)
    learned = road.drive(2.5, mps)
    assert road.standing < 0.1
    assert height(learned) == pytest.approx(1.53, rel=0.03)
    assert learned.speed_mps[0] == pytest.approx(math.hypot(*mps), rel=0.3)


@pytest.mark.parametrize("height_m", [1.53, 1.65, 1.75])
@pytest.mark.parametrize(("mps", "stands"), [(0.0, True), (2.0, False), (3.0, False), (-3.0, False)])
def test_slow_queue_is_not_taken_for_tall_stationary_cars(height_m: float, mps: float, stands: bool) -> None:
    """Its box grows like that of a taller stationary car; class and ground exclude this."""
    road = Road(height_m, x_m=45.0, ego_mps=8.0, errors_last=True)
    road.drive(4.0 if mps >= 0.0 else 1.5, (mps, 0.0))
    assert (road.standing > 0.9) == stands
    assert (road.standing < 0.3) == (not stands)


def test_far_beside_the_road_constant_bearing_means_stationary() -> None:
    """Without a direction of traffic, standstill is found sooner."""
    aside = Road(1.53, x_m=60.0, y_m=20.0)
    aside.drive(1.5)
    beside = Road(1.53, x_m=60.0, y_m=4.0)
    beside.drive(1.5)
    assert aside.standing > beside.standing


def test_starting_and_stopping_vehicles() -> None:
    road = Road(1.53, x_m=60.0, ego_mps=4.0)
    road.drive(4.0)
    assert road.standing > 0.9
    road.drive(3.0, (5.0, 0.0))
    assert road.standing < 0.1
    road.drive(6.0)
    assert road.standing > 0.5


def test_partly_hidden_parked_car_stays_stationary() -> None:
    road = Road(1.53, x_m=40.0, y_m=6.0, errors_last=True)
    road.drive(1.5)
    assert road.cases[0] > 0.9
    road.drive(0.5, hidden=0.4)
    assert road.standing > 0.5
    assert road.cases[1] > 0.9
    assert road.cases[2] < 0.05


def test_fully_visible_car_has_no_outlying_side() -> None:
    road = Road(1.53, x_m=40.0, y_m=6.0, errors_last=True)
    road.drive(2.0)
    assert road.standing > 0.9
    assert (road.cases[1:] < SIDE_OUTLIER_RATIO).all()


def test_covariance_is_consistent() -> None:
    """Parked vehicles with errors of road, odometry and boxes, as the priors state."""
    squared = []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        size, tilt, offset, scale = rng.standard_normal(4)
        height_m = CLASS_M * math.exp(SIGMAS[0] * size)
        offset_m = math.hypot(VEHICLE.sigma_offset_m, VEHICLE.sigma_crown_rad * 4.0) * offset
        users, noise = UserFilter(KINDS), rng.standard_normal(4)
        for k in range(40):
            noise = 0.6 * noise + 0.8 * rng.standard_normal(4)  # 4 frames, `box_memory_s`, are as good as one
            at, T_world_ego = np.array([70.0 - 0.9 * k, 4.0]), SE2(0.9 * k * (1.0 + SIGMA_SCALE_REL * scale), 0.0, 0.0)
            boxes = measured(at, height_m, noise, face_m=0.0)
            boxes.z[0, BOTTOM] += offset_m / (at[0] - REACH_M) - VEHICLE.sigma_tilt_rad * tilt
            users.predict(0.1, T_world_ego, None, STEP)
            if not k:
                users.add([0], boxes, SIZES, np.array([SIGMAS[1]]), T_world_ego)
            users.correct([0], boxes, T_world_ego, ROAD, ITERATIONS)
        learned = users.sizes_by_growth([0], boxes, T_world_ego)
        squared.append((learned.log_height[0] - math.log(height_m)) ** 2 / learned.variance[0])
    assert 0.4 < np.mean(squared) < 1.6


@pytest.mark.parametrize(("mps", "stands"), [(0.0, True), (1.8, False)])
def test_slow_vehicle_straight_ahead_is_not_taken_for_a_stationary_one(mps: float, stands: bool) -> None:
    road = Road(1.70, x_m=16.0, y_m=0.3, ego_mps=2.3)
    learned = road.drive(4.0, (mps, 0.0))
    assert (road.standing > 0.9) == stands
    assert (road.standing < 0.1) == (not stands)
    assert height(learned) == pytest.approx(1.70 if stands else CLASS_M, rel=0.03)


@given(st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4), st.floats(0.01, 0.99))
@settings(max_examples=25)
def test_update_is_the_mixture_of_its_cases(noise: list[float], probability: float) -> None:
    boxes = measured(np.array([30.0, 2.0]), CLASS_M, np.array(noise))
    users = UserFilter(KINDS)
    users.add([0], boxes, SIZES, np.array([SIGMAS[1]]), SE2())
    prior, sigma = np.array([[1.0 - probability, probability]]), boxes.cases.sigma[:, :2]
    both = Cases(prior, np.zeros((1, 2, 4)), sigma, np.zeros((2, 1)))
    each = [Cases(np.ones((1, 1)), np.zeros((1, 1, 4)), sigma[:, k : k + 1], np.zeros((1, 1))) for k in range(2)]

    def corrected(cases: Cases) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        after = copy.deepcopy(users)
        (share,) = after.correct([0], replace(boxes, cases=cases), SE2(), ROAD)
        moments = after.moments()
        sizes = [*range(2), *range(4, 10)]  # all but the velocity, which is that of the motions that move
        return share, moments.mean[0, sizes], moments.cov[0][np.ix_(sizes, sizes)]

    share, mean, cov = corrected(both)
    (_, mean_0, cov_0), (_, mean_1, cov_1) = (corrected(case) for case in each)
    expected_mean, expected_cov = merge_mixture(np.stack([mean_0, mean_1]), np.stack([cov_0, cov_1]), share)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-3, atol=1e-4)


@given(st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10), st.floats(0.0, 3.0))
@settings(max_examples=25)
def test_jacobian_is_that_of_the_expected_box(draws: list[float], top_m: float) -> None:
    x = np.array([30.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0]) + np.array(draws) * [9, 5, 1, 1, 0.2, *[0.05] * 5]
    args = np.array([REACH_M]), np.array([top_m]), SE2(1.0, 2.0, 0.1), RoadProfile(HEIGHT_M, 1e-4)
    _, J = expected_boxes(x[None, None], *args)
    steps = 1e-6 * np.eye(10)
    after, before = (expected_boxes((x + sign * steps)[None], *args)[0][0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(J[0, 0], ((after - before) / 2e-6).T, atol=1e-6)


def test_frame_rate_adds_no_information_to_correlated_errors() -> None:
    variances = [float(Road(1.53, hz=hz, errors_last=True).drive(4.0).variance[0]) for hz in (10.0, 30.0)]
    assert variances[0] == pytest.approx(variances[1], rel=0.1)


def test_without_motion_no_size_is_learned() -> None:
    assert height(Road(1.7, ego_mps=0.0).drive(5.0)) == pytest.approx(CLASS_M, rel=0.03)


def test_dropped_tracks_are_removed_and_others_kept() -> None:
    road = Road(1.53)
    road.drive(1.0)
    before = road.standing
    boxes = measured(np.array([20.0, 0.0]), CLASS_M, np.zeros(4))
    road.users.add([0], boxes, SIZES, np.array([SIGMAS[1]]), SE2())
    road.users.keep_rows([0])
    assert road.standing == before
    assert len(road.users) == 1
    road.users.keep_rows([])
    road.users.predict(0.1, SE2(), np.eye(3), STEP)
    assert road.users.correct([], boxes.take([]), SE2(), ROAD).shape == (0, 3)


@given(st.lists(st.tuples(*[st.floats(-8, 8)] * 4), min_size=3, max_size=25))
@settings(max_examples=25)
def test_outliers_do_not_change_weights_and_covariances(noise: list[tuple[float, float, float, float]]) -> None:
    users = UserFilter(KINDS)
    for k, draws in enumerate(noise):
        ego = SE2(0.5 * k, 0.0, 0.0)
        boxes = measured(np.array([30.0 - 0.5 * k, 2.0]), CLASS_M, np.array(draws))
        users.predict(0.1, ego, np.diag([1e-3, 1e-4, 1e-7]), STEP)
        if not len(users):
            users.add([0], boxes, SIZES, np.array([SIGMAS[1]]), ego)
        cases = users.correct([0], boxes, ego, ROAD)
        assert cases.sum() == pytest.approx(1.0, abs=1e-6)
        moments, learned = users.moments(), users.sizes_by_growth([0], boxes, ego)
        assert (np.linalg.eigvalsh(moments.cov[0]) > -1e-12).all()
        assert (learned.variance > 0.0).all()
        assert np.isfinite(learned.log_height).all()
