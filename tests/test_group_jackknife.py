"""A vehicle that drives as the car does, and that no detector found, must not give a step its length unnoticed."""

from __future__ import annotations

import numpy as np
import pytest

from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.group_jackknife import length_without_a_part
from birdslam.odometry.corners.resection import resect
from birdslam.odometry.corners.selection import Corners
from birdslam.odometry.corners.sliding_window import SlidingWindow

FOCAL_PX, SIGMA_PX, INFLATION = 400.0, 0.35, 4.0
STEP_M, FRAMES = 0.5, 6
TRUCK_STEP_M = 0.35  # of the newest step, as it brakes later: its landmarks look as if the car had driven so far
REFERENCE, NEWEST = (Pose(np.eye(3), np.array([0.0, 0.0, STEP_M * k])) for k in (FRAMES - 1, FRAMES))


def _scene(truck: bool, rng: np.random.Generator) -> tuple[SlidingWindow, Corners]:
    """A street of houses on both sides and, on the right, a truck or a house as near."""
    far = np.column_stack([rng.uniform(-12, 12, 60), rng.uniform(-5, 1, 60), rng.uniform(45, 90, 60)])
    houses = np.column_stack([rng.choice([-6.0, 6.0], 60), rng.uniform(-4, 1, 60), rng.uniform(18, 32, 60)])
    near = np.column_stack([rng.uniform(5, 6, 24), rng.uniform(-2, 1, 24), rng.uniform(10, 13, 24)])
    points, step_m = np.vstack([far, houses, near]), np.full(144, STEP_M)
    if truck:
        step_m[120:] = TRUCK_STEP_M
    window = SlidingWindow(FOCAL_PX, SIGMA_PX, 2.2)
    ids = np.arange(len(points))

    def seen(places_m: np.ndarray) -> np.ndarray:
        q = points - np.column_stack([np.zeros((len(points), 2)), places_m])
        return q[:, :2] / q[:, 2:] + rng.normal(0.0, SIGMA_PX / FOCAL_PX, (len(points), 2))

    for k in range(FRAMES):
        window.append(k, Pose(np.eye(3), np.array([0.0, 0.0, STEP_M * k])), ids, seen(np.full(144, STEP_M * k)))
    window.triangulate()
    xy = seen(STEP_M * (FRAMES - 1) + step_m)
    return window, Corners(ids, xy, np.zeros(0), np.zeros(len(ids), bool))


def _judged(truck: bool, seed: int) -> tuple[float, float, float]:
    """The step's length in m, by how much it changes without a part of the image, and how many sigmas that is."""
    window, corners = _scene(truck, np.random.default_rng(seed))
    pose, _, _ = resect(window, NEWEST, corners.ids, corners.xy)
    step = float(np.linalg.norm(pose.p - REFERENCE.p))
    return step, *length_without_a_part(window, corners, REFERENCE, pose, INFLATION)


def test_a_truck_beside_the_car_is_noticed_where_it_has_its_way() -> None:
    drawn = [_judged(True, seed) for seed in range(8)]
    misled = [each for each in drawn if each[0] < STEP_M - 0.04]  # in the others the robust kernel rejects it
    assert len(misled) >= 4
    for step_m, change_m, sigmas in misled:
        assert sigmas > 2.0
        assert abs(step_m - STEP_M) < 2.0 * abs(change_m)


@pytest.mark.parametrize("seed", range(5))
def test_a_house_as_near_is_not(seed: int) -> None:
    step_m, _, sigmas = _judged(False, seed)
    assert step_m == pytest.approx(STEP_M, abs=0.03)
    assert sigmas < 2.0


def test_too_few_landmarks_say_nothing() -> None:
    window, corners = _scene(False, np.random.default_rng(0))
    few = Corners(corners.ids[:8], corners.xy[:8], corners.displacement_px, corners.fixed[:8])
    assert length_without_a_part(window, few, REFERENCE, NEWEST, INFLATION) == (0.0, 0.0)
    assert length_without_a_part(window, corners, NEWEST, NEWEST, INFLATION) == (0.0, 0.0)
