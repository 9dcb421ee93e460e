"""The road under a stationary ego: held, with a covariance that follows from the sizes of the cars ahead."""

import math

import numpy as np
import pytest

from birdslam.bench.tracking.localisation import measure
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.perception import Detections
from birdslam.road_users.models.user_filter import GrownSize
from birdslam.road_users.placement.localisation import LocalisationConfig, extent_m, observe_boxes
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.sources.kitti_tracking import TrackingSequence
from tests.boxes import CAR, car_px
from tests.recordings import KITTI as CAMERA

LOCALISATION = LocalisationConfig()
CONFIG = GroundSizeConfig(roof_reach_rel=1.0)  # the world here is made of cuboids
PERIOD_S = 0.1
CARS_M = [(14.0, -4.0), (20.0, 0.0), (26.0, 4.0), (32.0, -4.0)]  # (x, y) of their centres


def box_px(x_m: float, y_m: float, height_m: float, pitch_rad: float) -> np.ndarray:
    return car_px(SE2(x_m, y_m), height_m, GroundPlane(CAMERA.height_m, pitch_rad))


def see(
    ground_size: GroundSizeFilter, boxes: list[np.ndarray], travelled_m: float, speed_mps: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A frame with a box of each car, each of which moves at `speed_mps`: depths in metres, sigmas of their logs."""
    ground_size.predict(PERIOD_S, 0.0, None, None, travelled_m)
    n, ground = len(boxes), ground_size.ground
    seen = [observe_boxes(b[None], np.ones(1), ("car",), CAMERA, ground, LOCALISATION)[0] for b in boxes]
    for new in seen[len(ground_size) :]:
        ground_size.add_vehicle(new)
    extents = np.array([extent_m(CAR, 0.0, o.depth_by_height_m, o.bearing) for o in seen]).reshape(-1, 2)
    learned = GrownSize(np.zeros(n), np.full(n, 1e6), np.ones(n), np.full(n, speed_mps))
    depths = ground_size.estimate_depths(list(range(n)), seen, extents[:, 1], extents[:, 0], np.zeros(n), learned)
    return np.exp(depths.log_depth), np.sqrt(depths.variance)


def test_stopped_ego_keeps_its_road() -> None:
    pitch_rad, ground_size = 0.02, GroundSizeFilter(CAMERA, CONFIG)
    for k in range(40):
        see(ground_size, [box_px(x + 8.0 - 0.2 * k, y, 1.53, pitch_rad) for x, y in CARS_M], 0.2)
    halted_rad, sigma_rad = ground_size.ground.pitch_rad, ground_size.sigma_pitch_rad
    assert abs(halted_rad - pitch_rad) < sigma_rad < 0.004
    boxes = [box_px(x, y, 1.53, pitch_rad) for x, y in CARS_M]
    for _ in range(100):
        see(ground_size, boxes, 0.0)
    assert abs(ground_size.ground.pitch_rad - pitch_rad) < sigma_rad
    ground_size.keep_rows([])
    held = ground_size.ground, ground_size.sigma_pitch_rad
    for _ in range(600):
        ground_size.predict(PERIOD_S, 0.0, None, None, 0.0)
    assert ground_size.ground.pitch_rad == pytest.approx(held[0].pitch_rad, abs=1e-9)
    assert ground_size.ground.roll_rad == pytest.approx(held[0].roll_rad, abs=1e-9)
    assert ground_size.sigma_pitch_rad == pytest.approx(held[1], rel=1e-6)


def test_road_information_decays_with_distance_only() -> None:
    left = []
    for speed_mps in (0.0, 0.1, 1.0, 3.0, 10.0, 30.0):
        ground_size = GroundSizeFilter(CAMERA, CONFIG)
        ground_size.predict(PERIOD_S, 0.02, None, None, 0.0)
        for _ in range(50):
            ground_size.predict(PERIOD_S, 0.0, None, None, speed_mps * PERIOD_S)
        left.append(ground_size.ground.pitch_rad / 0.02)
    assert left == sorted(left, reverse=True)
    assert left[0] == pytest.approx(1.0)
    assert left[1] > 0.9
    assert left[-1] == pytest.approx(math.exp(-1.0), rel=0.01)  # its memory is 5 s of driving


def test_repeated_image_adds_no_information() -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    boxes = [box_px(x, y, 1.53, 0.01) for x, y in CARS_M]
    see(ground_size, boxes, 0.0)
    once_rad, heights = ground_size.sigma_pitch_rad, [ground_size.size(i)[0] for i in range(len(boxes))]
    for _ in range(100):
        see(ground_size, boxes, 0.0)
    assert ground_size.sigma_pitch_rad == pytest.approx(once_rad, rel=0.02)
    assert [ground_size.size(i)[0] for i in range(len(boxes))] == pytest.approx(heights, rel=0.01)
    passing = GroundSizeFilter(CAMERA, CONFIG)
    for _ in range(600):
        see(passing, boxes, 0.0, speed_mps=10.0)
    assert passing.sigma_pitch_rad < 0.85 * once_rad  # a passing vehicle shows a new aspect in each frame


def test_information_while_stationary_is_limited_by_the_number_of_cars() -> None:
    config = GroundSizeConfig(roof_reach_rel=0.0, sigma_kerb_m=1e-6, sigma_crown_rad=0.0)
    sigma_size = (CAR.sigma_height_rel**-2 + CAR.sigma_width_rel**-2) ** -0.5
    for cars_m in (CARS_M[:1], CARS_M[2:], CARS_M):
        ground_size = GroundSizeFilter(CAMERA, config)
        boxes = [box_px(x, y, 1.53, 0.0) for x, y in cars_m]
        for _ in range(60):
            see(ground_size, boxes, 0.0)
        by_sizes = [CAMERA.height_m / (x_m - CAR.length_m / 2.0) * sigma_size for x_m, _ in cars_m]  # Eq. 1
        exact_boxes = (config.sigma_pitch_rad**-2 + sum(s**-2 for s in by_sizes)) ** -0.5
        assert exact_boxes < ground_size.sigma_pitch_rad < 1.5 * exact_boxes


@pytest.mark.slow  # many seeds
def test_initially_stationary_ego_is_consistent() -> None:
    """Over seeds: cars of unknown sizes on a road of unknown pitch, whose boxes err alike in all frames."""
    of_pitch, of_depth = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pitch_rad, ground_size = 0.01 * float(rng.standard_normal()), GroundSizeFilter(CAMERA, CONFIG)
        boxes = []
        for x_m, y_m in CARS_M:
            box = box_px(x_m, y_m, 1.53 * math.exp(0.08 * float(rng.standard_normal())), pitch_rad)
            boxes.append(box + (0.7 + 0.02 * (box[3] - box[1])) * rng.standard_normal(4))
        for _ in range(15):
            depths_m, sigmas = see(ground_size, boxes, 0.0)
        of_pitch.append((ground_size.ground.pitch_rad - pitch_rad) / ground_size.sigma_pitch_rad)
        truth_m = np.array([x_m - CAR.length_m / 2.0 for x_m, _ in CARS_M])
        of_depth.append(np.log(depths_m / truth_m) / sigmas)
    assert 0.6 < np.sqrt(np.mean(np.square(of_pitch))) < 1.3
    assert 0.6 < np.sqrt(np.mean(np.square(of_depth))) < 1.3


def test_image_pitch_adds_nothing_while_stationary() -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    ground_size.predict(PERIOD_S, 0.0, GroundPlane(CAMERA.height_m, 0.01), np.eye(2) * 0.003**2, 1.0)
    before = ground_size.ground.pitch_rad, ground_size.sigma_pitch_rad
    for k in range(100):  # it trembles in its last digits
        ground_size.predict(
            PERIOD_S, 0.0, GroundPlane(CAMERA.height_m, 0.01 + 1e-6 * (k % 2)), np.eye(2) * 0.003**2, 0.0
        )
    assert (ground_size.ground.pitch_rad, ground_size.sigma_pitch_rad) == pytest.approx(before, rel=1e-3)


def test_front_end_holds_the_road_of_a_stopped_ego() -> None:
    """It drives up to cars on a road that the camera is not calibrated for, halts, and they leave."""
    frames, stands_from, pitch_rad = 120, 40, 0.02
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = 0.4 * np.minimum(np.arange(frames), stands_from)
    sequence = TrackingSequence("9999", CAMERA, np.eye(4), poses, (), None)
    detections = [Detections(np.zeros((0, 4)), np.zeros(0), ())] * frames
    for k in range(stands_from):
        boxes = [box_px(x_m + 16.0 - 0.4 * k, y_m, 1.5, pitch_rad) for x_m, y_m in CARS_M]
        detections[k] = Detections(np.array(boxes), np.full(len(boxes), 0.9), ("car",) * len(boxes))
    log = measure(sequence, detections, FrontEndConfig())
    halted, last = log[stands_from + 1].ground, log[-1].ground
    assert halted.pitch_rad == pytest.approx(pitch_rad, abs=0.006)
    assert last.pitch_rad == pytest.approx(halted.pitch_rad, abs=1e-6)
