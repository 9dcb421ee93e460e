"""Estimation of road tilt and vehicle sizes from boxes of a known world."""

import copy
import math

import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.geometry.camera import PLANE_AT_M, GroundPlane, VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_filter import GrownSize
from birdslam.road_users.placement.localisation import (
    LocalisationConfig,
    Observation,
    extent_m,
    observe_boxes,
)
from birdslam.road_users.state.ground_measurements import COMMON
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter, estimate_curvature
from tests.boxes import CAR, cuboid_px, footprint_m
from tests.recordings import KITTI as CAMERA

LOCALISATION = LocalisationConfig()
IMAGE_COV = np.diag([0.001, 0.002]) ** 2
CONFIG = GroundSizeConfig(roof_reach_rel=1.0)  # the world here is made of cuboids


class Road:
    """Cars on a road that the camera leans over by `pitch_rad` and `roll_rad`, and a filter that does not know it."""

    def __init__(self, pitch_rad: float = 0.0, roll_rad: float = 0.0, config: GroundSizeConfig = CONFIG) -> None:
        self.truth = GroundPlane(CAMERA.height_m, pitch_rad, roll_rad)
        self.ground_size = GroundSizeFilter(CAMERA, config)
        self.cars: list[int] = []  # in the order of the filter's rows
        self.rng = np.random.default_rng(3)

    def box(self, x_m: float, y_m: float, height_m: float, lift_m: float = 0.0) -> np.ndarray:
        return cuboid_px(footprint_m(SE2(x_m, y_m)), height_m, self.truth, lift_m=lift_m)

    def see(
        self, boxes: dict[int, np.ndarray], dt_s: float = 0.1, vertical: VerticalCurvature | None = None
    ) -> tuple[dict[int, float], dict[int, float]]:
        """Nearest depths in metres and the sigmas of their logarithms."""
        self.ground_size.predict(dt_s, 0.0, None, None, vertical=vertical)
        seen: list[Observation] = []
        for car, box in boxes.items():
            seen += observe_boxes(box[None], np.ones(1), ("car",), CAMERA, self.ground_size.ground, LOCALISATION)
            if car not in self.cars:
                self.cars.append(car)
                self.ground_size.add_vehicle(seen[-1])
        extents = np.array([extent_m(CAR, 0.0, o.depth_by_height_m, o.bearing) for o in seen])
        depths = self.ground_size.estimate_depths(
            [self.cars.index(car) for car in boxes], seen, extents[:, 1], extents[:, 0], np.zeros(len(seen))
        )
        log_z, var = depths.log_depth, depths.variance
        return dict(zip(boxes, np.exp(log_z), strict=True)), dict(zip(boxes, np.sqrt(var), strict=True))


def traffic(road: Road, frames: int, heights_m: list[float], noise_px: float = 0.5) -> dict[int, float]:
    """The ego closes in on cars, row by row; the last frame's relative depth errors."""
    errors: dict[int, float] = {}
    for k in range(frames):
        boxes = {}
        for i, height_m in enumerate(heights_m):
            x_m, y_m = 14.0 + 6.0 * i - 0.25 * k, (-4.0, 0.0, 4.0)[i % 3]
            boxes[i] = road.box(x_m, y_m, height_m) + noise_px * road.rng.standard_normal(4)
        depths, _ = road.see(boxes)
        errors = {i: depths[i] / (14.0 + 6.0 * i - 0.25 * k - CAR.length_m / 2.0) - 1.0 for i in boxes}
    return errors


@pytest.mark.parametrize("pitch_rad", [-0.012, 0.0, 0.02])
def test_boxes_alone_give_the_pitch_and_the_depths(pitch_rad: float) -> None:
    road = Road(pitch_rad)
    errors = traffic(road, 20, [1.4, 1.6, 1.5, 1.45, 1.62])
    assert road.ground_size.ground.pitch_rad == pytest.approx(pitch_rad, abs=3.0 * road.ground_size.sigma_pitch_rad)
    assert abs(road.ground_size.ground.pitch_rad - pitch_rad) < 0.004
    assert np.median(np.abs(list(errors.values()))) < 0.04
    level = [CAMERA.height_m / (1.65 / z - pitch_rad) / z - 1.0 for z in (20.0, 30.0)]  # Eq. 1 on level ground
    if pitch_rad:
        assert max(map(abs, level)) > 0.15


def test_roll_is_estimated_from_cars_on_both_sides() -> None:
    road = Road(0.0, 0.02)
    traffic(road, 30, [1.5, 1.55, 1.5, 1.5, 1.55, 1.5])
    assert road.ground_size.ground.roll_rad > 0.003  # a kerb under each of them would do as well


def test_vehicles_on_another_street_give_no_false_roll() -> None:
    """Three cars park on a higher street beside the road; cars on the road itself are level."""
    rolls = []
    for sigma_rad in (CONFIG.sigma_common_crown_rad, 0.0):
        road = Road(config=replace(CONFIG, sigma_common_crown_rad=sigma_rad))
        for k in range(10):
            aside = {i: road.box(36.0 + 6.0 * i - k, 18.0, 1.53, lift_m=0.3) for i in range(3)}
            road.see(aside | {3: road.box(20.0 + k, 0.0, 1.53), 4: road.box(25.0 - k, -3.5, 1.53)})
        rolls.append((abs(road.ground_size.ground.roll_rad), road.ground_size.sigma_roll_rad))
    (roll_rad, sigma_rad), (taught_rad, taught_sigma_rad) = rolls
    assert roll_rad < 0.8 * taught_rad
    assert roll_rad < 1.5 * sigma_rad
    assert taught_rad > 2.0 * taught_sigma_rad  # as if all vehicles stood on one plane


def test_tilt_and_sizes_are_consistent() -> None:
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        road = Road(float(0.01 * rng.standard_normal()))
        road.rng = rng
        traffic(road, 10, [float(1.53 * math.exp(0.08 * e)) for e in rng.standard_normal(4)], noise_px=1.5)
        ratios.append((road.ground_size.ground.pitch_rad - road.truth.pitch_rad) / road.ground_size.sigma_pitch_rad)
    assert np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_correlated_box_errors_do_not_average_out() -> None:
    """A detector errs in a frame much as in the one before, three times as alike at 30 Hz as at 10 Hz."""
    ratios: list[float] = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        heights = [float(1.53 * math.exp(0.08 * e)) for e in rng.standard_normal(4)]
        road, lasting = Road(0.0), np.zeros((4, 4))
        for k in range(60):
            keep = math.exp(-1.0 / 30.0 / 0.25)
            lasting = keep * lasting + math.sqrt(1.0 - keep**2) * rng.standard_normal((4, 4))
            cars = [(14.0 + 6.0 * i - 0.08 * k, (-4.0, 0.0, 4.0)[i % 3]) for i in range(4)]
            boxes = {i: road.box(*car, heights[i]) for i, car in enumerate(cars)}
            sigma_px = {i: 0.7 + 0.02 * (box[3] - box[1]) for i, box in boxes.items()}
            depths, sigmas = road.see({i: box + sigma_px[i] * lasting[i] for i, box in boxes.items()}, 1.0 / 30.0)
        ratios += [math.log(depths[i] / (x_m - CAR.length_m / 2.0)) / sigmas[i] for i, (x_m, _) in enumerate(cars)]
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.2


def test_frame_rate_does_not_add_size_information() -> None:
    sigmas = []
    for hz in (10.0, 30.0):
        road = Road()
        for _ in range(round(2.0 * hz)):
            road.see({0: road.box(20.0, 0.0, 1.5), 1: road.box(30.0, 4.0, 1.55)}, 1.0 / hz)
        P = road.ground_size._P  # private: a height's sigma alone; out comes a depth's
        sigmas.append(math.sqrt(P[COMMON, COMMON]))
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.1)


def test_box_truncated_below_uses_the_learned_size() -> None:
    road = Road()
    for x_m in np.arange(14.0, 8.4, -0.2):
        road.see({0: road.box(x_m, 0.5, 1.45), 1: road.box(x_m + 9.0, -3.0, 1.55)})
    box = road.box(6.0, 0.5, 1.45)
    assert box[3] > CAMERA.height_px
    box[3] = CAMERA.height_px - 1.0
    depths, sigmas = road.see({0: box, 1: road.box(15.0, -3.0, 1.55)})
    near_m = 6.0 - CAR.length_m / 2.0
    assert CAMERA.height_m / ((box[3] - CAMERA.cy_px) / CAMERA.fy_px) > 1.25 * near_m  # Eq. 1 alone is fooled
    assert depths[0] == pytest.approx(near_m, rel=0.1)
    assert abs(math.log(depths[0] / near_m)) < 3.0 * sigmas[0]


def test_outlier_lower_edge_moves_neither_road_nor_size() -> None:
    road = Road()
    cars = {0: (14.0, 0.0, 1.5), 1: (22.0, 3.5, 1.45), 2: (30.0, -3.5, 1.55)}
    for _ in range(15):
        road.see({i: road.box(*car) for i, car in cars.items()})
    pitch_rad, (height_m, _) = road.ground_size.ground.pitch_rad, road.ground_size.size(0)
    boxes = {i: road.box(*car) for i, car in cars.items()}
    boxes[0][3] -= 25.0
    depths, _ = road.see(boxes)
    assert road.ground_size.ground.pitch_rad == pytest.approx(pitch_rad, abs=0.002)
    assert road.ground_size.size(0)[0] == pytest.approx(height_m, rel=0.05)
    assert depths[0] == pytest.approx(14.0 - CAR.length_m / 2.0, rel=0.12)  # Eq. 1 gives 30 % more


def test_camera_pitch_moves_the_horizon_over_a_bump() -> None:
    still, told = GroundSizeFilter(CAMERA, CONFIG), GroundSizeFilter(CAMERA, CONFIG)
    still.predict(0.1, 0.0, None, None)
    told.predict(0.1, 0.01, None, None)
    assert told.ground.pitch_rad - still.ground.pitch_rad == pytest.approx(0.01, rel=0.05)
    for _ in range(300):
        told.predict(0.1, 0.0, None, None)
    assert abs(told.ground.pitch_rad) < 0.001  # it lasts: then the road has turned as well


def test_pitch_from_images_is_used_once() -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    before = ground_size.sigma_pitch_rad
    ground_size.predict(0.1, 0.0, CAMERA.ground, IMAGE_COV)  # the calibration adds no information
    assert ground_size.sigma_pitch_rad >= before * 0.99
    ground_size.predict(0.1, 0.0, GroundPlane(CAMERA.height_m, 0.015), IMAGE_COV)
    assert ground_size.ground.pitch_rad == pytest.approx(0.015, abs=0.002)
    assert ground_size.sigma_pitch_rad < 0.5 * before


def test_dropped_vehicles_keep_their_information_on_the_road() -> None:
    road = Road(0.015)
    traffic(road, 12, [1.5, 1.55, 1.5])
    pitch_rad, sigma_rad = road.ground_size.ground.pitch_rad, road.ground_size.sigma_pitch_rad
    height = road.ground_size.size(1)
    road.ground_size.keep_rows([1])
    assert (road.ground_size.ground.pitch_rad, road.ground_size.sigma_pitch_rad) == (pitch_rad, sigma_rad)
    assert road.ground_size.size(0) == height


def test_without_boxes_nothing_is_estimated() -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    ground = ground_size.ground
    depths = ground_size.estimate_depths([], [], np.zeros(0), np.zeros(0), np.zeros(0))
    assert len(depths.log_depth) == len(depths.variance) == len(depths.log_height) == 0
    assert ground_size.ground == ground


def test_parked_cars_do_not_drift_as_the_ego_passes() -> None:
    """The filter's covariance stays positive over hundreds of frames and vehicles that come and go."""
    road = Road(0.005)
    for k in range(300):
        first = k // 10
        boxes = {i: road.box(*(15.0 + 7.0 * (i - k / 10.0), 3.5), 1.5) for i in range(first, first + 5)}
        road.see(boxes)
        road.ground_size.keep_rows([row for row, car in enumerate(road.cars) if car in boxes])
        road.cars = [car for car in road.cars if car in boxes]
    assert np.linalg.eigvalsh(road.ground_size._P).min() > 0.0  # private: the law is of the whole covariance
    assert road.ground_size.ground.pitch_rad == pytest.approx(0.005, abs=0.004)


def test_external_size_corrects_depth_and_is_not_stored() -> None:
    road = Road()
    box = {0: road.box(40.0, 0.0, 1.7)}
    (prior_m,), (prior_sigma,) = (list(x.values()) for x in road.see(box))
    seen = observe_boxes(box[0][None], np.ones(1), ("car",), CAMERA, road.ground_size.ground, LOCALISATION)
    extents = np.array([extent_m(CAR, 0.0, o.depth_by_height_m, o.bearing) for o in seen])

    def again(stationary: float, sigma: float) -> tuple[float, float]:
        learned = GrownSize(np.log([1.7]), np.array([sigma**2]), np.array([stationary]), np.zeros(1))
        ground_size = copy.deepcopy(road.ground_size)
        found = ground_size.estimate_depths([0], seen, extents[:, 1], extents[:, 0], np.zeros(1), learned)
        assert ground_size.size(0)[0] < 1.62
        depth_m, height_m = float(np.exp(found.log_depth[0])), float(np.exp(found.log_height[0]))
        # The height that comes with the depth is the one that the depth was found with
        as_before = prior_m * (height_m / road.ground_size.size(0)[0]) ** found.depth_per_height[0]
        assert depth_m == pytest.approx(as_before, rel=0.02)
        return depth_m, float(np.sqrt(found.variance[0]))

    truth_m = 40.0 - CAR.length_m / 2.0
    told_m, told_sigma = again(1.0, 0.001)
    assert abs(told_m - truth_m) < 0.3 * abs(prior_m - truth_m)
    assert told_sigma < prior_sigma
    vague_m, _ = again(1.0, 1e3)
    mixed_m, mixed_sigma = again(0.5, 0.001)
    assert again(0.0, 0.001)[0] == pytest.approx(prior_m, rel=0.02)
    assert abs(vague_m - prior_m) < 0.1 * abs(told_m - prior_m)
    assert mixed_m < told_m
    assert mixed_sigma > 1.5 * told_sigma


@pytest.mark.parametrize("speed_mps", [0.0, 15.0])
def test_widening_box_means_turning_or_approaching_car(speed_mps: float) -> None:
    """The aspect of a stationary vehicle changes only by ego-motion, so its width counts; a moving one may turn."""
    road = Road()
    motion = GrownSize(np.full(1, math.log(1.53)), np.full(1, 1e6), np.ones(1), np.full(1, speed_mps))
    cuboid = road.box(30.0, 0.0, 1.53)
    for k in range(40):
        half_px = (cuboid[2] - cuboid[0]) / 2.0 * max(0.0, 0.025 * (k - 10))
        box = cuboid + np.array([-half_px, 0.0, half_px, 0.0])
        road.ground_size.predict(0.1, 0.0, None, None)
        seen = observe_boxes(box[None], np.ones(1), ("car",), CAMERA, road.ground_size.ground, LOCALISATION)
        if not len(road.ground_size):
            road.ground_size.add_vehicle(seen[0])
        extents = np.array([extent_m(CAR, 0.0, o.depth_by_height_m, o.bearing) for o in seen])
        depths = road.ground_size.estimate_depths([0], seen, extents[:, 1], extents[:, 0], np.zeros(1), motion)
    nearer_rel = 1.0 - float(np.exp(depths.log_depth[0])) / (30.0 - CAR.length_m / 2.0)
    assert nearer_rel < 0.04 if speed_mps else nearer_rel > 0.08


def crest_errors(vertical_per_m: float, given: VerticalCurvature | None) -> list[float]:
    """Relative depth errors of cars at 20, 32 and 44 m on a road of that vertical curvature, in their tenth frame."""
    road = Road()
    out: list[float] = []
    for k in range(10):
        boxes, faces = {}, {}
        for i, x_m in enumerate((20.0 - 0.5 * k, 32.0 - 0.5 * k, 44.0 - 0.5 * k)):
            faces[i] = x_m - CAR.length_m / 2.0
            rise_m = 0.5 * vertical_per_m * faces[i] * (faces[i] - PLANE_AT_M)
            boxes[i] = road.box(x_m, (-3.0, 0.0, 3.0)[i], CAR.height_m, rise_m)
        depths, _ = road.see(boxes, vertical=given)
        out = [depths[i] / faces[i] - 1.0 for i in boxes]
    return out


def test_vehicles_before_a_crest_are_on_the_falling_road() -> None:
    crest = VerticalCurvature(-0.002, 2e-4)
    assert min(crest_errors(crest.per_m, None)) < -0.15, "a plane puts them much too near"
    assert max(abs(error) for error in crest_errors(crest.per_m, crest)) < 0.05


def test_curvature_error_enters_boxes_but_boxes_do_not_correct_it() -> None:
    sigma: dict[float, float] = {}
    for own in (1e-5, 1e-3):
        road, crest = Road(), VerticalCurvature(-0.002, own)
        for _ in range(10):
            _, sigmas = road.see({0: road.box(20.0, 0.0, 1.9), 1: road.box(40.0, 3.0, 1.2)}, vertical=crest)
        mean, variance = estimate_curvature(crest, CONFIG.sigma_vertical_per_m, CONFIG.vertical_dof)
        assert road.ground_size.vertical_per_m == pytest.approx(mean)
        assert road.ground_size.sigma_vertical_per_m == pytest.approx(math.sqrt(variance))
        sigma[own] = sigmas[1]
    assert sigma[1e-3] > 1.01 * sigma[1e-5]


def test_only_significant_curvature_is_used() -> None:
    hill, hill_var = estimate_curvature(VerticalCurvature(0.002, 2e-4), 1.5e-4, 6.0)
    small, small_var = estimate_curvature(VerticalCurvature(1.5e-4, 2e-4), 1.5e-4, 6.0)
    assert hill > 0.0018
    assert small < 1e-4
    assert small_var < hill_var < 2e-4**2
    none, none_var = estimate_curvature(VerticalCurvature(0.0, 5e-4), 1.5e-4, 6.0)
    assert none == 0.0
    assert math.sqrt(none_var) < 1.5e-4
