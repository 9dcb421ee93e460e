"""Lane lines as curves: motion, single images, drives, lanes, their users, the map, real images."""

from __future__ import annotations

import json
import math
from itertools import product
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.bench.lanes.kitti_road import Still, find_lane, find_pairs, iou, score
from birdslam.bench.lanes.true_lines import LineScores, TrueLine
from birdslam.bench.lanes.true_vehicles import VehicleScores, true_place
from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import basis, transform_curves
from birdslam.lanes.ego_lane import EgoLane
from birdslam.lanes.line_filter import PLANE_AT_M, LineFilter
from birdslam.lanes.line_tracker import LineTracker, find_lines_in_image
from birdslam.lanes.occupancy import MAX_DISTANCE_M, with_users
from birdslam.lanes.outline import lane_mask, lane_px, line_px
from birdslam.lanes.paint import MAX_UNMASKED_PIXEL_M, LinePoints, paint_points
from birdslam.lanes.road_view import road_view
from birdslam.lanes.topology import lane_row
from birdslam.lanes.traffic import STATED_SIDE_EVIDENCE, Traffic, TrafficState, initial_state
from birdslam.lanes.users import UserInEgo, person_in_ego
from birdslam.outputs.drive_video import MAX_SCALE, MAX_WIDTH_PX, SideBySide
from birdslam.outputs.line_map import LineMap
from birdslam.perception import Segmentation
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.evaluation.still_lanes import evaluate_stills
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.foxglove import SceneUpdate
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import TrueBody
from birdslam.types import (
    Bound,
    FollowedPerson,
    LaneChange,
    LaneLine,
    Lanes,
    LineColour,
    LineKind,
    VehicleLane,
)
from tests.calls import calls
from tests.records import new_estimate, new_vehicle

CAMERA = Camera(640, 240, 420.0, 420.0, 319.5, 90.0, height_m=1.5)
NOBODY = np.zeros((0, 4))
DASH_M, PERIOD_M = 3.0, 9.0
curves = st.tuples(st.floats(-6, 6), st.floats(-0.2, 0.2), st.floats(-0.01, 0.01), st.floats(-1e-4, 1e-4))
steps = st.tuples(st.floats(-1, 4), st.floats(-0.5, 0.5), st.floats(-0.1, 0.1))


@given(curves, steps)
def test_moved_curve_is_at_the_same_place(curve: tuple[float, ...], step: tuple[float, float, float]) -> None:
    old, T_old_new = np.array(curve), SE2(*step)
    new, _ = transform_curves(old, T_old_new)
    x = np.array([0.0, 3.0, 8.0])
    at = T_old_new @ np.column_stack([x, basis(x) @ new])
    assert np.abs(basis(at[:, 0]) @ old - at[:, 1]).max() < 0.03  # a cubic turned is a cubic to third order


@given(curves, steps)
def test_the_derivative_of_a_moved_curve(curve: tuple[float, ...], step: tuple[float, float, float]) -> None:
    old, T_old_new = np.array(curve), SE2(*step)
    _, J = transform_curves(old, T_old_new)
    size = np.array([1e-4, 1e-5, 1e-6, 1e-7])
    for k in range(4):
        by = np.eye(4)[k] * size[k]
        numeric = (transform_curves(old + by, T_old_new)[0] - transform_curves(old - by, T_old_new)[0]) / (
            2.0 * size[k]
        )
        # In a turn of 0.1 rad the first order that the filter takes is good to some percent
        assert np.abs((numeric - J[:, k]) * size[k] / size).max() < 0.12 * max(
            1.0, np.abs(J[:, k] * size[k] / size).max()
        )


def picture(
    T_world_ego: SE2,
    offsets_m: tuple[float, ...],
    dashed: tuple[bool, ...],
    bend: float = 0.0,
    pitch_rad: float = 0.0,
    stripe_m: float = 0.14,
    vertical_per_m: float = 0.0,
) -> tuple[np.ndarray, Segmentation]:
    """A grey road between edges at +-8 m with lines along world's x, and its segmentation.

    It rises ahead of the ego by `vertical_per_m` x^2 / 2.
    """
    ground = GroundPlane(CAMERA.height_m, pitch_rad)
    image = np.full((CAMERA.height_px, CAMERA.width_px), 150, np.uint8)
    road, lane = (np.zeros(image.shape, np.uint8) for _ in range(2))
    x = np.arange(2.0, 80.0, 0.5)

    def band(low_m: float, high_m: float, start_m: float, end_m: float, planes: list[tuple[np.ndarray, int]]) -> None:
        along = np.clip(np.arange(start_m, end_m + 0.25, 0.25), 2.0, 90.0)
        world_x = along + T_world_ego.x_m
        left, right = (
            T_world_ego.inverse() @ np.column_stack([world_x, off + 0.5 * bend * world_x**2]) for off in (high_m, low_m)
        )
        outline = np.vstack([left, right[::-1]])
        rise_m = 0.5 * vertical_per_m * outline[:, 0] ** 2
        px = bev.ego_to_pixel(CAMERA, ground, np.column_stack([outline, rise_m]))
        if np.isfinite(px).all():
            for plane, value in planes:
                cv2.fillPoly(plane, [np.round(px * 16).astype(np.int32)], value, shift=4)

    band(-8.0, 8.0, 2.0, 80.0, [(image, 90), (road, 1)])
    for offset, gaps in zip(offsets_m, dashed, strict=True):
        first = -(T_world_ego.x_m % PERIOD_M)
        pieces = [(s, s + DASH_M) for s in np.arange(first, 80.0, PERIOD_M)] if gaps else [(2.0, x[-1])]
        for start, end in pieces:
            if end > 2.5:
                band(offset - 0.5 * stripe_m, offset + 0.5 * stripe_m, max(start, 2.0), end, [(image, 220), (lane, 1)])
    return cv2.GaussianBlur(image, (3, 3), 0), Segmentation(road=road > 0, lane=lane > 0)


@pytest.mark.parametrize("pitch_rad", [-0.02, 0.0, 0.02])
@pytest.mark.parametrize("bend", [0.0, 0.004])
def test_the_lines_of_one_image_and_its_pitch(pitch_rad: float, bend: float) -> None:
    image, masks = picture(SE2(0.0, 0.3, 0.0), (5.2, 1.7, -1.8), (False, True, False), bend, pitch_rad)
    lines, ground = find_lines_in_image(CAMERA, image, masks, NOBODY)
    row = lane_row(lines)
    assert row.ego is not None
    own = row.lanes[row.ego]
    assert own.left_bound is own.right_bound is Bound.PAINT
    assert math.degrees(abs(ground.pitch_rad - pitch_rad)) < 0.6  # the prior holds it back
    assert own.width_m == pytest.approx(3.5, rel=0.06)
    truth = 0.5 * (1.7 - 1.8) - 0.3 + 0.5 * bend * 10.0**2
    assert own.centre_m(10.0) == pytest.approx(truth, abs=0.12)


def drive(tracker: LineTracker, poses: list[SE2], hidden_from: int = 10**6) -> list[tuple[LaneLine, ...]]:
    """The lines after each image; from `hidden_from` on a car covers the left line."""
    out = []
    for k, pose in enumerate(poses):
        image, masks = picture(pose, (1.75, -1.75), (True, False))
        boxes = NOBODY
        if k >= hidden_from:
            masks.road[:, :300], masks.lane[:, :300] = False, False
            image[:, :300] = 60
            boxes = np.array([[0.0, 0.0, 300.0, 240.0]])
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, boxes)
        out.append(tracker.lines().at(pose))
    return out


def test_ids_are_stable_and_dashed_is_distinguished_from_solid() -> None:
    poses = [SE2(2.0 * k, 0.2 * math.sin(0.2 * k), 0.02 * math.cos(0.2 * k)) for k in range(25)]
    seen = drive(LineTracker(CAMERA), poses)
    left = [[line for line in lines if 0.5 < line.offset_m < 3.0 and line.kind is not LineKind.EDGE] for lines in seen]
    right = [
        [line for line in lines if -3.0 < line.offset_m < -0.5 and line.kind is not LineKind.EDGE] for lines in seen
    ]
    for lines, y_m, kind in ((left, 1.75, LineKind.DASHED), (right, -1.75, LineKind.SOLID)):
        assert all(len(found) == 1 for found in lines[3:])
        assert len({found[0].line for found in lines[3:]}) == 1
        assert lines[-1][0].kind is kind
        for pose, (line,) in zip(poses[3:], lines[3:], strict=True):
            truth = (pose.inverse() @ np.array([[pose.x_m + 10.0, y_m]]))[0]
            assert abs(line.y_m(truth[0]) - truth[1]) < max(0.1, 3.0 * line.sigma_m(10.0))


@pytest.mark.parametrize("vertical_per_m", [-1.6e-3, 0.0, 1.6e-3])
def test_lines_over_a_crest_and_through_a_sag(vertical_per_m: float) -> None:
    # The ground is what the road's image fits some 11 m ahead, as odometry gives it
    ground = GroundPlane(CAMERA.height_m, 0.5 * vertical_per_m * PLANE_AT_M)
    tracker, off, sigmas, bends = LineTracker(CAMERA), [], [], []
    for k in range(20):
        pose = SE2(2.0 * k, 0.0, 0.0)
        image, masks = picture(pose, (5.2, 1.75, -1.75), (False, True, False), vertical_per_m=vertical_per_m)
        tracker.update(pose, ground, (0.003, 0.0), image, masks, NOBODY)
        for found in tracker.lines().at(pose) if k >= 6 else ():
            if found.kind is not LineKind.EDGE:
                off.append(found.y_m(28.0) - min((5.2, 1.75, -1.75), key=lambda y: abs(found.y_m(8.0) - y)))
                sigmas.append(found.sigma_m(28.0))
        bends.append(tracker.lines().tilt.vertical_per_m)
    assert np.median(np.abs(off)) < 0.15
    assert np.mean(np.abs(off) < 2.0 * np.array(sigmas)) > 0.9
    assert bends[-1] == pytest.approx(vertical_per_m, abs=4e-4)
    by_images = tracker.lines().vertical
    assert by_images.per_m == pytest.approx(bends[-1], abs=2e-4), "without the prior it is a little more"
    assert 0.0 < by_images.sigma_per_m < 4e-4


@pytest.mark.parametrize("told", [1.0, 0.75])  # of the focal length
def test_lines_of_a_bend_through_a_sag_do_not_meet(told: float) -> None:
    # Far on a bend a pixel's row moves paint by more than its column: such paint bent the road upwards or downwards
    bend, sag, rng = 0.012, 1.3e-3, np.random.default_rng(0)
    camera = msgspec.structs.replace(CAMERA, fx_px=told * CAMERA.fx_px, fy_px=told * CAMERA.fy_px)
    tracker, T_world_told, last, x_m = LineTracker(camera), SE2(), SE2(), 0.0
    off, inside = [], []
    while x_m < 48.0:
        pose = SE2(x_m, 0.5 * bend * x_m**2, math.atan(bend * x_m))
        step, last = last.between(pose), pose
        # What an odometry with that focal length sees of it
        T_world_told @= SE2(told * step.x_m, step.y_m, step.yaw_rad / told)
        ground = GroundPlane(CAMERA.height_m, 0.5 * sag * PLANE_AT_M / told + rng.normal(0.0, 0.002))
        image, masks = picture(pose, (1.75, -1.75), (True, False), bend, vertical_per_m=sag)
        tracker.update(T_world_told, ground, (0.003, 0.01), image, masks, NOBODY)
        for found in tracker.lines().at(T_world_told) if x_m > 12.0 else ():
            if found.kind is not LineKind.EDGE:
                world_x = np.linspace(x_m, x_m + 60.0, 400)
                y_m = [
                    np.interp(28.0, *(pose.inverse() @ np.column_stack([world_x, y + 0.5 * bend * world_x**2])).T)
                    for y in (1.75, -1.75)
                ]
                off.append(min(abs(found.y_m(28.0 * told) - y) for y in y_m))
                inside.append(off[-1] < 2.0 * found.sigma_m(28.0 * told))
        x_m += float(rng.choice([1.0, 2.0, 3.0, 4.0]))
    assert np.median(off) < 0.25
    assert np.mean(inside) > 0.95


def test_lines_out_of_a_tight_bend_become_straight() -> None:
    """A clothoid of 10 m leads from 25 m radius to a straight road; lines are sought near the predicted ones."""
    s_m = np.arange(0.0, 120.0, 0.25)
    bend = np.interp(s_m, [30.0, 40.0], [1 / 25, 0.0])
    yaw = np.cumsum(bend) * 0.25
    middle = np.column_stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))]) * 0.25
    aside = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    poses = [SE2(*middle[k], yaw[k]) for k in range(80, 260, 4)]
    offsets_m, rng = np.array([1.75, -1.75]), np.random.default_rng(2)
    lines = LineFilter()
    lines.restart(offsets_m, np.zeros(2), 1 / 25, np.zeros(2, bool))
    late = []
    for k, pose in enumerate(poses):
        if k:
            lines.predict(poses[k - 1].between(pose))
        true = [pose.inverse() @ (middle + off * aside) for off in offsets_m]
        seen = np.vstack(
            [line[(line[:, 0] > 5.0) & (line[:, 0] < 30.0) & (np.abs(line[:, 1]) < 10.0)] for line in true]
        )
        count = len(seen)
        points = LinePoints(
            seen[:, 0], seen[:, 1] + rng.normal(0.0, 0.03, count), np.full(count, 0.05), np.full(count, 0.25),
            np.ones(count, bool), np.full(count, np.nan), np.full(count, 1e-3),
        )  # fmt: skip
        lines.update(points, np.zeros(count, np.int64), np.zeros(2, np.int64), 1.5, 0.002, 1.0)
        if k > 35:  # on the straight
            late.append(np.abs(lines.curves @ basis(np.array([25.0]))[0] - offsets_m))
    assert np.max(late) < 0.3


def test_biased_direction_of_travel_does_not_drag_lines() -> None:
    tracker, off, sigmas = LineTracker(CAMERA), [], []
    for k in range(24):
        true, told = SE2(2.5 * k, 0.0, 0.0), SE2(2.5 * k, 0.02 * 2.5 * k, 0.0)
        image, masks = picture(true, (1.75, -1.75), (True, False))
        # Nothing nearer than 8 m is in view
        edge_px = np.array([[0.0, 168.0], [639.0, 168.0]])
        tracker.update(told, CAMERA.ground, (0.003, 0.0), image, masks.above(edge_px), NOBODY, bonnet_px=edge_px)
        for found in tracker.lines().at(told) if k >= 10 else ():
            if found.kind is not LineKind.EDGE:
                off.append(found.y_m(4.0) - math.copysign(1.75, found.offset_m))
                sigmas.append(found.sigma_m(4.0))
    assert abs(np.mean(off)) < 0.04
    assert np.mean(np.abs(off) < 2.0 * np.array(sigmas)) > 0.9


def test_line_is_drawn_up_to_a_crest() -> None:
    crest, straight = -1.6e-3, line(0, 1.75)
    px = line_px(CAMERA, CAMERA.ground, straight, 5.0, crest)
    touches_m = math.sqrt(2.0 * CAMERA.height_m / -crest)
    assert straight.to_m > touches_m
    x_m = np.arange(5.0, touches_m, 0.5)
    truth = bev.ego_to_pixel(
        CAMERA, CAMERA.ground, np.column_stack([x_m, np.full(len(x_m), 1.75), 0.5 * crest * x_m**2])
    )
    np.testing.assert_allclose(px, truth)
    assert np.all(np.diff(px[:, 1]) < 0.0)


@pytest.mark.parametrize(("aside_m", "turned_rad"), [(0.0, 0.2), (1.5, -0.2), (1.6, 0.0)])
def test_lines_off_their_paint_are_detected_again(aside_m: float, turned_rad: float) -> None:
    tracker, pose = LineTracker(CAMERA), SE2()
    off = []
    for k in range(18):
        if k:
            pose = pose @ SE2(1.5, 0.0, 0.0)
        if k == 10:
            pose = pose @ SE2(0.0, aside_m, turned_rad)  # the odometry slips, or the road bends at once
        image, masks = picture(SE2(1.5 * k, 0.0, 0.0), (1.75, -1.75), (True, False))
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, NOBODY)
        lines = tracker.lines().at(pose)
        off.append([min((abs(line.y_m(8.0) - y) for line in lines), default=9.0) for y in (1.75, -1.75)])
    assert max(map(max, off[4:10])) < 0.15
    assert max(map(max, off[13:])) < 0.15


def test_road_edges_are_kept_when_paint_appears() -> None:
    tracker, edges = LineTracker(CAMERA), []
    for k in range(16):
        pose = SE2(2.0 * k, 0.0, 0.0)
        image, masks = picture(pose, (0.3,) if k >= 8 else (), (False,) if k >= 8 else ())
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, NOBODY)
        lines = tracker.lines().at(pose)
        edges.append({line.line for line in lines if line.kind is LineKind.EDGE})
    assert len(edges[7]) == 2
    assert edges[7] <= edges[-1]
    assert any(abs(line.offset_m - 0.3) < 0.1 for line in lines)


def test_line_off_its_paint_yields_to_the_one_on_it() -> None:
    tracker = LineTracker(CAMERA)

    def left_lines(k: int, left_m: float) -> list[LaneLine]:
        pose = SE2(2.0 * k, 0.0, 0.0)
        image, masks = picture(pose, (left_m, -1.75, -5.2), (False, False, False))
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, NOBODY)
        return [x for x in tracker.lines().at(pose) if 0.0 < x.offset_m < 4.0 and x.kind is not LineKind.EDGE]

    for k in range(10):
        (old,) = left_lines(k, 1.75)
    after = [left_lines(10 + k, 2.7) for k in range(5)]  # as after a jump of the ego's motion
    assert [x.line for x in after[-1]] != [old.line]
    assert len(after[-1]) == 1
    assert after[-1][0].offset_m == pytest.approx(2.7, abs=0.15)


def test_reflections_on_the_bonnet_are_not_lines() -> None:
    edge_px = np.array([[0.0, 190.0], [320.0, 165.0], [639.0, 190.0]])
    image, masks = picture(SE2(), (1.75, -1.75), (False, False))
    image[170:, 316:324], masks.lane[170:, 316:324] = 220, True
    found = {}
    for bonnet_px in (None, edge_px):
        tracker = LineTracker(CAMERA, certain_m=2.0)
        seen = masks if bonnet_px is None else masks.above(bonnet_px)
        tracker.update(SE2(), CAMERA.ground, (0.003, 0.0), image, seen, NOBODY, bonnet_px=bonnet_px)
        lines = tracker.lines()
        found[bonnet_px is None] = [y for y in (line.y_m(5.0) for line in lines.at(SE2())) if abs(y) < 1.0]
        lanes = EgoLane().lanes(lines.at(SE2()), 0, road_from_m=lines.road_from_m)
    assert found[True]
    assert not found[False]
    assert lanes.ego is not None
    assert lanes.road_from_m == pytest.approx(CAMERA.height_m * CAMERA.fy_px / (165.0 - CAMERA.cy_px), rel=0.02)
    area = lane_px(CAMERA, CAMERA.ground, lanes.ego, lanes.road_from_m)
    assert area[:, 1].max() <= 166.0


def with_two_stripes(gap_m: float, road_to_m: float) -> list[LaneLine]:
    """The painted lines of a drive with two stripes about 1.75 m to the left, on a road that ends at `road_to_m`."""
    tracker = LineTracker(CAMERA)
    v, u = np.indices((CAMERA.height_px, CAMERA.width_px))
    x_m = CAMERA.fy_px * CAMERA.height_m / np.maximum(v - CAMERA.cy_px, 1e-3)
    off_road = (CAMERA.cx_px - u) * x_m / CAMERA.fx_px > road_to_m
    for k in range(8):
        pose = SE2(1.5 * k, 0.0, 0.0)
        apart = 0.5 * (0.1 + gap_m)
        image, masks = picture(pose, (1.75 + apart, 1.75 - apart, -1.75), (False, False, True), stripe_m=0.1)
        masks.road[off_road] = False
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, NOBODY)
    return [line for line in tracker.lines().at(pose) if line.kind is not LineKind.EDGE]


@pytest.mark.parametrize("gap_m", [0.1, 0.15])
def test_two_parallel_stripes_are_one_double_line(gap_m: float) -> None:
    found = with_two_stripes(gap_m, 8.0)
    assert [line.kind for line in found] == [LineKind.DOUBLE, LineKind.DASHED]
    assert found[0].y_m(8.0) == pytest.approx(1.75, abs=0.1)


def test_line_beside_a_kerb_is_not_double() -> None:
    assert LineKind.DOUBLE not in [line.kind for line in with_two_stripes(0.1, 2.0)]


def points_of(image: np.ndarray, masks: Segmentation) -> LinePoints:
    return paint_points(road_view(CAMERA, GroundPlane(CAMERA.height_m), image, masks, NOBODY, None))


def test_dash_between_cracks_is_not_a_symbol() -> None:
    """Between two cracks asphalt is a bright band, which would make the dash an arrow."""
    offset_m, seen = 1.7, []
    for cracks_m in ((), (-0.35, 0.35)):
        image, masks = picture(SE2(), (offset_m, -1.8), (True, False))
        for aside_m in cracks_m:
            ends_m = np.array([(9.3, offset_m + aside_m), (11.7, offset_m + aside_m)])
            ends_px = bev.ego_to_pixel(CAMERA, GroundPlane(CAMERA.height_m), ends_m)
            cv2.line(image, *np.round(ends_px).astype(int).tolist(), 20, 2)
        points = points_of(image, masks)
        on_dash = (np.abs(points.y_m - offset_m) < 0.15) & (points.x_m > 9.0) & (points.x_m < 12.0)
        seen.append(int(on_dash.sum()))
    clear, cracked = seen
    assert cracked > 0.8 * clear > 5


def test_far_ridge_without_segmentation_is_not_a_line() -> None:
    """Near ones count; how far is a matter of pixels, not of metres."""
    image, masks = picture(SE2(), (1.7, -1.8), (False, False))
    masked, unseen = points_of(image, masks), points_of(image, Segmentation(masks.road, np.zeros_like(masks.lane)))
    pixel_m = 1.0 / CAMERA.fx_px
    assert 0.9 * MAX_UNMASKED_PIXEL_M < unseen.x_m.max() * pixel_m <= MAX_UNMASKED_PIXEL_M
    assert masked.x_m.max() * pixel_m > 1.2 * MAX_UNMASKED_PIXEL_M
    assert np.count_nonzero(masked.x_m * pixel_m <= MAX_UNMASKED_PIXEL_M) == len(unseen)


def textured(image: np.ndarray, sigma: float, seed: int = 3) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.clip(image + noise, 0.0, 255.0).astype(np.uint8)


@pytest.mark.parametrize("contrast", [1.0, 0.25])
def test_lines_on_coarse_asphalt_without_segmentation_are_found(contrast: float) -> None:
    """Single ridges are as weak as the texture's, but there are many on one line."""
    image, masks = picture(SE2(), (1.7, -1.8), (True, True))
    asphalt = image.astype(np.float64)
    asphalt[masks.road] = 90.0 + contrast * (asphalt[masks.road] - 90.0)
    unseen = Segmentation(masks.road, np.zeros_like(masks.lane))
    lines, _ = find_lines_in_image(CAMERA, textured(asphalt, 8.0), unseen, NOBODY)
    row = lane_row(lines)
    assert row.ego is not None
    assert row.lanes[row.ego].left_m(10.0) == pytest.approx(1.7, abs=0.15)
    assert row.lanes[row.ego].right_m(10.0) == pytest.approx(-1.8, abs=0.15)


def test_coarse_asphalt_has_no_lines() -> None:
    image, masks = picture(SE2(), (), ())
    for seed in range(8):
        lines, _ = find_lines_in_image(CAMERA, textured(image, 8.0, seed), masks, NOBODY)
        assert not [line for line in lines if line.kind is not LineKind.EDGE]


def test_yellow_line_as_bright_as_the_road_is_found() -> None:
    """Yellow paint on concrete has no contrast in a grey image."""
    image, masks = picture(SE2(), (1.7, -1.8), (False, False))
    colour = np.repeat(image[:, :, None], 3, axis=2)
    left = cv2.dilate(masks.lane.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    left &= np.arange(image.shape[1]) < CAMERA.cx_px
    yellow = np.array([20, 94, 110])  # BGR
    colour[left] = yellow
    assert cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)[left] == pytest.approx(90.0, abs=1.0)
    lines, _ = find_lines_in_image(CAMERA, colour, Segmentation(masks.road, masks.lane & ~left), NOBODY)
    (found,) = (line for line in lines if line.offset_m > 0.0 and line.kind is not LineKind.EDGE)
    assert found.y_m(10.0) == pytest.approx(1.7, abs=0.1)
    assert found.colour is LineColour.YELLOW


def test_grass_classified_as_road_has_no_line() -> None:
    image, masks = picture(SE2(), (1.7, -1.8, -9.4), (True, False, False))
    clear = points_of(image, masks)
    cv2.circle(masks.road.view(np.uint8), (600, 135), 4, 1, -1)  # a scrap beside that line, beyond the road's edge
    assert clear.y_m.min() > -8.5
    assert points_of(image, masks).y_m.min() > -8.5


def test_line_hidden_by_a_car_is_kept() -> None:
    poses = [SE2(1.5 * k, 0.0, 0.0) for k in range(16)]
    seen = drive(LineTracker(CAMERA), poses, hidden_from=8)
    (before,) = (line for line in seen[7] if 1.0 < line.offset_m < 2.5)
    (after,) = (line for line in seen[-1] if 1.0 < line.offset_m < 2.5)
    assert after.line == before.line
    assert after.y_m(10.0) == pytest.approx(1.75, abs=0.2)
    assert after.sigma_m(10.0) > before.sigma_m(10.0)


def test_hidden_lines_do_not_switch_to_their_neighbour() -> None:
    tracker = LineTracker(CAMERA)
    for k in range(14):
        pose, near = SE2(1.5 * k, 0.0, 0.0), k >= 8  # a car close ahead, beside which another line comes into view
        image, masks = picture(pose, (1.75, -1.75, 5.8)[: 3 if near else 2], (True, False, False)[: 3 if near else 2])
        boxes = NOBODY
        if near:
            masks.road[:, 200:], masks.lane[:, 200:] = False, False
            image[:, 200:] = 60
            boxes = np.array([[200.0, 0.0, CAMERA.width_px, CAMERA.height_px]])
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, boxes)
    offsets_m = [line.y_m(10.0) for line in tracker.lines().at(pose) if line.kind is not LineKind.EDGE]
    for y_m in (1.75, -1.75):
        assert min(abs(at - y_m) for at in offsets_m) < 0.3
    assert any(abs(at - 5.8) < 0.4 for at in offsets_m)


def test_bare_road_has_no_lines() -> None:
    image = np.full((CAMERA.height_px, CAMERA.width_px), 90, np.uint8)
    for road in (True, False):
        masks = Segmentation(road=np.full(image.shape, road), lane=np.zeros(image.shape, bool))
        lines, _ = find_lines_in_image(CAMERA, image, masks, NOBODY)
        assert not [line for line in lines if line.kind is not LineKind.EDGE]


def test_noise_and_jumps_do_not_raise() -> None:
    rng = np.random.default_rng(7)
    tracker, pose = LineTracker(CAMERA), SE2()
    for k in range(22):
        image, masks = picture(SE2(2.0 * k, 0.0, 0.0), (1.75, -1.75), (True, False))
        if k % 3:
            image = np.asarray(rng.integers(0, 256, image.shape), np.uint8)
            masks = Segmentation(road=rng.random(image.shape) < rng.random(), lane=rng.random(image.shape) < 0.1)
        size = 30.0 if k % 7 == 0 else 2.0
        pose = pose @ SE2(
            float(rng.normal(1.0, size)), float(rng.normal(0.0, size)), float(rng.normal(0.0, 0.3 * size))
        )
        tracker.update(pose, CAMERA.ground, (0.003, 0.0), image, masks, NOBODY)
        lines = tracker.lines().at(pose @ SE2(0.5, 0.0, 0.02))
        lanes = EgoLane().lanes(lines, 0, tracker.tilt)
        assert msgspec.json.decode(msgspec.json.encode(lanes), type=Lanes) == lanes
        assert all(lane.width_m > 0.0 for lane in lanes.lanes)


def line(number: int, y_m: float, kind: LineKind = LineKind.SOLID, existence: float = 0.95) -> LaneLine:
    cov = tuple(np.diag([0.01, 1e-4, 1e-7, 1e-11]).ravel().tolist())
    return LaneLine(
        line=number, offset_m=y_m, slope=0.0, curvature_per_m=0.0, curvature_rate_per_m2=0.0, cov=cov,
        seen_from_m=0.0, seen_to_m=40.0, to_m=50.0, kind=kind, existence=existence,
    )  # fmt: skip


TWO_LANES = EgoLane().lanes((line(0, 5.2), line(1, 1.7), line(2, -1.8)), 0)  # the ego's is the right one


def test_arrow_is_not_a_bound() -> None:
    row = lane_row((line(0, 5.2), line(1, 1.6), line(2, 0.0, existence=0.8), line(3, -1.8)))
    assert [(lane.left, lane.right) for lane in row.lanes] == [(0, 1), (1, 3)]
    assert row.ego == 1


@pytest.mark.parametrize(("kerb_m", "bound"), [(-1.95, Bound.EDGE), (-1.55, Bound.PAINT)])
def test_bright_kerb_beyond_the_road_edge_is_not_a_bound(kerb_m: float, bound: Bound) -> None:
    row = lane_row((line(1, 1.7), line(2, -1.75, LineKind.EDGE), line(3, kerb_m)))
    assert row.ego == 0
    assert row.lanes[0].right_bound is bound
    assert row.lanes[0].right_m(0.0) == pytest.approx(-1.75 if bound is Bound.EDGE else kerb_m)


@pytest.mark.parametrize(("left", "right"), list(product((LineKind.SOLID, LineKind.EDGE), repeat=2)))
def test_strip_nearer_to_one_lane_than_to_two_is_a_lane(left: LineKind, right: LineKind) -> None:
    (wide,) = lane_row((line(1, 2.4, left), line(2, -2.4, right))).lanes
    assert (wide.left, wide.right) == (1, 2)
    own = lane_row((line(1, 1.7, left), line(2, -5.0, right)))
    assert own.ego is not None
    assert (own.lanes[own.ego].right_bound is Bound.WIDTH) == (LineKind.SOLID in (left, right))


def test_lane_with_one_line_is_completed_by_width() -> None:
    row = lane_row((line(1, 1.6),), mean_width_m=3.2, mean_width_sigma_m=0.2)
    assert row.ego == 0
    (own,) = row.lanes
    assert (own.left, own.right, own.right_bound) == (1, None, Bound.WIDTH)
    assert own.right_m(10.0) == pytest.approx(-1.6)
    assert own.width_sigma_m == 0.2


def test_road_edges_without_paint_bound_one_carriageway() -> None:
    row = lane_row((line(1, 3.0, LineKind.EDGE), line(2, -3.5, LineKind.EDGE)))
    assert row.ego == 0
    assert row.lanes[0].carriageway
    assert row.lanes[0].left_bound is row.lanes[0].right_bound is Bound.EDGE


def test_a_lane_change_is_one_event() -> None:
    keeper = EgoLane()
    changes = []
    for k in range(40):
        y_m = -0.1 * k  # the ego moves left by 0.1 m a frame
        lanes = keeper.lanes((line(0, 5.2 + y_m), line(1, 1.7 + y_m), line(2, -1.8 + y_m)), 0)
        changes.append(lanes.change)
        assert lanes.ego is not None
    assert changes.count(LaneChange.LEFT) == 1
    assert changes.count(LaneChange.RIGHT) == 0
    assert changes.index(LaneChange.LEFT) in range(19, 22)  # 0.3 m past the line


@given(st.floats(3.0, 60.0), st.floats(-12.0, 12.0), st.floats(0.0, 4.0), st.floats(-3.1, 3.1))
def test_lane_probabilities_sum_to_one(x_m: float, y_m: float, sigma_m: float, yaw_rad: float) -> None:
    vehicle = UserInEgo(7, SE2(x_m, y_m, yaw_rad), np.eye(3) * sigma_m**2, 4.0, 8.0)
    (place,) = with_users(TWO_LANES, [vehicle], 10.0, Traffic()).vehicles
    assert place.ego_lane + place.left + place.right + place.oncoming + place.off_road == pytest.approx(1.0)


@given(st.lists(st.floats(-400.0, 400.0), max_size=3))
def test_distant_users_are_in_no_lane(xs_m: list[float]) -> None:
    users = [UserInEgo(k, SE2(x_m, 0.1, 0.0), np.eye(3) * 0.1, 4.0, 8.0) for k, x_m in enumerate(xs_m)]
    placed = with_users(TWO_LANES, users, 10.0, Traffic()).vehicles
    assert [one.vehicle for one in placed] == [k for k, x_m in enumerate(xs_m) if abs(x_m) < MAX_DISTANCE_M]


def test_the_leader_is_the_nearest_in_the_egos_lane() -> None:
    cov = np.diag([0.25, 0.01, 0.001])
    cars = [
        UserInEgo(k, SE2(x, y, 0.0), cov, 4.0, 8.0) for k, x, y in ((1, 30.0, 0.1), (2, 12.0, 3.4), (3, 20.0, -0.3))
    ]
    found = with_users(TWO_LANES, cars, 9.0, Traffic())
    assert found.leader.vehicle == 3
    assert found.leader.gap_m == pytest.approx(18.0)
    assert found.leader.time_gap_s == pytest.approx(2.0)
    assert found.leader.gap_sigma_m == pytest.approx(0.5)
    standing = with_users(TWO_LANES, cars, 0.0, Traffic()).leader
    assert standing.time_gap_s is None


def crowd(count: int) -> list[UserInEgo]:
    rng = np.random.default_rng(count)
    cov = np.diag([0.5, 0.1, 3.0])
    return [UserInEgo(k, SE2(rng.uniform(2, 60), rng.uniform(-9, 9), 0.0), cov, 4.0, 1.5) for k in range(count)]


def test_lane_assignment_uses_bounds_and_sigmas() -> None:
    users = crowd(30)
    for user, place in zip(users, with_users(TWO_LANES, users, 10.0, Traffic()).vehicles, strict=True):
        own, x, y = TWO_LANES.ego, user.T_ego_vehicle.x_m, user.T_ego_vehicle.y_m
        bend = 0.001 * max(0.0, x - own.to_m) ** 2
        sigma = math.sqrt(0.1 + own.sigma_m(min(x, own.to_m)) ** 2 + bend**2 + 1e-6)
        inside = math.erf((own.left_m(x) - y) / sigma / math.sqrt(2)) - math.erf(
            (own.right_m(x) - y) / sigma / math.sqrt(2)
        )
        assert place.ego_lane == pytest.approx(0.5 * inside, abs=1e-9)


def test_cost_per_road_user_is_low() -> None:
    """All are placed at once; one by one, lane by lane and line by line it was half of the optimizer's step."""
    lanes = EgoLane().lanes(tuple(line(k, 8.7 - 3.5 * k) for k in range(6)), 0)

    def calls_for(count: int) -> int:
        users = crowd(count)
        return calls(lambda: with_users(lanes, users, 10.0, Traffic()), "call")

    assert (calls_for(40) - calls_for(20)) / 20 < 60  # 600 before


def test_curves_move_in_batch_as_singly() -> None:
    rng = np.random.default_rng(0)
    old, step = rng.normal(size=(5, 4)) * [3.0, 0.1, 5e-3, 5e-5], SE2(1.2, -0.1, 0.05)
    new, J = transform_curves(old, step)
    for k in range(5):
        alone, of_it = transform_curves(old[k], step)
        assert np.array_equal(new[k], alone)
        assert np.array_equal(J[k], of_it)


def test_cyclists_can_be_leaders_and_pedestrians_cannot() -> None:
    walker = FollowedPerson(person=5, x_m=9.0, y_m=-0.5, cov=(0.2, 0.0, 0.0, 0.05), vx_mps=-1.4, vy_mps=0.0,
                            velocity_cov=(0.1, 0.0, 0.0, 0.1))  # fmt: skip
    cyclist = msgspec.structs.replace(walker, person=6, x_m=25.0, vx_mps=4.0, label="cyclist")
    found = with_users(TWO_LANES, [person_in_ego(walker), person_in_ego(cyclist)], 8.0, Traffic())
    assert [(place.vehicle, place.ego_lane > 0.9) for place in found.vehicles] == [(5, True), (6, True)]
    assert found.vehicles[0].oncoming == 0.0  # pedestrians have no direction of traffic
    assert found.leader.vehicle == 6


def test_lane_along_the_line_of_sight_needs_no_distance() -> None:
    leads_aside = msgspec.structs.replace(line(0, 1.75), slope=0.2), msgspec.structs.replace(line(1, -1.75), slope=0.2)
    lanes = EgoLane().lanes(leads_aside, 0)
    far = np.array([6.0, 1.2, 0.0])  # the distance is off by 6 m, and with it the place aside
    on_sight = UserInEgo(1, SE2(30.0, 6.0, 0.0), np.outer(far, far), 4.0, 8.0)
    ahead = UserInEgo(2, SE2(30.0, 6.0, 0.0), np.diag([36.0, 0.01, 0.01]), 4.0, 8.0)
    surely, perhaps = with_users(lanes, [on_sight, ahead], 10.0, Traffic()).vehicles
    of_lane_m = lanes.ego.sigma_m(30.0)
    assert surely.ego_lane == pytest.approx(math.erf(1.75 / of_lane_m / math.sqrt(2)), abs=1e-3)
    assert perhaps.ego_lane == pytest.approx(math.erf(1.75 / math.hypot(1.2, 0.1, of_lane_m) / math.sqrt(2)), abs=1e-3)


def test_vehicles_in_a_used_lane_are_assumed_moving() -> None:
    cov = np.diag([1.0, 0.04, 0.01])
    new = UserInEgo(9, SE2(40.0, 12.0, math.pi), cov, 4.0, 0.0, 8.0, standing=0.7)

    def place_after(others: list[UserInEgo]) -> VehicleLane:
        traffic = Traffic()
        for _ in range(3):  # each counts once
            with_users(TWO_LANES, others, 10.0, traffic)
        again = Traffic(msgspec.msgpack.decode(msgspec.msgpack.encode(traffic.state()), type=TrafficState))
        (place,) = with_users(TWO_LANES, [new], 10.0, again).vehicles
        return place

    unknown = place_after([])
    assert unknown.off_road > unknown.oncoming
    drove = place_after([UserInEgo(k, SE2(30.0, 12.0, math.pi), cov, 4.0, 20.0) for k in (1, 2)])
    assert drove.oncoming > 0.7 > 2.0 * unknown.oncoming
    stood = place_after([UserInEgo(k, SE2(30.0, 12.0, math.pi), cov, 4.0, 0.0, 0.1, standing=0.95) for k in (1, 2)])
    assert stood.oncoming < 0.5 * unknown.oncoming


def test_no_parking_at_high_ego_speed() -> None:

    def oncoming(ego_mps: float, standing: float) -> float:
        new = UserInEgo(9, SE2(40.0, 16.0, math.pi), np.diag([1.0, 0.04, 0.01]), 4.0, 0.0, 8.0, standing=standing)
        (place,) = with_users(TWO_LANES, [new], ego_mps, Traffic()).vehicles
        return place.oncoming

    assert oncoming(30.0, 0.7) > 0.7 > 0.4 > oncoming(10.0, 0.7)
    assert oncoming(30.0, 0.99) < 0.3  # on the hard shoulder


def test_traffic_side_is_corrected_by_oncoming_vehicles() -> None:
    lanes = EgoLane().lanes((line(0, 5.2), line(1, 1.7), line(2, -1.8), line(3, -5.3)), 0)
    cov = np.diag([1.0, 0.04, 0.01])

    def oncoming(drives_on: str, come_at_m: float | None = None) -> tuple[float, float]:
        """Of somebody new at the left and at the right, whose way is not known."""
        traffic = Traffic(initial_state(drives_on))
        for k in range(3 if come_at_m is not None else 0):
            with_users(lanes, [UserInEgo(k, SE2(30.0, come_at_m or 0.0, math.pi), cov, 4.0, 12.0)], 10.0, traffic)
        elsewhere = EgoLane().lanes(tuple(line(10 + k, y) for k, y in enumerate((5.2, 1.7, -1.8, -5.3))), 0)
        users = [UserInEgo(8 + k, SE2(40.0, y, math.pi), cov, 4.0, 0.0, 8.0) for k, y in enumerate((3.4, -3.5))]
        left, right = with_users(elsewhere, users, 10.0, traffic).vehicles
        return left.oncoming, right.oncoming

    left, right = oncoming("right")
    assert left > 0.5 > 3.0 * right
    assert oncoming("left") == pytest.approx((right, left), abs=0.02)
    mended_left, mended_right = oncoming("right", come_at_m=-3.5)
    assert mended_right > 0.5 > 3.0 * mended_left


def test_parked_cars_beside_a_used_lane_are_recognized() -> None:
    lanes = EgoLane().lanes((line(1, 1.7), line(2, -1.8)), 0)
    cov, traffic = np.diag([1.0, 0.04, 0.01]), Traffic()
    for k in range(4):
        drove = UserInEgo(k, SE2(30.0, 3.4, math.pi), cov, 4.0, 12.0)
        stood = UserInEgo(20 + k, SE2(20.0, 7.5, math.pi), cov, 4.0, 0.0, 0.1, standing=0.97)
        with_users(lanes, [drove, stood], 10.0, traffic)
    new = [UserInEgo(40 + k, SE2(40.0, y, math.pi), cov, 4.0, 0.0, 8.0, standing=0.5) for k, y in enumerate((3.4, 7.5))]
    driving, parked = with_users(lanes, new, 10.0, traffic).vehicles
    assert driving.oncoming > 0.8
    assert parked.off_road > 0.6


def test_uncertain_speed_does_not_override_the_traffic_side() -> None:
    """A front taken for a back makes who comes drive along, at first."""
    lanes = EgoLane().lanes((line(1, 1.7), line(2, -1.8)), 0)

    def oncoming(sigma_mps: float) -> float:
        user = UserInEgo(1, SE2(40.0, 9.0, 0.0), np.diag([1.0, 0.04, 0.01]), 4.0, 12.0, sigma_mps)
        return with_users(lanes, [user], 10.0, Traffic()).vehicles[0].oncoming

    assert oncoming(5.5) > 0.35
    assert oncoming(1.0) < 0.01


def true_line(number: int, kind: str, y_m: float) -> TrueLine:
    x = np.arange(0.0, 80.0, 2.0)
    return TrueLine(number, kind, np.column_stack([x, np.full(len(x), y_m)]))


def body(number: int, x_m: float, y_m: float, yaw_rad: float = 0.0, label: str = "car", mps: float = 14.0) -> TrueBody:
    velocity_mps = mps * math.cos(yaw_rad), mps * math.sin(yaw_rad)
    return TrueBody(
        number, label, SE2(x_m, y_m, yaw_rad), 4.0, 1.8, 1.5, velocity_mps, 1.0, 0.0, (0.0, 0.0, 9.0, 9.0)
    )  # fmt: skip


def test_vehicle_extent_follows_its_heading() -> None:
    """A tenth too near, the leader stood for the car of the lane beside, which is nearer to it in metres."""
    truth = tuple(true_line(k, "dashed", y) for k, y in enumerate((5.4, 1.8, -1.8, -5.4)))
    bodies = body(1, 60.0, 0.0), body(2, 56.0, -3.6), body(3, 54.0, 2.0, label="pedestrian", mps=1.0)
    lanes = EgoLane().lanes((line(0, 1.8), line(1, -1.8)), 0)
    lanes = with_users(
        lanes, [UserInEgo(7, SE2(54.5, -0.2, 0.0), np.diag([16.0, 0.02, 0.01]), 4.0, 14.0)], 14.0, Traffic()
    )
    vehicle = new_vehicle(7, SE2(54.5, -0.2, 0.0), velocity_mps=(14.0, 0.0))
    estimate = new_estimate(vehicles=(vehicle,), lanes=lanes)
    scores = VehicleScores()
    scores.add(estimate, bodies, truth)
    report = scores.report()
    assert (report.vehicles, report.right) == (1, 1.0)


def test_the_lane_between_the_last_dashes_and_the_kerb_is_on_the_road() -> None:
    lines = ("kerb", -5.0), ("solid", -1.8), ("dashed", 1.8), ("dashed", 5.2), ("kerb", 8.6)
    truth = tuple(true_line(k, kind, y) for k, (kind, y) in enumerate(lines))
    assert true_place(body(1, 30.0, 6.9, math.pi), truth) == "oncoming"
    assert true_place(body(2, 30.0, 9.5, math.pi), truth) == "off_road"
    assert true_place(body(3, 30.0, -3.4), truth) == "off_road"  # beyond a solid line
    assert true_place(body(4, 30.0, 3.4, math.pi), truth[:3] + truth[4:]) == "oncoming"


def test_cars_along_the_kerb_beyond_a_lane_are_off_road() -> None:
    lines = ("kerb", -6.4), ("dashed", -1.3), ("double", 1.7), ("dashed", 4.7), ("kerb", 9.8)
    truth = tuple(true_line(k, kind, y) for k, (kind, y) in enumerate(lines))
    assert true_place(body(1, 30.0, -2.8), truth) == "right"
    assert true_place(body(2, 30.0, -5.4), truth) == "off_road"
    assert true_place(body(3, 30.0, 6.2, math.pi), truth) == "oncoming"
    assert true_place(body(4, 30.0, 8.8), truth) == "off_road"


def test_traffic_determines_the_direction_of_a_lane() -> None:
    cov = np.diag([1.0, 0.04, 0.01])
    unknown = UserInEgo(9, SE2(40.0, 3.4, 0.0), np.diag([1.0, 0.04, 3.0]), 4.0, 2.0)
    traffic = Traffic()
    before = with_users(TWO_LANES, [unknown], 10.0, traffic)
    assert before.lanes[0].oncoming is None
    assert before.lanes[1].oncoming == 0.0
    right = 1.0 / (1.0 + math.exp(-STATED_SIDE_EVIDENCE))
    by_labels = right * 19 / 30 + (1.0 - right) / 14  # as KITTI has them
    assert before.vehicles[0].left == pytest.approx(1.0 - by_labels, abs=0.01)
    for _ in range(3):  # one car counts once
        told = with_users(TWO_LANES, [UserInEgo(1, SE2(30.0, 3.4, math.pi), cov, 4.0, 9.0), unknown], 10.0, traffic)
    assert told.lanes[0].oncoming == pytest.approx(1.0 / (1.0 + math.exp(-2.0)))
    assert told.vehicles[1].oncoming > 0.8 > told.vehicles[1].left
    again = Traffic(msgspec.msgpack.decode(msgspec.msgpack.encode(traffic.state()), type=TrafficState))
    for k in range(4):  # cars that drive the ego's way there
        users = [UserInEgo(20 + k, SE2(30.0, 3.4, 0.0), cov, 4.0, 9.0)]
        assert with_users(TWO_LANES, users, 10.0, again) == with_users(TWO_LANES, users, 10.0, traffic)
    (after, _) = with_users(TWO_LANES, users, 10.0, traffic).lanes
    assert after.oncoming < 0.01
    far = UserInEgo(2, SE2(30.0, 3.4, 0.0), np.diag([1.0, 4.0, 0.01]), 4.0, 9.0)
    unsure = Traffic()
    with_users(TWO_LANES, [far], 10.0, unsure)  # it may be in the ego's lane
    assert unsure.state() == TrafficState()


def test_merging_lane_reports_its_end() -> None:
    sharp = tuple(np.diag([1e-4, 1e-6, 1e-9, 1e-12]).ravel().tolist())
    right = msgspec.structs.replace(line(2, -1.75), cov=sharp)

    def merging(slope: float) -> LaneLine:
        return msgspec.structs.replace(line(1, 1.75), slope=slope, cov=sharp)

    (narrow,) = lane_row((merging(-0.06), right)).lanes
    (wide,) = lane_row((merging(0.06), right)).lanes
    (straight,) = lane_row((merging(0.0), right)).lanes
    assert 24.0 <= narrow.ends_m <= 34.0  # 1.6 m narrower
    assert 16.0 <= wide.splits_m <= 28.0
    assert (narrow.splits_m, wide.ends_m, straight.ends_m, straight.splits_m) == (None,) * 4


def test_lines_are_drawn_behind_road_users() -> None:
    lanes = EgoLane().lanes((line(0, 5.2), line(1, 1.75), line(2, -1.75)), 0)
    car = new_vehicle(3, SE2(14.0, 1.75, 0.0), length_m=4.0, width_m=1.8, height_m=1.5)
    estimate = new_estimate(vehicles=(car,), lanes=lanes)
    image = np.full((CAMERA.height_px, CAMERA.width_px, 3), 90, np.uint8)
    with_lines = SideBySide(CAMERA).draw(image, estimate, [], [])
    without = SideBySide(CAMERA).draw(image, msgspec.structs.replace(estimate, lanes=None), [], [])
    scale = min(MAX_SCALE, MAX_WIDTH_PX / CAMERA.width_px)
    on_car, before_it = (
        np.rint((bev.ego_to_pixel(CAMERA, CAMERA.ground, np.array([at]))[0] + 0.5) * scale - 0.5).astype(int)
        for at in ((18.0, 1.75), (9.0, 1.75))
    )
    changed = (with_lines != without).any(axis=2)
    assert changed[before_it[1] - 2 : before_it[1] + 3, before_it[0] - 2 : before_it[0] + 3].any()
    assert not changed[on_car[1] - 2 : on_car[1] + 3, on_car[0] - 2 : on_car[0] + 3].any()


def test_the_map_has_each_line_once(tmp_path: Path) -> None:
    path = tmp_path / "map.geojson"
    lines = LineMap(path)
    for k in range(30):
        both = Lanes(lines=(line(4, 1.75), line(5, -1.75)), age_ns=0)
        lines.add(new_estimate(frame_id=k, t_source_ns=k * 10**8, T_world_ego=SE2(float(k)), lanes=both), SE2())
    lines.close()
    features = json.loads(path.read_text())["features"]
    assert [feature["properties"]["line"] for feature in features] == [4, 5]
    for feature, y_m in zip(features, (1.75, -1.75), strict=True):
        points = np.array(feature["geometry"]["coordinates"])
        assert np.abs(points[:, 1] - y_m).max() < 1e-6
        assert np.all(np.diff(points[:, 0]) > 0.0)
        assert len(feature["properties"]["sigma_m"]) == len(points)
        assert feature["properties"]["kind"] == "solid"


def test_foxglove_draws_lines_where_they_are() -> None:
    lanes = EgoLane().lanes((line(4, 1.75), line(5, -1.75, LineKind.EDGE)), 0)
    estimate = new_estimate(T_world_ego=SE2(5.0, 1.0, 0.3), lanes=lanes)
    (drawn,) = (message for channel, message in scene.from_estimate(estimate, 0) if channel == "/scene")
    assert isinstance(drawn, SceneUpdate)
    (entity,) = (entity for entity in drawn.entities if entity.id == "lanes")
    assert entity.frame_id == "ego"
    assert [{point.y for point in strip.points} for strip in entity.lines] == [{1.75}, {-1.75}, {0.0}]
    assert [strip.color for strip in entity.lines] == [scene.WHITE_LINE, scene.UNSEEN, scene.OWN_LANE]
    assert entity.lines[0].points[-1].x >= 50.0


def test_the_scores_of_known_errors() -> None:
    x = np.arange(-2.0, 60.0, 2.0)
    truth = tuple(TrueLine(k, "solid", np.column_stack([x, np.full(len(x), y)])) for k, y in enumerate((1.75, -1.75)))
    scores, keeper = LineScores(), EgoLane()
    for _ in range(10):
        scores.add(keeper.lanes((line(0, 1.85), line(1, -1.65), line(2, 7.9)), 0), truth)
    report = scores.report("toy")
    assert report.ranges[1].error_median_m == pytest.approx(0.1)
    assert report.recall == 1.0
    assert report.ego_lane_wrong == 0.0
    assert report.width_error_rel == pytest.approx(0.0, abs=1e-9)


def test_overlap_of_a_lane_with_its_mask() -> None:
    lanes = EgoLane().lanes((line(1, 1.75), line(2, -1.75)), 0)
    assert lanes.ego is not None
    area = lane_mask(CAMERA, CAMERA.ground, lanes.ego)
    mask = np.zeros((*area.shape, 3), np.uint8)
    mask[...] = (0, 0, 255)
    mask[area] = (255, 0, 255)
    still = Still(lanes.lines, lane_row(lanes.lines), CAMERA.ground, area)
    assert score("a", CAMERA, still, mask).ego_lane_iou == 1.0
    mask[:, :320][area[:, :320]] = (0, 0, 0)  # ignored
    assert score("a", CAMERA, still, mask).ego_lane_iou == 1.0
    half = msgspec.structs.replace(lanes.ego, width_m=lanes.ego.width_m / 2.0)
    narrow = Still(lanes.lines, still.row, CAMERA.ground, lane_mask(CAMERA, CAMERA.ground, half))
    mask[area] = (255, 0, 255)
    assert score("a", CAMERA, narrow, mask).ego_lane_iou == pytest.approx(0.5, abs=0.05)
    assert iou(np.zeros((2, 2), bool), np.zeros((2, 2), bool), np.ones((2, 2), bool)) == 1.0


def test_a_folder_without_pairs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no pairs"):
        find_pairs(tmp_path)
    (tmp_path / "image_3.png").touch()
    with pytest.raises(DatasetError, match="no mask"):
        find_pairs(tmp_path)


def test_the_egos_lane_in_real_images(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "lanes" / "kitti_um"
    if not folder.is_dir():
        pytest.skip(f"{folder}: not there")
    report = evaluate_stills(Configuration(output=str(tmp_path)), folder)
    assert report.images == 5
    assert 0.0 < report.ego_lane_iou_mean <= 1.0
    assert json.loads((tmp_path / "report.json").read_bytes())["ego_lane_iou_mean"] == report.ego_lane_iou_mean


def test_cars_do_not_count_as_visible_lane() -> None:
    image, masks = picture(SE2(), (1.75, -1.75), (False, False))
    masks.road[100:140, 290:350] = masks.lane[100:140, 290:350] = False  # a car
    still = find_lane(CAMERA, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), masks, np.array([[290.0, 80.0, 350.0, 140.0]]))
    assert still.row.ego is not None
    assert still.area.any()
    assert not still.area[106:134, 296:344].any()
