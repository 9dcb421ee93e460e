"""Correlated errors of a vehicle do not average out; the box of another vehicle is not motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import LocalisationConfig, observe_boxes
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig
from birdslam.road_users.tracking import Tracker
from tests.boxes import CAR, car_px
from tests.recordings import KITTI as CAMERA

LOCALISATION = LocalisationConfig()
CONFIG = GroundSizeConfig()
DT_S, STEP_M = 0.1, 1.0


def box_of(x_m: float, y_m: float, ground: GroundPlane, height_m: float, edge_m: float = 0.0) -> np.ndarray:
    """Of a car headed like the ego with its centre there; its lower edge is drawn `edge_m` below the road."""
    below_px = CAMERA.fy_px * edge_m / (x_m - CAR.length_m / 2)
    return np.add(car_px(SE2(x_m, y_m), height_m, ground), [0.0, 0.0, 0.0, below_px])


@pytest.mark.slow  # test_ground_size_filter.py has the law
def test_sigma_includes_correlated_errors_after_many_frames() -> None:
    """Tracks of passing cars, each with errors of height, lower edge and road that all its boxes share."""
    rng, squares = np.random.default_rng(5), {"young": [], "old": []}
    for _ in range(10):
        ground_size = GroundSizeFilter(CAMERA, CONFIG)
        pitch_rad = rng.normal(0.0, CONFIG.sigma_pitch_rad)
        tracker = Tracker(CAMERA, TrackingConfig(), LOCALISATION, ground_size)
        cars = [(55.0, 4.0), (60.0, -4.0), (68.0, 4.5)]
        heights = CAR.height_m * np.exp(rng.normal(0.0, CAR.sigma_height_rel, len(cars)))
        edges = rng.normal(0.0, math.hypot(CONFIG.sigma_kerb_m, CONFIG.sigma_edge_rel * CAR.height_m), len(cars))
        tilts = rng.normal(0.0, CONFIG.sigma_tilt_rad, len(cars))
        for k in range(40):
            ground_size.predict(DT_S, 0.0, None, None, STEP_M)
            boxes = np.array(
                [
                    box_of(x - STEP_M * k, y, GroundPlane(1.65, pitch_rad + tilt, 0.0), h, e)
                    for (x, y), h, e, tilt in zip(cars, heights, edges, tilts, strict=True)
                ]
            )
            boxes += rng.normal(0.0, 0.6, boxes.shape)
            frame = EgoFrame(k, round(k * DT_S * 1e9), SE2(STEP_M * k, 0.0, 0.0), np.diag([1e-4, 1e-4, 1e-8]))
            seen = observe_boxes(boxes, np.ones(3), ("car",) * 3, CAMERA, ground_size.ground, LOCALISATION)
            for track in tracker.update(frame, seen):
                error = track.place.centre_m - np.subtract(cars[track.observation.row], [STEP_M * k, 0.0])
                if 2 <= k < 8 or k >= 30:
                    square = float(error @ np.linalg.solve(track.place.cov, error)) / 2.0
                    squares["young" if k < 8 else "old"].append(min(square, 12.5))
    young, old = (float(np.mean(squares[age])) for age in ("young", "old"))
    assert 0.2 < young < 1.0
    assert 0.2 < old < 1.0  # without the states of what lasts it grows with the frames


def test_lower_edge_is_not_learned_from_itself() -> None:
    """A car alone on a road that is known: a thousand boxes leave the depth as uncertain as its edge and tilt are."""
    exact = GroundSizeConfig(sigma_pitch_rad=1e-6, sigma_roll_rad=1e-6, sigma_pitch_step_rad=1e-6)
    ground_size = GroundSizeFilter(CAMERA, exact)
    spread = []
    for k in range(200):
        ground_size.predict(DT_S, 0.0, None, None, STEP_M)
        (seen,) = observe_boxes(
            box_of(30.0, 0.0, CAMERA.ground, CAR.height_m)[None],
            np.ones(1),
            ("car",),
            CAMERA,
            CAMERA.ground,
            LOCALISATION,
        )
        if not k:
            ground_size.add_vehicle(seen)
        depths = ground_size.estimate_depths(
            [0], [seen], np.array([CAR.width_m]), np.array([CAR.length_m]), np.zeros(1)
        )
        spread.append(math.sqrt(float(depths.variance[0])))
    by_edge = math.hypot(exact.sigma_kerb_m, exact.sigma_edge_rel * CAR.height_m) / CAMERA.height_m
    by_tilt = exact.sigma_tilt_rad * 28.0 / CAMERA.height_m
    assert spread[-1] > 0.7 * math.hypot(by_edge, by_tilt)
    assert spread[-1] == pytest.approx(spread[50], rel=0.1)


@pytest.mark.parametrize("leap_m", [(4.5,), (3.0,), (2.2, 4.5)])
def test_parked_car_with_a_neighbours_box_stays_stationary(leap_m: tuple[float, ...]) -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    tracker = Tracker(CAMERA, TrackingConfig(), LOCALISATION, ground_size, PseudoLidarConfig())
    standing = []
    for k in range(30):
        ground_size.predict(DT_S, 0.0, None, None, 0.8)
        leapt_m = 0.0 if k < 12 else leap_m[min(k - 12, len(leap_m) - 1)]  # to the next one in the row
        x_m = 44.0 - 0.8 * k + leapt_m
        box = box_of(x_m, 3.8, CAMERA.ground, CAR.height_m)[None]
        frame = EgoFrame(k, round(k * DT_S * 1e9), SE2(0.8 * k, 0.0, 0.0), np.diag([1e-4, 1e-4, 1e-8]))
        tracker.update(frame, observe_boxes(box, np.ones(1), ("car",), CAMERA, ground_size.ground, LOCALISATION))
        standing.append(tracker.placing.users.stationary_probability()[0])
    assert len(tracker.tracks) == 1  # it is one track: the box leapt within the gate
    assert min(standing[10:]) > 0.3
    assert standing[-1] > 0.8


def test_departing_car_keeps_its_track() -> None:
    ground_size = GroundSizeFilter(CAMERA, CONFIG)
    tracker = Tracker(CAMERA, TrackingConfig(), LOCALISATION, ground_size)
    for k in range(30):
        ground_size.predict(DT_S, 0.0, None, None, 0.8)
        box = box_of(20.0 + 0.4 * k, 3.8, CAMERA.ground, CAR.height_m)[None]
        frame = EgoFrame(k, round(k * DT_S * 1e9), SE2(0.8 * k, 0.0, 0.0), np.diag([1e-4, 1e-4, 1e-8]))
        tracker.update(frame, observe_boxes(box, np.ones(1), ("car",), CAMERA, ground_size.ground, LOCALISATION))
    assert tracker.placing.users.stationary_probability()[0] < 0.1
