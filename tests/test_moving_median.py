"""The paper's metric scale: road points by Eq. 1 over the odometry's depths, with a moving median."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from birdslam.geometry.camera import AXES_EGO_CAM, Camera
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.metric_scale import RoadView
from birdslam.odometry.odometry import Odometry, OdometryConfig
from birdslam.odometry.road.moving_median import MovingMedianScale
from birdslam.odometry.road.scale import RoadScale
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.runtime.configuration import ConfigurationError, load
from birdslam.types import Status

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, height_m=1.65, pitch_rad=0.01, roll_rad=-0.005)
GREY = np.zeros((375, 1242), np.uint8)
STEP_M = 0.8
CONFIG = RoadScaleConfig(mode="paper")


class Street:
    """Corners without noise on the road and on house fronts, seen by an odometry whose unit is `unit_m` metres."""

    def __init__(self, unit_m: float) -> None:
        self.window = SlidingWindow(721.5, 0.35, 2.2)
        self.unit_m = unit_m
        self.frame = -1
        z = np.arange(4.0, 60.0, 0.7)
        side = np.where(np.arange(len(z)) % 2, 1.0, -1.0)
        road = np.column_stack([side * (0.4 + z % 2.0), np.full(len(z), CAMERA.height_m), z])
        fronts = np.column_stack([6.0 * side, CAMERA.height_m - 0.5 - z % 2.5, z])
        level = np.concatenate([road, fronts])  # in the axes of a level camera
        self._points = level @ AXES_EGO_CAM.T @ CAMERA.ground.R_ego_cam
        self._ahead = CAMERA.ground.R_ego_cam.T @ np.array([1.0, 0.0, 0.0])  # the car's own, in camera axes

    def drive(self, scale: MovingMedianScale, wrong: float = 1.0) -> tuple[Pose, float]:
        """One frame on: the step in the window's unit before, and the factor on it."""
        self.frame += 1
        window, step = self.window, Pose(np.eye(3), self._ahead * STEP_M / self.unit_m)
        at = self._points - self.frame * STEP_M * self._ahead
        xy = at[:, :2] / np.maximum(at[:, 2:], 0.1)
        px = CAMERA.to_px(xy)
        ids = np.flatnonzero((at[:, 2] > 2.0) & (px > 0).all(axis=1) & (px < [1242, 375]).all(axis=1))
        pose = window.poses[-1] @ step if window.poses else Pose(np.eye(3), np.zeros(3))
        window.append(self.frame, pose, ids, xy[ids])
        while len(window.poses) > 8:
            window.drop(0)
        if self.frame == 0:
            return step, 1.0
        window.triangulate()
        window.rescale(1.0 / wrong)
        view = RoadView(GREY, window.poses[-1], np.zeros((0, 4)), None, window)
        factor = scale.measure_scale(step, view)
        window.rescale(wrong * factor)
        self.unit_m /= factor
        return step, factor


@pytest.mark.parametrize("unit_m", [0.3, 1.0, 5.0])
def test_without_noise_the_scale_is_found_exactly_and_kept(unit_m: float) -> None:
    street, scale = Street(unit_m), MovingMedianScale(CAMERA, CONFIG)
    factors = [street.drive(scale)[1] for _ in range(12)]
    assert factors[1] == pytest.approx(unit_m, rel=1e-6)
    assert factors[2:] == pytest.approx([1.0] * 10, rel=1e-6)
    assert street.unit_m == pytest.approx(1.0, rel=1e-6)
    assert scale.status() == []
    assert scale.ground == CAMERA.ground


@pytest.mark.parametrize("wrong", [0.2, 5.0])
def test_a_wrong_scale_of_one_frame_does_not_move_the_median(wrong: float) -> None:
    street, scale = Street(2.0), MovingMedianScale(CAMERA, CONFIG)
    for _ in range(6):
        street.drive(scale)
    assert scale.frame_scale(_view(street)) == pytest.approx(1.0, rel=1e-6)
    _, factor = street.drive(scale, wrong)
    assert factor == pytest.approx(1.0, rel=1e-6)
    for _ in range(10):  # wrong ones that last for most of the window do
        street.drive(scale, wrong)
    assert street.unit_m == pytest.approx(1.0 / wrong, rel=1e-6)


def _view(street: Street) -> RoadView:
    return RoadView(GREY, street.window.poses[-1], np.zeros((0, 4)), None, street.window)


def scales(given: Sequence[float], frames: int) -> list[float]:
    """What the moving median makes of the scales of a unit that is never rescaled."""
    scale, out = MovingMedianScale(CAMERA, msgspec.structs.replace(CONFIG, median_frames=frames)), []
    total, street = 1.0, Street(1.0)
    street.drive(scale)
    for wanted in given:
        scale.frame_scale = lambda view, s=wanted: s / total  # noqa: B023
        total *= scale.measure_scale(Pose(np.eye(3), np.zeros(3)), _view(street))
        out.append(total)
    return out


def test_scale_is_the_median_of_the_last_frames() -> None:
    given = [3.0, 1.0, 2.0, 8.0, 9.0, 10.0, 1.5]
    assert scales(given, 3) == pytest.approx([3.0, 2.0, 2.0, 2.0, 8.0, 9.0, 9.0])
    assert scales(given, 1) == pytest.approx(given)


def test_a_hidden_road_carries_the_scale_and_a_new_window_forgets_it() -> None:
    street, scale = Street(2.0), MovingMedianScale(CAMERA, CONFIG)
    assert scale.status() == [Status.SCALE_CARRIED, Status.SCALE_INVALID]
    for _ in range(8):
        street.drive(scale)
    known = scale.sigma_rel
    assert known < CONFIG.invalid_sigma_rel
    everything = np.array([[0.0, 0.0, 1242.0, 375.0]])
    hidden = RoadView(GREY, street.window.poses[-1], everything, None, street.window)
    for _ in range(10):
        assert scale.measure_scale(Pose(np.eye(3), np.array([0.0, 0.0, STEP_M])), hidden) == 1.0
    assert scale.status() == [Status.SCALE_CARRIED]
    scale.restart(GREY, street.window.poses[-1], 0.2)
    assert scale.is_unknown


def test_key_selects_the_strategy_and_is_validated(tmp_path: Path) -> None:
    key = "slam.frontend.odometry.road.mode"
    assert isinstance(Odometry(CAMERA)._scale, RoadScale)  # private: else a drive for each
    paper = load(None, {key: "paper"}).slam.frontend.odometry
    assert isinstance(Odometry(CAMERA, paper)._scale, MovingMedianScale)  # private: likewise
    with pytest.raises(ConfigurationError, match=key):
        load(None, {key: "median"})
    with pytest.raises(msgspec.ValidationError, match="median_frames"):
        msgspec.convert({"road": {"median_frames": 0}}, OdometryConfig)
    path = tmp_path / "paper.toml"
    path.write_text("[slam.frontend.odometry.road]\nmoed = 'paper'\n")
    with pytest.raises(ConfigurationError, match=r"slam\.frontend\.odometry\.road\.moed"):
        load(path)
