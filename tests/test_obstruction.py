"""Obstructions fixed to the car: features on the windscreen, and the bonnet."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.odometry.obstruction.bonnet import Bonnet, BonnetConfig
from birdslam.odometry.obstruction.fixed_corners import FixedCorners, FixedCornersConfig
from birdslam.odometry.obstruction.fixed_pattern import FixedPattern, FixedPatternConfig
from birdslam.odometry.road.road_image import RoadImage

CAMERA = Camera(width_px=640, height_px=192, fx_px=371.0, fy_px=371.0, cx_px=320.0, cy_px=96.0, height_m=1.5)
GROUND = GroundPlane(1.5)
STEP_M = 0.9
TOP_PX = 100


def road_px(at_m: np.ndarray, across_m: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of points on the road."""
    return np.column_stack([CAMERA.cx_px + CAMERA.fx_px * across_m / at_m, CAMERA.cy_px + CAMERA.fy_px * 1.5 / at_m])


def drive(
    images: int, dirt: int, step_m: float = STEP_M, known: bool = True
) -> tuple[FixedCorners, list[np.ndarray], np.ndarray]:
    """A street of 40 points, 20 far houses, and `dirt` corners of which half are below the horizon.

    `known`: the travelled distance is.
    """
    rng = np.random.default_rng(3)
    fixed_corners = FixedCorners(CAMERA, FixedCornersConfig())
    at_m, across_m = rng.uniform(8.0 if known else 5.0, 60.0 if known else 15.0, 40), rng.uniform(-6.0, 6.0, 40)
    across_m[np.abs(across_m) < 1.0] += 2.0
    houses = np.column_stack([rng.uniform(20.0, 620.0, 20), rng.uniform(5.0, 80.0, 20)])
    spots = np.column_stack(
        [rng.uniform(0.0, 640.0, dirt), np.where(np.arange(dirt) % 2, rng.uniform(0.0, 80.0, dirt), 170.0)]
    )
    found = []
    for k in range(images):
        ahead_m = at_m - k * step_m
        seen = ahead_m > 3.0
        far = [320.0, 96.0] + (houses - [320.0, 96.0]) * (60.0 / (60.0 - k * step_m))
        px = np.concatenate([road_px(ahead_m[seen], across_m[seen]), far, spots])
        ids = np.concatenate([np.flatnonzero(seen), 100 + np.arange(20), 200 + np.arange(dirt)])
        fixed = fixed_corners.update(ids, px, GROUND, (step_m if k else 0.0) if known else None)
        found.append(fixed)
    return fixed_corners, found, ids


@pytest.mark.parametrize("known", [True, False])
def test_clean_windscreen_has_no_obstruction(known: bool) -> None:
    fixed_corners, found, _ = drive(8, 0, known=known)
    assert not fixed_corners.present
    assert not np.concatenate(found).any()


def test_dirt_above_the_horizon_is_distinguished_from_the_street() -> None:
    fixed_corners, found, ids = drive(10, 40)
    assert fixed_corners.present
    assert (found[-1] == (ids >= 200)).mean() > 0.9
    assert not found[-1][ids < 200].any()


def test_optical_flow_reveals_dirt_without_known_motion() -> None:
    fixed_corners, found, ids = drive(3, 40, known=False)
    assert fixed_corners.present
    assert found[-1][ids >= 200].all()
    assert not found[-1][ids < 100].any()


def test_loss_of_features_restarts_the_test() -> None:
    fixed_corners, px = FixedCorners(CAMERA, FixedCornersConfig()), np.full((20, 2), [300.0, 165.0])
    px[:, 0] += np.arange(20)
    fixed_corners.start(np.arange(20), px)
    for first_id in (20, 40):
        assert not fixed_corners.update(first_id + np.arange(20), px, GROUND, None).any()
    moved = px + [[0.0, 20.0]] * (np.arange(20) < 8)[:, None]
    fixed = fixed_corners.update(40 + np.arange(20), moved, GROUND, None)
    assert (fixed == (np.arange(20) >= 8)).all()


@pytest.mark.parametrize("known", [True, False])
def test_stationary_car_has_no_dirt(known: bool) -> None:
    fixed_corners, found, _ = drive(10, 40, step_m=0.0, known=known)
    assert not fixed_corners.present
    assert not np.concatenate(found).any()


@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_intermittent_features_are_each_detected(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    fixed_corners = FixedCorners(CAMERA, FixedCornersConfig())
    for _ in range(4):
        ids = np.sort(rng.choice(60, count, replace=False))
        px = rng.uniform(0.0, [640.0, 192.0], (count, 2))
        fixed = fixed_corners.update(ids, px, GROUND, float(rng.uniform(0.0, 4.0)))
        assert fixed.shape == (count,)
        assert fixed.dtype == bool


@pytest.mark.parametrize("step_m", [0.3, 1.0, 3.0])
def test_mean_image_is_over_distance_and_suppresses_the_road(step_m: float) -> None:
    """What is seen for 3 m is in it with the same weight at any rate, so that it can't pull lengths."""
    fixed_pattern = FixedPattern(FixedPatternConfig())
    for k in range(round(90.0 / step_m)):
        at_m = k * step_m
        seen = 60.0 <= at_m < 63.0 - 1e-6
        fixed_pattern.update_mean(np.full((20, 30), 100 if seen else 0, np.uint8), 10, step_m)
        if at_m < 63.0 - 1e-6:
            left = -float(fixed_pattern.subtract(np.zeros((20, 30), np.uint8), 10).mean())
    assert left == pytest.approx(100.0 * 3.0 / FixedPatternConfig().memory_m, rel=0.1)


def test_new_pattern_restarts_the_mean_image() -> None:
    rng = np.random.default_rng(5)
    pattern = cv2.GaussianBlur(rng.normal(0.0, 60.0, (92, 640)), (0, 0), 3.0)
    fixed_pattern, before = FixedPattern(FixedPatternConfig()), None
    px = np.stack(np.meshgrid(np.arange(5, 635, 3), np.arange(TOP_PX + 5, 187, 2)), axis=-1).reshape(-1, 2)
    for k in range(40):
        image = road_image(rng).astype(np.float64)
        image[TOP_PX:] += pattern * (k >= 20) * 4.0
        grey = np.clip(image, 0, 255).astype(np.uint8)
        fixed_pattern.update_mean(grey, TOP_PX, 1.0)
        road = RoadImage(grey, TOP_PX, 13, 2.0)
        if before is not None:
            fixed_pattern.detect(before, road, px, 1.0)
        before = road
    assert fixed_pattern.present
    left = fixed_pattern.subtract(grey, TOP_PX).astype(np.float64)
    assert float((left * pattern).sum() / (pattern**2).sum()) < 0.3 * 4.0  # of a mean over all 40 images 0.6


def road_image(rng: np.random.Generator) -> np.ndarray:
    """(H, W) a road with new texture in each image, and two fixed lane lines."""
    grain = cv2.GaussianBlur(rng.normal(0.0, 40.0, (192, 640)), (0, 0), 1.5)
    image = np.clip(110.0 + grain, 0, 255).astype(np.uint8)
    for x in (60, 600):
        cv2.line(image, (320, 96), (x, 191), 230, 4)
    return image


def with_bonnet(image: np.ndarray, row: int, rng: np.random.Generator) -> np.ndarray:
    """Dark lacquer in which something else is mirrored each time, higher in the middle."""
    curve = row + 12.0 * np.square(np.linspace(-1.0, 1.0, 640))
    below = np.arange(192)[:, None] >= curve
    mirrored = cv2.GaussianBlur(rng.normal(45.0, 60.0, (192, 640)), (0, 0), 8.0)
    return np.where(below, np.clip(mirrored, 0, 255), image).astype(np.uint8)


@pytest.mark.parametrize("row", [140, 165])
def test_bonnet_edge_is_found(row: int) -> None:
    rng = np.random.default_rng(1)
    bonnet = Bonnet(BonnetConfig())
    changes = [bonnet.update(with_bonnet(road_image(rng), row, rng), TOP_PX, 1.0) for _ in range(8)]
    assert bonnet.present
    assert sum(changes) == 1
    assert abs(int(bonnet.rows[320]) - row) < 10
    below, above = np.array([[320, row + 5]]), np.array([[320, row - 15]])
    assert len(bonnet.above(below)) == 0
    assert len(bonnet.above(above)) == 1


def test_lane_lines_are_not_a_bonnet() -> None:
    rng = np.random.default_rng(2)
    bonnet = Bonnet(BonnetConfig())
    assert not any(bonnet.update(road_image(rng), TOP_PX, 1.0) for _ in range(12))
    assert not bonnet.present
    px = np.array([[320, 190]])
    assert bonnet.above(px) is px


def test_stationary_car_learns_no_bonnet() -> None:
    rng = np.random.default_rng(1)
    bonnet, image = Bonnet(BonnetConfig()), with_bonnet(road_image(rng), 150, rng)
    bonnet.update(image, TOP_PX, 0.0)
    for _ in range(12):
        bonnet.update(image, TOP_PX, 0.0)
    assert not bonnet.present


def test_a_bonnet_that_is_gone_is_forgotten() -> None:
    rng = np.random.default_rng(1)
    bonnet = Bonnet(BonnetConfig())
    for _ in range(8):
        bonnet.update(with_bonnet(road_image(rng), 150, rng), TOP_PX, 1.0)
    for _ in range(30):
        bonnet.update(road_image(rng), TOP_PX, 1.0)
    assert not bonnet.present


def test_bonnet_with_changing_reflections_is_kept() -> None:
    """Its edge is brighter than the road in one part and darker in another, and hardly there between them."""
    rng = np.random.default_rng(4)
    across = np.linspace(-1.0, 1.0, 640)
    edge, changes = np.arange(192)[:, None] >= 150.0 + 12.0 * across**2, []
    bonnet = Bonnet(BonnetConfig())
    for k in range(60):
        mirrored = 45.0 if k < 10 else 110.0 + 90.0 * np.sin(3.0 * across + k / 20.0)
        changes.append(bonnet.update(np.where(edge, mirrored, road_image(rng)).astype(np.uint8), TOP_PX, 1.0))
        assert bonnet.present or k < 10
    assert sum(changes) == 1  # it comes once
    assert 135 <= bonnet.rows[320] <= 150


def test_line_across_the_windscreen_is_not_a_bonnet() -> None:
    """A reflection is brighter than both its sides."""
    rng = np.random.default_rng(1)
    bonnet = Bonnet(BonnetConfig())
    for _ in range(12):
        image = road_image(rng)
        cv2.line(image, (0, 160), (639, 164), 200, 3)
        bonnet.update(image, TOP_PX, 1.0)
    assert not bonnet.present


def test_bonnet_with_text_starts_at_its_edge() -> None:
    rng = np.random.default_rng(1)
    bonnet = Bonnet(BonnetConfig())
    for _ in range(12):
        image = with_bonnet(road_image(rng), 150, rng)
        cv2.putText(image, "CAMERA 2020-01-01 12:00:00 51.0000 -114.0000", (8, 188), cv2.FONT_HERSHEY_PLAIN, 1.2, 235)
        bonnet.update(image, TOP_PX, 1.0)
    assert abs(int(bonnet.rows[320]) - 150) < 10
