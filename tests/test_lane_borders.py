"""Unpainted borders of the ego lane, the pitch of noisy lines, and lanes against traced borders and masks of lines."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.bench.lanes import line_masks
from birdslam.bench.lanes.kitti_road import LANE, Still
from birdslam.bench.lanes.later_lanes import LaterLanes
from birdslam.bench.lanes.true_borders import Borders, BorderScores, TrueBorders, read_borders, text_of
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.lanes.borders import border_points
from birdslam.lanes.line_filter import LineFilter
from birdslam.lanes.outline import line_px
from birdslam.lanes.paint import LinePoints, edge_points
from birdslam.lanes.road_view import RoadView, road_view
from birdslam.lanes.topology import LaneRow
from birdslam.perception import Segmentation
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.types import Estimate, Lane, LaneChange, LaneLine, Lanes, LineKind

CAMERA = Camera(640, 240, 420.0, 420.0, 319.5, 90.0, height_m=1.5)
COV = tuple(np.diag([0.01, 1e-5, 1e-8, 1e-12]).ravel().tolist())


def view_of(curb_m: float, mask_to_m: float, shade: bool = False) -> RoadView:
    """Asphalt with texture up to a paler verge at `curb_m`; the road's mask ends at `mask_to_m`."""
    rng = np.random.default_rng(3)
    image = np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8)
    blank = Segmentation(road=image == 0, lane=image > 0)
    view = road_view(CAMERA, CAMERA.ground, image, blank, np.zeros((0, 4)))
    grey = 100.0 + rng.normal(0.0, 6.0, view.grey.shape)
    grey[:, view.y_m < curb_m] += 25.0
    if shade:  # of a wall, oblique to the road
        grey[view.y_m[None] < 1.0 - 0.15 * view.x_m[:, None]] -= 40.0
    road = np.broadcast_to((view.y_m > mask_to_m) & (view.y_m < 5.0), view.road.shape) & ~view.outside
    return RoadView(**{**vars(view), "grey": grey.astype(np.float32), "road": road})


@pytest.mark.parametrize("shade", [False, True])
@pytest.mark.parametrize("mask_to_m", [-1.6, -6.0, 0.0])
def test_an_unpainted_border_is_where_the_asphalt_ends(mask_to_m: float, shade: bool) -> None:
    view = view_of(-1.6, mask_to_m, shade)
    _, mask = edge_points(view, np.zeros(len(view.x_m)))
    found = border_points(view, np.full(len(view.x_m), 1.6), np.ones(len(view.x_m)), -1, mask)
    assert len(found) > 20
    assert np.median(found.y_m) == pytest.approx(-1.6, abs=0.1)


def test_noise_of_lines_does_not_bias_the_pitch() -> None:
    tilts = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = np.tile(np.arange(5.0, 30.0, 0.5), 2)
        y = np.repeat([1.7, -1.7], 50) + rng.normal(0.0, 0.25, 100)
        n = len(x)
        points = LinePoints(
            x, y, np.full(n, 0.25), np.full(n, 0.4), np.ones(n, bool), np.full(n, np.nan), np.full(n, 1e-3)
        )
        lines = LineFilter()
        lines.restart(np.array([1.7, -1.7]), np.zeros(2), 0.0, np.zeros(2, bool))
        _, tilt = lines.update(points, np.zeros(n, int), np.zeros(2, int), 1.5, 0.015, 10.0, 0.0, True)
        tilts.append(tilt.pitch_rad)
    assert abs(np.mean(tilts)) < 3.0 * np.std(tilts) / np.sqrt(20) + 3e-4


class Straight(Recording):
    """A drive of 60 m straight ahead without images."""

    name, camera, rate_hz = "straight", CAMERA, 10.0

    def __init__(self, has_truth: bool = True) -> None:
        self._has_truth = has_truth

    def __len__(self) -> int:
        return 61

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        yield from ()

    def truth_poses(self) -> Floats | None:
        rows = np.tile(np.eye(3, 4), (61, 1, 1))
        rows[:, 2, 3] = np.arange(61.0)
        return rows if self._has_truth else None


def lanes_of(left_m: float, right_m: float) -> Lanes:
    own = Lane(
        offset_m=0.5 * (left_m + right_m),
        slope=0.0,
        curvature_per_m=0.0,
        curvature_rate_per_m2=0.0,
        cov=COV,
        width_m=left_m - right_m,
        width_slope=0.0,
        width_sigma_m=0.1,
        to_m=40.0,
    )
    return Lanes(lanes=(own,), ego_index=0)


def test_a_lane_against_traced_borders(tmp_path: Path) -> None:
    file = tmp_path / "borders.json"
    file.write_text(json.dumps({"left": [[0.0, 1.5], [60.0, 1.5]], "right": [[0.0, -2.0], [60.0, -2.0]]}))
    truth = TrueBorders(Straight(), read_borders(file))
    assert truth.covers(20, 33.0)
    assert not truth.covers(30, 33.0)
    left, right = truth.borders_m(20)
    assert np.abs(left[:, 1] - 1.5).max() < 1e-9
    assert np.abs(right[:, 1] + 2.0).max() < 1e-9
    assert np.abs(left[:, 2]).max() < 1e-9  # on the road
    mask = truth.mask(20, np.zeros((CAMERA.height_px, CAMERA.width_px), bool))
    v = 160  # 9 m ahead
    columns = np.flatnonzero((mask[v] == LANE).all(axis=1))
    assert columns[0] == pytest.approx(319.5 - 1.5 / 1.5 * (v - 90.0), abs=1.5)
    assert columns[-1] == pytest.approx(319.5 + 2.0 / 1.5 * (v - 90.0), abs=1.5)
    scores = BorderScores()
    scores.add(lanes_of(1.6, -2.0), left, right)
    scores.add(lanes_of(1.5, -2.8), left, right)
    scores.add(None, left, right)
    report = scores.report("straight")
    assert (report.with_lane, report.false) == (pytest.approx(2 / 3), 0.5)
    assert report.ranges[0].error_median_m == pytest.approx(0.05)
    assert report.ranges[0].within_2_sigma == 0.5
    assert "ego lane in 0.67" in text_of(report)


def test_a_yaw_turns_traced_borders() -> None:
    line = [(0.0, 0.0), (60.0, 0.0)]
    left, _ = TrueBorders(Straight(), Borders(line, line, yaw_rad=0.01)).borders_m(0)
    assert float(np.interp(20.0, left[:, 0], left[:, 1])) == pytest.approx(0.2, abs=0.01)  # the camera looks right


def later(lanes: dict[int, Lanes], change: int = -1, valid: bool = True) -> LaterLanes:
    """60 m straight ahead in steps of 1 m, with a lane from -2 to 1.5 m where `lanes` has no other."""
    out = LaterLanes()
    for k in range(61):
        own = lanes.get(k, lanes_of(1.5, -2.0))
        if k == change:
            own = msgspec.structs.replace(own, change=LaneChange.LEFT)
        pose = SE2(1.01 * k, 0.0, 0.0)
        cov = tuple(np.eye(3).ravel().tolist())
        out.add(
            Estimate(
                epoch=0,
                frame_id=k,
                t_source_ns=k,
                t_capture_ns=k,
                t_utc_ns=k,
                T_world_ego=pose,
                cov=cov,
                valid=valid or k < 20,
                lanes=own,
            )
        )
    return out


def test_a_lane_against_that_which_is_found_later() -> None:
    scores, worst = later({3: lanes_of(1.9, -2.0)}).scores(2)
    report = scores.report("straight")
    assert worst[0] == 3
    assert [at.error_median_m for at in report.ranges] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert scores.errors[30.0][1][:2] == pytest.approx((0.4, 0.0), abs=1e-9)
    assert report.ranges[2].frames == 61 - 2 - 24  # 6 m ahead of the last frame the road is unknown
    assert later({}).scores(30)[0].report("straight").frames == 61 - 30 - 4


def test_lanes_are_not_compared_across_a_change_a_gap_or_invalid_frames() -> None:
    others = {k: lanes_of(5.0, 1.5) for k in range(30, 61)}
    gap = {k: Lanes() for k in range(30, 36)}
    for drive in (later(others, change=30), later(gap), later(others, valid=False)):
        scores, _ = drive.scores(0)
        for x_m, errors in scores.errors.items():
            assert max((max(off[:2]) for off in errors), default=0.0) == pytest.approx(0.0, abs=1e-9), x_m
    assert len(later(gap).scores(0)[0].errors[30.0]) < len(later({}).scores(0)[0].errors[30.0])


def test_borders_need_poses_and_a_sound_file(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no true poses"):
        TrueBorders(Straight(has_truth=False), Borders([(0.0, 1.0)], [(0.0, -1.0)]))
    with pytest.raises(DatasetError, match="missing"):
        read_borders(tmp_path / "missing.json")


def test_lines_against_masks_of_lines(tmp_path: Path) -> None:
    line = LaneLine(
        line=0,
        offset_m=1.8,
        slope=0.0,
        curvature_per_m=0.0,
        curvature_rate_per_m2=0.0,
        cov=COV,
        seen_from_m=3.0,
        seen_to_m=40.0,
        to_m=60.0,
    )
    lines = line, msgspec.structs.replace(line, line=1, offset_m=-1.8)
    camera = line_masks.camera_of(np.zeros((720, 1280, 3), np.uint8))
    mask = np.zeros((720, 1280), np.uint8)
    for value, y in ((20, 1.8), (70, -1.8), (120, 5.4)):
        shifted = msgspec.structs.replace(line, offset_m=y)
        px = np.round(line_px(camera, camera.ground, shifted, 5.0)).astype(np.int32)
        cv2.polylines(mask, [px], False, int(value), 5)
    edge = msgspec.structs.replace(line, offset_m=5.4, kind=LineKind.EDGE, line=5)
    still = Still((*lines, edge), LaneRow((), None), camera.ground, mask > 0)
    score = line_masks.score_lines("image_0.jpg", camera, still, cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR))
    assert (score.true, score.found, score.right) == (3, 2, 2)
    assert score.error_px < 1.5
    assert line_masks.report_of([score]).f1 == pytest.approx(0.8)
    with pytest.raises(DatasetError, match="no pairs"):
        line_masks.find_pairs(tmp_path)
