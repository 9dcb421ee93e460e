"""Motion and sizes of vehicles from the growth of their boxes, by the filter of all road users."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_boxes import BEARING, WIDE, Boxes, Cases, edge_covariance
from birdslam.road_users.models.user_filter import GrownSize, RoadStep, UserFilter
from birdslam.road_users.placement.vehicle_boxes import (
    KINDS,
    SIDE_OUTLIER_RATIO,
    SIGMA_ODD_REL,
    SIGMA_SIDE_OUTLIER_REL,
    vehicle_kinds,
)

HEIGHT_M = 1.65  # of the camera
REACH_M = 2.0
CLASS_M = 1.53
SIGMAS = (0.08, 0.2)
SIZES = np.array([[(CLASS_M, SIGMAS[0]), (CLASS_M, SIGMA_ODD_REL)]])
ROAD = RoadProfile(HEIGHT_M)
STEP = RoadStep(0.0, 1.0, 0.98)


def measured(at: np.ndarray, height_m: float, noise: np.ndarray, hidden: float = 0.0) -> Boxes:
    """Of one vehicle whose centre is at (2,) in ego; `noise` (4,) standard normal, `hidden` a share of its width."""
    depth = float(at[0]) - REACH_M
    tall, wide = height_m / depth, 1.0 / depth
    sigma = np.array([0.001, 0.0005, 0.03, 0.04])
    values = np.array([at[1] / at[0] - hidden * wide / 2.0, HEIGHT_M / depth, math.log(tall), math.log(wide)])
    values[WIDE] += math.log(1.0 - hidden)
    side = np.zeros((1, 3, 4))
    side[:, 1:, WIDE] = SIGMA_SIDE_OUTLIER_REL
    side[:, 1:, BEARING] = SIGMA_SIDE_OUTLIER_REL * wide / 2.0 * np.array([1.0, -1.0])
    prior = np.array([[1.0 - 2.0 * SIDE_OUTLIER_RATIO, SIDE_OUTLIER_RATIO, SIDE_OUTLIER_RATIO]])
    return Boxes(
        z=(values + sigma * noise)[None],
        R=edge_covariance(np.array([tall]), np.array([[0.001, 0.0005, 0.0005, 0.04]])),
        reach_m=np.array([REACH_M]),
        top_m=np.zeros(1),
        cases=Cases(prior, np.zeros((1, 3, 4)), side, np.zeros((3, 1))),
        direction_rad=np.zeros(1),
        outline_var=np.zeros(1),
        face_var=np.array([depth**-2.0]),
    )


class Road:
    """An ego at `ego_mps` and one vehicle at (x_m, y_m) in world."""

    def __init__(
        self,
        height_m: float,
        x_m: float = 70.0,
        y_m: float = 4.0,
        ego_mps: float = 9.0,
        seed: int = 0,
        hz: float = 10.0,
    ) -> None:
        self.users = UserFilter(KINDS)
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
            noise = 0.3 * self.rng.standard_normal(4)  # errors of boxes last
            boxes = measured(self.at - [self.ego_m, 0.0], self.height_m, noise, hidden)
            self.users.predict(self.dt_s, T_world_ego, None, STEP)
            if not len(self.users):
                kind = vehicle_kinds((self.at - [self.ego_m, 0.0])[None])
                self.users.add(kind, boxes, SIZES, np.array([SIGMAS[1]]), T_world_ego)
            (self.cases,) = self.users.correct([0], boxes, T_world_ego, ROAD)
            self.at = self.at + np.array(mps) * self.dt_s
            self.ego_m += self.ego_mps * self.dt_s
        return self.users.sizes_by_growth([0])


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
    road = Road(height_m, x_m=45.0, ego_mps=8.0)
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
    road = Road(1.53, x_m=40.0, y_m=6.0)
    road.drive(1.5)
    assert road.cases[0] > 0.9
    road.drive(0.5, hidden=0.4)
    assert road.standing > 0.5
    assert road.cases[1] > 0.9
    assert road.cases[2] < 0.05


def test_frame_rate_adds_no_information_to_correlated_errors() -> None:
    variances = [float(Road(1.53, hz=hz).drive(4.0).variance[0]) for hz in (10.0, 30.0)]
    assert variances[0] == pytest.approx(variances[1], rel=0.1)


def test_without_motion_no_size_is_learned() -> None:
    assert height(Road(1.7, ego_mps=0.0).drive(5.0)) == pytest.approx(CLASS_M, rel=0.06)


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
        moments, learned = users.moments(), users.sizes_by_growth([0])
        assert (np.linalg.eigvalsh(moments.cov[0]) > -1e-12).all()
        assert (learned.variance > 0.0).all()
        assert np.isfinite(learned.log_height).all()
