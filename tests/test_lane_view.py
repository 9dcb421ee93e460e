"""The picture of lane detection: it shows the steps of lane detection, and the command works on any drive."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lanes import BOUNDARY, AmodalLanes, Grids, LanesConfig, lane_view
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.runtime.cli.main import main

CONFIG = LanesConfig()


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
