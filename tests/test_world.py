"""The built-in world: exact truth, continuous drives, deterministic by seed."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera

pytest.importorskip("numba", reason="the built-in world is rendered with numba (extra `train`)")

from birdslam.world.truth import CLASSES, WorldFrame
from birdslam.world.world import World, WorldConfig, sample

WIDTH, HEIGHT = 320, 96
ROAD, LANE = CLASSES.index("road"), CLASSES.index("lane")
SEEDS = range(12)


@pytest.fixture(scope="module")
def frames() -> list[WorldFrame]:
    return [sample(seed, WIDTH, HEIGHT) for seed in SEEDS]


@pytest.fixture(scope="module")
def level() -> list[WorldFrame]:
    """Frames of level streets: there all of the road is the plane (a bend in a grade is none)."""
    flat = []
    for seed in range(150):
        frame = sample(seed, WIDTH, HEIGHT)
        heights = [o.base_cam_m @ frame.camera.ground.normal_cam + frame.camera.height_m for o in frame.objects]
        up = frame.T_world_cam[:3, :3] @ frame.camera.ground.normal_cam
        far = max((o.base_cam_m[2] for o in frame.objects), default=0.0) > 60.0
        if (
            far
            and up[2] > 1.0 - 1e-9
            and max(map(abs, heights)) < 0.02
            and np.isin(frame.classes, (ROAD, LANE)).sum() > 1000
        ):
            flat.append(frame)
    assert len(flat) >= 5
    return flat


def test_the_same_seed_gives_the_same_bytes(frames: list[WorldFrame]) -> None:
    for seed in SEEDS[:3]:
        again = sample(seed, WIDTH, HEIGHT)
        for name in ("image", "depth_m", "classes", "instances"):
            assert getattr(frames[seed], name).tobytes() == getattr(again, name).tobytes()
        assert frames[seed].camera == again.camera
        assert [o.T_ego_object for o in frames[seed].objects] == [o.T_ego_object for o in again.objects]
    assert frames[0].image.tobytes() != frames[1].image.tobytes()


def test_shapes_and_classes(frames: list[WorldFrame]) -> None:
    for frame in frames:
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
        assert frame.depth_m.shape == frame.classes.shape == frame.instances.shape == (HEIGHT, WIDTH)
        assert int(frame.classes.max()) < len(CLASSES)
        np.testing.assert_array_equal(np.isinf(frame.depth_m), frame.classes == CLASSES.index("sky"))
        assert float(frame.depth_m.min()) > 0.0


def test_depth_of_the_road_is_that_of_the_ground_plane(level: list[WorldFrame]) -> None:
    """Eq. 1 with the truth's K, height, pitch and roll gives the very depth of every road pixel."""
    for frame in level:
        v, u = np.nonzero(np.isin(frame.classes, (ROAD, LANE)) & (frame.depth_m < 40.0))
        points = bev.road_point_cam(frame.camera, frame.camera.ground, np.column_stack([u, v]))
        error = np.abs(points[:, 2] - frame.depth_m[v, u]) / frame.depth_m[v, u]
        assert float(np.nanmedian(error)) < 1e-3
        assert float(np.nanquantile(error, 0.98)) < 0.02  # seams of the mesh; the grade is drawn to the centimetre


def corners_px(frame: WorldFrame, index: int) -> np.ndarray:
    """(8, 2) corners of a body's 3-D box in the image; NaN behind the camera."""
    body = frame.objects[index]
    x, y, z = 0.5 * body.length_m, 0.5 * body.width_m, body.height_m
    box = np.array([(a * x, b * y, c * z) for a in (-1, 1) for b in (-1, 1) for c in (0, 1)])
    ground = frame.camera.ground
    flat = body.T_ego_object @ box[:, :2]
    lift = float(body.base_cam_m @ ground.normal_cam) + ground.height_m
    return bev.ego_to_pixel(frame.camera, ground, np.column_stack([flat, box[:, 2] + lift]))


def test_the_box_in_space_projects_onto_the_box_in_the_image(level: list[WorldFrame]) -> None:
    checked = 0
    for frame in level:
        for index, body in enumerate(frame.objects):
            px = corners_px(frame, index)
            if body.label not in ("car", "van") or np.isnan(px).any() or body.base_cam_m[2] < 2.0 * body.length_m:
                continue
            outer = np.concatenate([px.min(axis=0), px.max(axis=0)])
            size = max(float((outer[2:] - outer[:2]).max()), 1.0)
            # The body fills its box except for rounded ends; mirrors protrude
            np.testing.assert_allclose(body.full_box_px, outer, atol=0.12 * size + 1.0)
            checked += 1
    assert checked > 20


def test_pixels_visibility_and_truncation_are_consistent(frames: list[WorldFrame]) -> None:
    seen = 0
    for frame in frames:
        for body in frame.objects:
            own = frame.instances == body.object_id + 1
            assert int(own.sum()) == body.pixels
            assert 0.0 <= body.visible <= 1.0
            assert 0.0 <= body.truncated < 1.0
            if body.visible == 0.0:
                assert body.pixels == 0
            if body.pixels:
                v, u = np.nonzero(own)
                x1, y1, x2, y2 = body.box_px
                assert x1 - 1.0 <= u.min()
                assert u.max() <= x2 + 1.0
                assert y1 - 1.0 <= v.min()
                assert v.max() <= y2 + 1.0
                seen += 1
            kinds = np.unique(frame.classes[own]).tolist()
            person = body.label in ("cyclist", "pedestrian")
            assert set(kinds) <= {CLASSES.index("person"), CLASSES.index("other")} if person else True
            assert set(kinds) <= {CLASSES.index("vehicle"), CLASSES.index("other")} if not person else True
    assert seen > 30


def test_unoccluded_body_has_full_visibility(frames: list[WorldFrame]) -> None:
    """Its visible share is that of samples; a body with all of them seen has pixels all over its box's middle."""
    for frame in frames:
        for body in frame.objects:
            if body.visible > 0.999 and body.pixels > 60 and body.label in ("car", "van", "bus"):
                x1, y1, x2, y2 = body.box_px
                u, v = round(0.5 * (x1 + x2)), round(0.5 * (y1 + y2))
                assert frame.instances[v, u] == body.object_id + 1


def test_visible_solid_lines_are_on_lane_pixels(level: list[WorldFrame]) -> None:
    hits = tried = 0
    for frame in level:
        for lane in frame.lanes:
            near = (lane.points_m[:, 0] > 3.0) & (lane.points_m[:, 0] < 12.0)
            if lane.kind != "solid" or not near.any():
                continue
            for u, v in bev.ego_to_pixel(frame.camera, frame.camera.ground, lane.points_m[near]):
                column, row = round(float(u)), round(float(v))
                if not (1 <= column < WIDTH - 1 and 1 <= row < HEIGHT - 1):
                    continue
                around = frame.classes[row - 1 : row + 2, column - 1 : column + 2]
                if np.isin(around, (ROAD, LANE)).all():
                    tried += 1
                    hits += bool((around == LANE).any())
    assert tried > 20
    assert hits >= 0.9 * tried


def test_lanes_and_road_reach_ahead_and_lie_on_each_other(frames: list[WorldFrame]) -> None:
    for frame in frames:
        assert frame.lanes
        ahead = max(float(lane.points_m[:, 0].max()) for lane in frame.lanes)
        length = max(float(np.linalg.norm(np.diff(lane.points_m, axis=0), axis=1).sum()) for lane in frame.lanes)
        assert ahead > 60.0 or length > 20.0  # a bend may lead away to the side
        assert frame.road_m
        assert all(np.isfinite(polygon).all() and len(polygon) >= 4 for polygon in frame.road_m)


def test_cameras_are_those_of_cars(frames: list[WorldFrame]) -> None:
    config = WorldConfig()
    for frame in frames:
        camera = frame.camera
        assert config.height_m[0] <= camera.height_m <= config.height_m[1]
        assert abs(camera.pitch_rad) <= config.pitch_rad
        assert abs(camera.roll_rad) <= config.roll_rad
        field = 2.0 * math.atan(0.5 * camera.width_px / camera.fx_px)
        assert config.field_of_view_rad[0] <= field <= config.field_of_view_rad[1]
        up = frame.T_world_cam[:3, :3] @ camera.ground.normal_cam
        assert up[2] > 0.99  # a grade of 8 % at most
        np.testing.assert_allclose(frame.T_world_cam[:3, :3] @ frame.T_world_cam[:3, :3].T, np.eye(3), atol=1e-9)


def test_motion_in_a_drive_matches_speeds() -> None:
    rate_hz = 33.0
    camera = Camera(160, 48, 96.0, 96.0, 79.5, 22.0, height_m=1.5)
    drive = list(World(3, WorldConfig(samples=1), camera).frames(40, rate_hz))
    assert [frame.frame_id for frame in drive] == list(range(40))
    places = np.array([frame.T_world_cam[:3, 3] for frame in drive])
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) * rate_hz
    assert float(speed.max()) < 40.0
    assert float(np.abs(np.diff(speed)).max()) < 0.6  # m/s within 30 ms, springs included
    compared = 0
    for before, after in pairwise(drive):
        was = {body.object_id: body for body in before.objects}
        for body in after.objects:
            if body.object_id in was and body.base_cam_m[2] > 1.0:
                moved = in_world(after, body.base_cam_m) - in_world(before, was[body.object_id].base_cam_m)
                told = 0.5 * (body.velocity_mps + was[body.object_id].velocity_mps)
                np.testing.assert_allclose(moved[:2] * rate_hz, told, atol=0.15 + 0.06 * float(np.linalg.norm(told)))
                compared += 1
    assert compared > 40


def in_world(frame: WorldFrame, point_cam: np.ndarray) -> np.ndarray:
    return frame.T_world_cam[:3, :3] @ point_cam + frame.T_world_cam[:3, 3]


def test_drive_is_repeatable() -> None:
    world = World(5, WorldConfig(width_px=160, height_px=48, samples=1))
    first, second = ([frame.image.tobytes() for frame in world.frames(3)] for _ in range(2))
    assert first == second
