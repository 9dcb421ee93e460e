"""Below the horizon nothing is farther than the road: features that appear farther are rejected."""

from __future__ import annotations

import numpy as np
import pytest

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.below_plane import BelowPlaneConfig, BelowPlaneFilter
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.points import is_night, outside

CAMERA = Camera(640, 192, 371.2, 371.2, 319.5, 90.0, height_m=1.65)
LEVEL = GroundPlane(CAMERA.height_m)
ROWS_PX = np.array([130.0, 150.0, 180.0])  # of the road 15, 10 and 7 m ahead


def _window(rows_px: np.ndarray, ratio: float, sigma_rel: float = 0.05) -> SlidingWindow:
    """Landmarks at `ratio` times the road's distance in each row, seen from the origin."""
    window = SlidingWindow(CAMERA.fx_px, 0.35, 2.2)
    px = np.column_stack([np.full(len(rows_px), 300.0), rows_px])
    window.append(0, Pose(np.eye(3), np.zeros(3)), np.arange(len(rows_px)), CAMERA.to_xy(px))
    road_inverse_depth = np.maximum(CAMERA.to_xy(px)[:, 1] / CAMERA.height_m, 1e-3)
    window.rho, window.rho_sigma = road_inverse_depth / ratio, sigma_rel * road_inverse_depth
    return window


def _updated(window: SlidingWindow) -> BelowPlaneFilter:
    below_plane = BelowPlaneFilter(CAMERA, BelowPlaneConfig())
    below_plane.update(window, window.poses[-1], LEVEL)
    return below_plane


@pytest.mark.parametrize("ratio", [0.3, 1.0, 1.6])
def test_features_on_the_road_or_nearer_are_kept(ratio: float) -> None:
    window = _window(ROWS_PX, ratio)
    assert _updated(window).inliers(window.ids).all()
    assert np.isfinite(window.rho).all()


def test_features_behind_the_road_are_rejected_for_their_whole_track() -> None:
    window = _window(ROWS_PX, 4.0)
    below_plane = _updated(window)
    assert np.isnan(window.rho).all()
    assert below_plane.inliers(np.array([1, 2, 9])).tolist() == [False, False, True]
    assert below_plane.inliers(np.array([0, 2])).tolist() == [True, False]  # 0 was lost: an id never comes again


def test_uncertain_depth_is_not_evidence() -> None:
    window = _window(ROWS_PX, 4.0, sigma_rel=0.5)
    assert _updated(window).inliers(window.ids).all()


def test_above_the_horizon_and_far_ahead_everything_is_kept() -> None:
    window = _window(np.array([40.0, 85.0, 100.0]), 50.0)
    assert _updated(window).inliers(window.ids).all()


def test_landmarks_of_unknown_depth_are_not_tested() -> None:
    window = _window(ROWS_PX, 4.0)
    window.rho[:] = np.nan
    assert _updated(window).inliers(window.ids).all()


def test_box_includes_the_glow_of_lamps_at_night() -> None:
    box, beside = np.array([[100.0, 100.0, 140.0, 130.0]]), np.array([[146.0, 115.0], [150.0, 115.0]])
    assert outside(beside, box).tolist() == [True, True]
    assert outside(beside, box, night=True).tolist() == [False, True]
    assert [is_night(np.full((192, 640), grey, np.uint8)) for grey in (30, 90)] == [True, False]
