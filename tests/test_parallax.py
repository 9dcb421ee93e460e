"""Vehicle sizes from the parallax of stationary vehicles only."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.road_users.state.parallax import UNKNOWN_VARIANCE, LearnedSize, Parallax
from birdslam.road_users.state.parallax_config import ParallaxConfig
from birdslam.road_users.state.parallax_measurements import ParallaxMeasurements

HEIGHT_M = 1.65  # of the camera
REACH_M = 2.0
CLASS_M = 1.53
SIGMAS = (0.08, 0.2)


def measured(at: np.ndarray, height_m: float, noise: np.ndarray) -> ParallaxMeasurements:
    """Of one vehicle whose centre is at (2,) in ego; `noise` (3,) standard normal."""
    depth = float(at[0]) - REACH_M
    sigma = np.array([0.03, 0.04, 0.001])
    values = np.array([math.log(height_m / depth), -math.log(depth), at[1] / at[0]]) + sigma * noise
    return ParallaxMeasurements(
        log_height=values[:1],
        log_width=values[1:2],
        bearing=values[2:],
        sigma=sigma[None],
        depth_m=np.array([depth]),
        bottom=np.array([HEIGHT_M / depth]),
        sigma_bottom=np.array([0.0015]),
        reach_m=np.array([REACH_M]),
        turned_rad=np.zeros(1),
        yaw_rad=np.zeros(1),
        tan_width=np.exp(values[1:2]),
    )


class Road:
    """An ego at `ego_mps` and one vehicle at `centre_m` in world with velocity `mps` (2,)."""

    def __init__(
        self,
        height_m: float,
        x_m: float = 70.0,
        y_m: float = 4.0,
        ego_mps: float = 9.0,
        seed: int = 0,
        hz: float = 10.0,
    ) -> None:
        white = ParallaxConfig(box_memory_s=1.0 / hz, view_memory_s=1.0 / hz, sigma_face_m=0.0, sigma_scale_rel=0.0)
        self.parallax = Parallax(white)  # as the noise of this world is
        self.height_m, self.ego_mps, self.dt_s = height_m, ego_mps, 1.0 / hz
        self.rng = np.random.default_rng(seed)
        self.at, self.ego_m = np.array([x_m, y_m]), 0.0
        self.begun = False

    def drive(self, seconds: float, mps: tuple[float, float] = (0.0, 0.0), noisy: bool = True) -> LearnedSize:
        for _ in range(round(seconds / self.dt_s)):
            T_world_ego = SE2(self.ego_m, 0.0, 0.0)
            seen = measured(self.at - [self.ego_m, 0.0], self.height_m, noisy * self.rng.standard_normal(3))
            self.parallax.predict(self.dt_s, T_world_ego, None)
            if not self.begun:
                depth = CLASS_M / math.exp(float(seen.log_height[0])) + REACH_M
                centre = np.array([depth, depth * float(seen.bearing[0])])
                self.parallax.add_vehicle(centre, 0.0, T_world_ego, math.log(CLASS_M), SIGMAS)
                self.begun = True
            learned = self.parallax.learn_sizes([0], seen, T_world_ego, HEIGHT_M)
            self.at = self.at + np.array(mps) * self.dt_s
            self.ego_m += self.ego_mps * self.dt_s
        return learned

    def height(self, learned: LearnedSize) -> float:
        """The posterior mean with the class prior."""
        information = 1.0 / learned.variance + 1.0 / SIGMAS[0] ** 2
        each = (learned.log_height / learned.variance + math.log(CLASS_M) / SIGMAS[0] ** 2) / information
        return math.exp(float((learned.weight * each).sum()))


@pytest.mark.parametrize("height_m", [1.40, 1.53, 1.70])
def test_parallax_determines_size_of_a_parked_car(height_m: float) -> None:
    road = Road(height_m)
    learned = road.drive(5.5)
    assert road.parallax.stationary_probability(0) > 0.95
    assert road.height(learned) == pytest.approx(height_m, rel=0.03)


def test_unusual_size_of_a_stationary_vehicle_is_found() -> None:
    road = Road(2.45)
    learned = road.drive(5.5)
    assert road.parallax.stationary_probability(0) > 0.9
    best = int(learned.weight.argmax())
    assert learned.log_height[0, best] == pytest.approx(math.log(2.45), abs=0.25)
    assert road.height(learned) > 2.2


@pytest.mark.parametrize("mps", [(9.0, 0.0), (12.0, 0.0), (-9.0, 0.0), (0.0, 4.0)])
def test_moving_vehicle_keeps_the_class_size(mps: tuple[float, float]) -> None:
    road = Road(1.53, x_m=60.0)
    learned = road.drive(2.5, mps)
    assert road.parallax.stationary_probability(0) < 0.1
    assert road.height(learned) == pytest.approx(1.53, rel=0.03)
    moving = learned.variance[0, 2:]
    assert (moving >= UNKNOWN_VARIANCE).all()


@pytest.mark.parametrize("mps", [(0.0, 0.0), (1.8, 0.0)])
def test_no_size_is_learned_straight_ahead(
    mps: tuple[float, float],
) -> None:
    learned = Road(1.70, x_m=16.0, y_m=0.3, ego_mps=2.3).drive(4.0, mps)
    assert (learned.variance >= UNKNOWN_VARIANCE).all()
    beside = Road(1.70, x_m=16.0, y_m=4.0, ego_mps=2.3).drive(4.0)
    assert beside.variance[0, 0] < SIGMAS[0]


@pytest.mark.parametrize("height_m", [1.53, 1.65, 1.75])
@pytest.mark.parametrize(("mps", "stands"), [(0.0, True), (2.0, False), (3.0, False), (-3.0, False)])
def test_slow_queue_is_not_taken_for_tall_stationary_cars(height_m: float, mps: float, stands: bool) -> None:
    """Its box grows like that of a taller stationary car; class and ground exclude this."""
    road = Road(height_m, x_m=45.0, ego_mps=8.0)
    road.parallax = Parallax(ParallaxConfig())  # errors last, so that few frames count
    road.drive(4.0 if mps >= 0.0 else 1.5, (mps, 0.0), noisy=False)
    assert (road.parallax.stationary_probability(0) > 0.9) == stands
    assert (road.parallax.stationary_probability(0) < 0.3) == (not stands)


def test_far_beside_the_road_constant_bearing_means_stationary() -> None:
    """Without a direction of traffic, standstill is found sooner."""
    aside = Road(1.53, x_m=60.0, y_m=20.0)
    aside.drive(1.5)
    beside = Road(1.53, x_m=60.0, y_m=4.0)
    beside.drive(1.5)
    assert aside.parallax.stationary_probability(0) > beside.parallax.stationary_probability(0)


def test_starting_and_stopping_vehicles() -> None:
    road = Road(1.53, x_m=60.0, ego_mps=4.0)
    road.drive(4.0)
    assert road.parallax.stationary_probability(0) > 0.9
    road.drive(3.0, (5.0, 0.0))
    assert road.parallax.stationary_probability(0) < 0.1
    road.drive(6.0)
    assert road.parallax.stationary_probability(0) > 0.5


def test_covariance_is_consistent() -> None:
    squared = []
    for seed in range(24):
        height_m = CLASS_M * math.exp(SIGMAS[0] * np.random.default_rng([7, seed]).standard_normal())
        learned = Road(height_m, seed=seed).drive(4.0)
        error = learned.log_height[0, 0] - math.log(height_m)
        squared.append(error**2 / learned.variance[0, 0])
    assert 0.4 < np.mean(squared) < 1.6


def test_frame_rate_adds_no_information_to_correlated_errors() -> None:
    told = []
    for hz in (10.0, 30.0):
        road = Road(1.53, hz=hz)
        road.parallax = Parallax(ParallaxConfig())
        told.append(float(road.drive(4.0, noisy=False).variance[0, 0]))
    assert told[0] == pytest.approx(told[1], rel=0.1)


def test_without_motion_nothing_is_estimated() -> None:
    road = Road(1.7, ego_mps=0.0)
    learned = road.drive(5.0)
    assert road.height(learned) == pytest.approx(CLASS_M, rel=0.03)


def test_dropped_tracks_are_removed_and_others_kept() -> None:
    road = Road(1.53)
    road.drive(1.0)
    before = road.parallax.stationary_probability(0)
    road.parallax.add_vehicle(np.array([20.0, 0.0]), 0.0, SE2(), math.log(CLASS_M), SIGMAS)
    road.parallax.keep_rows([0])
    assert road.parallax.stationary_probability(0) == before
    assert len(road.parallax) == 1
    road.parallax.keep_rows([])
    road.parallax.predict(0.1, SE2(), np.eye(3))
    nothing = road.parallax.learn_sizes([], measured(np.array([9.0, 0.0]), 1.5, np.zeros(3)), SE2(), HEIGHT_M)
    assert nothing.weight.shape == (0, 3)


@given(st.lists(st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-8, 8)), min_size=3, max_size=25))
@settings(max_examples=25)
def test_outliers_do_not_change_weights_and_covariances(noise: list[tuple[float, float, float]]) -> None:
    parallax = Parallax(ParallaxConfig())
    parallax.add_vehicle(np.array([30.0, 2.0]), 0.0, SE2(), math.log(CLASS_M), SIGMAS)
    for k, draws in enumerate(noise):
        ego = SE2(0.5 * k, 0.0, 0.0)
        parallax.predict(0.1, ego, np.diag([1e-3, 1e-4, 1e-7]))
        seen = measured(np.array([30.0 - 0.5 * k, 2.0]), CLASS_M, np.array(draws))
        learned = parallax.learn_sizes([0], seen, ego, HEIGHT_M)
        assert learned.weight.sum() == pytest.approx(1.0, abs=1e-6)
        assert (learned.variance > 0.0).all()
        assert np.isfinite(learned.log_height).all()
