"""Amodal lanes: contents of the grids, extracted lanes, stable ids, and their picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lane_ids import LaneCloud
from birdslam.lanes.amodal.lanes import (
    BOUNDARY,
    ROAD,
    AmodalLanes,
    Completion,
    Grids,
    LanesConfig,
    cell_centres_m,
    count_cells,
    dense,
    in_cells,
    lane_view,
    points_of,
    segregate,
)
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.perception import Segmentation
from birdslam.runtime.cli.main import main

CONFIG = LanesConfig()
CAMERA = Camera(
    width_px=640, height_px=192, fx_px=370.0, fy_px=370.0, cx_px=320.0, cy_px=88.0, height_m=1.6, pitch_rad=0.02
)


def line_m(y_m: float, start_m: float = 0.0, end_m: float = 60.0, dash_m: float = 0.0, gap_m: float = 0.0) -> Floats:
    x = np.arange(start_m, end_m, 0.1)
    if gap_m:
        x = x[(x % (dash_m + gap_m)) < dash_m]
    return np.column_stack([x, np.full(len(x), y_m)])


def road_m(left_m: float, right_m: float) -> Floats:
    return np.stack(np.meshgrid(np.arange(-5.0, 60.0, 0.2), np.arange(right_m, left_m, 0.2)), axis=-1).reshape(-1, 2)


def drive(road: Floats, boundary: Floats, poses: list[SE2], complete: Completion | None = None) -> list[LaneCloud]:
    """Each pose observes 6 to 15 m ahead."""
    lanes = AmodalLanes(CONFIG, complete)
    for pose in poses:
        seen = [pose.inverse() @ points for points in (road, boundary)]
        lanes.add(pose, *(points[(points[:, 0] > 6.0)] for points in seen))
    return list(lanes.lanes(poses[-1]))


AHEAD = [SE2(0.5 * k) for k in range(40)]


def test_each_line_is_a_lane_at_its_position() -> None:
    boundary = np.concatenate([line_m(-3.6), line_m(0.1, dash_m=3.0, gap_m=3.0), line_m(3.4)])
    lanes = drive(road_m(5.0, -5.0), boundary, AHEAD)
    assert [np.median(lane.points_m[:, 1]) for lane in lanes] == pytest.approx([-3.6, 0.1, 3.4], abs=CONFIG.cell_m)
    assert len({lane.lane for lane in lanes}) == 3
    for lane in lanes:
        assert lane.points_m[:, 0].min() < -5.0  # earlier observations are behind the ego
        assert lane.points_m[:, 0].max() > 13.0


@pytest.mark.parametrize("radius_m", [20.0, 30.0, 60.0])
def test_a_bend_is_one_lane(radius_m: float) -> None:
    angle = np.arange(-8.0, 24.0, 0.1) / radius_m
    arc = np.column_stack([radius_m * np.sin(angle), radius_m * (1.0 - np.cos(angle)) - 3.0])
    lanes = AmodalLanes(CONFIG)
    lanes.add(SE2(), road_m(16.0, -16.0), arc)
    (lane,) = lanes.lanes(SE2())
    assert len(lane.points_m) > 80


def test_lines_apart_from_the_road_and_specks_are_dropped() -> None:
    wall, speck = line_m(12.0), np.tile([[10.1, 1.1]], (5, 1))
    assert drive(road_m(5.0, -5.0), np.concatenate([wall, speck]), AHEAD) == []


def test_empty_grid_has_no_lane() -> None:
    lanes = AmodalLanes(CONFIG)
    assert lanes.lanes(SE2()) == ()
    lanes.add(SE2(), np.zeros((0, 2)), np.zeros((0, 2)))
    assert lanes.lanes(SE2()) == ()
    assert not lanes.grids(SE2()).any()


def test_ids_stay_with_their_lanes() -> None:
    road, boundary = road_m(5.0, -5.0), np.concatenate([line_m(-3.6), line_m(3.4)])
    lanes = AmodalLanes(CONFIG)
    sides = []
    for pose in AHEAD:
        seen = [pose.inverse() @ points for points in (road, boundary)]
        lanes.add(pose, *(points[points[:, 0] > 6.0] for points in seen))
        sides.append({lane.lane: np.sign(np.median(lane.points_m[:, 1])) for lane in lanes.lanes(pose)})
    assert all(len(side) == 2 for side in sides)
    assert all(side == sides[0] for side in sides)
    lanes.clear()
    assert lanes.lanes(AHEAD[-1]) == ()


def test_completion_adds_hidden_lanes() -> None:
    boundary = np.concatenate([line_m(-3.6), line_m(3.4, end_m=16.0)])

    def mirrored(grids: Grids) -> Grids:
        return np.maximum(grids, grids[:, :, ::-1])

    seen = drive(road_m(5.0, -5.0), boundary, AHEAD)
    whole = drive(road_m(5.0, -5.0), boundary, AHEAD, mirrored)
    far = max(lane.points_m[:, 0].max() for lane in whole if np.median(lane.points_m[:, 1]) > 0)
    assert max((lane.points_m[:, 0].max() for lane in seen if np.median(lane.points_m[:, 1]) > 0), default=-99.0) < 0.0
    assert far > 14.0


def test_completion_adds_no_lane_without_observation() -> None:
    def with_one_more(grids: Grids) -> Grids:
        out = grids.copy()
        out[BOUNDARY, :, 64] = 1.0
        return out

    (lane,) = drive(road_m(5.0, -5.0), line_m(-3.6), AHEAD, with_one_more)
    assert np.median(lane.points_m[:, 1]) == pytest.approx(-3.6, abs=CONFIG.cell_m)


def test_points_are_reported_once() -> None:
    lanes = AmodalLanes(CONFIG)
    assert lanes.has_moved(SE2())
    lanes.add(SE2(), np.zeros((0, 2)), np.zeros((0, 2)))
    assert not lanes.has_moved(SE2(0.5 * CONFIG.step_m, 0.0, 0.5 * CONFIG.step_rad))
    assert lanes.has_moved(SE2(-CONFIG.step_m))
    assert lanes.has_moved(SE2(0.0, 0.0, 2.0 * CONFIG.step_rad))


@given(st.floats(-3.0, 3.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_the_world_frame_does_not_matter(yaw_rad: float, x_m: float, y_m: float) -> None:
    road, boundary = road_m(5.0, -5.0), line_m(2.0)
    moved = AmodalLanes(CONFIG)
    still = AmodalLanes(CONFIG)
    for pose in AHEAD[::4]:
        seen = [pose.inverse() @ points for points in (road, boundary)]
        still.add(pose, *seen)
        moved.add(SE2(x_m, y_m, yaw_rad) @ pose, *seen)
    a, b = still.grids(AHEAD[-4]), moved.grids(SE2(x_m, y_m, yaw_rad) @ AHEAD[-4])
    assert np.mean(np.abs(a - b) > 0.6) < 0.02  # points on a cell's edge may fall to either side


# In 1/64 m, which float32 has exactly, and the cells' edges among them
METRES = st.integers(-40 * 64, 60 * 64).map(lambda n: n / 64.0)


@given(st.lists(st.tuples(METRES, METRES), max_size=50))
def test_every_point_of_the_grid_is_counted_once(points: list[tuple[float, float]]) -> None:
    cloud = np.array(points).reshape(-1, 2)
    inside = (cloud[:, 0] >= -CONFIG.behind_m) & (cloud[:, 0] < CONFIG.ahead_m)
    inside &= (cloud[:, 1] >= -CONFIG.half_width_m) & (cloud[:, 1] < CONFIG.half_width_m)
    halves = [cloud[::2], cloud[1::2]]  # of two frames
    cells = [in_cells(half.astype(np.float32)[:, None], SE2(), CONFIG) for half in halves]
    counts = count_cells(cells, CONFIG)
    assert counts.shape == CONFIG.shape == (128, 128)
    assert counts.sum() == inside.sum()
    centres = cell_centres_m(counts > 0, CONFIG)
    for point in cloud[inside]:
        assert np.abs(centres - point).max(axis=1).min() <= 0.5 * CONFIG.cell_m + 1e-9


def test_single_cell_is_dropped() -> None:
    cells = np.zeros(CONFIG.shape, dtype=np.bool_)
    cells[5, 5] = cells[40:43, 40] = True
    kept = dense(cells, CONFIG)
    assert not kept[5, 5]
    assert kept[41, 40]
    assert not (kept & ~cells).any()


def test_masks_are_sampled_on_the_road_plane() -> None:
    rows, columns = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    px = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    ego = bev.pixel_to_ego(CAMERA, CAMERA.ground, px).reshape(*rows.shape, 2)
    with np.errstate(invalid="ignore"):
        road = np.abs(ego[..., 1]) < 4.0
        lane = np.abs(ego[..., 1] - 2.0) < 0.15
    masks = Segmentation(road=road, lane=lane)
    seen_road, seen_lane = points_of(masks, CAMERA, CAMERA.ground, np.zeros((0, 4)), CONFIG)
    assert len(seen_road) > 1000
    assert np.abs(seen_road[:, 1]).max() < 4.2
    assert np.abs(seen_lane[:, 1] - 2.0).max() < 0.35
    assert seen_road[:, 0].max() < CONFIG.depth_m
    hidden = np.array([[0.0, 0.0, CAMERA.width_px, CAMERA.height_px]])
    assert all(not len(p) for p in points_of(masks, CAMERA, CAMERA.ground, hidden, CONFIG))


def test_grids_are_valid_input_of_segregate() -> None:
    grids = np.zeros((2, *CONFIG.shape), dtype=np.float32)
    grids[ROAD, :, 30:100] = 1.0
    grids[BOUNDARY, 10:100, 64] = 1.0
    (lane,) = segregate(grids, CONFIG)
    assert np.ptp(lane[:, 1]) < 2 * CONFIG.cell_m
    assert len(lane) >= 88


def seen_of_a_road() -> AmodalLanes:
    """Two lines along a road, the left one hidden for 6 m; a network that continues lines to the whole grid."""

    def complete(grids: Grids) -> Grids:
        out = np.zeros_like(grids)
        out[BOUNDARY, :, grids[BOUNDARY].sum(axis=0) > 3.0] = 1.0
        return out

    amodal = AmodalLanes(CONFIG, complete)
    x = np.arange(0.5, 4.9, 0.1)
    for step in range(40):
        T_world_ego = SE2(0.25 * step)
        at = T_world_ego.x_m + x
        hidden = (at > 4.0) & (at < 10.0)
        right = np.column_stack([x, np.full(len(x), -1.8)])
        left = np.column_stack([x, np.full(len(x), 1.8)])[~hidden]
        road = np.column_stack([g.ravel() for g in np.meshgrid(x, np.arange(-1.7, 1.8, 0.1))])
        for _ in range(3):
            amodal.add(T_world_ego, road, np.concatenate([right, left]))
    return amodal


def test_view_shows_the_grids_without_side_effects() -> None:
    amodal = seen_of_a_road()
    at = SE2(9.75)
    view = lane_view(amodal, at)
    again = lane_view(amodal, at)
    np.testing.assert_array_equal(view.seen, again.seen)
    np.testing.assert_array_equal(view.seen, amodal.grids(at))
    assert (view.completed >= view.seen).all()
    assert view.completed[BOUNDARY].sum() > view.seen[BOUNDARY].sum()
    cells, more = (sum(len(cloud) for cloud in clouds) for clouds in (view.lanes_seen, view.lanes))
    assert 0 < cells < more
    named = amodal.lanes(at)
    assert {cloud.lane for cloud in named} == set(range(len(named)))  # the view gave none an id before
    for cloud in named:
        assert any(np.array_equal(cloud.points_m, points) for points in view.lanes)


def test_without_a_network_nothing_is_completed() -> None:
    amodal = seen_of_a_road()
    amodal.complete = None
    view = lane_view(amodal, SE2(9.75))
    np.testing.assert_array_equal(view.completed, view.seen)


def test_a_network_that_fails_completes_nothing() -> None:
    amodal = seen_of_a_road()
    amodal.complete = lambda grids: np.full_like(grids, np.nan)
    view = lane_view(amodal, SE2(9.75))
    np.testing.assert_array_equal(view.completed, view.seen)


@pytest.mark.parametrize(
    "shape", [(90, 300, 3), pytest.param((90, 300), marks=pytest.mark.slow)], ids=["colour", "grey"]
)
def test_the_picture_has_image_cells_and_lanes(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = tmp_path / "lanes.png"
    draw_lanes("a road", np.full(shape, 90, np.uint8), lane_view(seen_of_a_road(), SE2(9.75)), CONFIG, path)
    drawn = cv2.imread(str(path))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50


def test_a_missing_frame_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "lanes", "demo", "--frame", "100000", "--output", str(tmp_path / "out")]) != 0
    assert "--frame 100000" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
