"""Vehicles from depth: exact on exact depth, consistent with noise, fused with Eq. 1 by covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.bev import ego_to_pixel
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2, wrap
from birdslam.perception import Boxes3d, DepthMap, Detections
from birdslam.road_users.placement.body_fit import fit_footprint, footprints, surface_m
from birdslam.road_users.placement.depth_fusion import DepthPlace, PseudoLidarConfig, fuse
from birdslam.road_users.placement.localisation import LocalisationConfig, Observation, Place, observe_boxes, place
from birdslam.road_users.placement.pseudolidar import in_metres, locate_detected_bodies, locate_in_depth_map

CAMERA = Camera(
    width_px=1242, height_px=375, fx_px=720.0, fy_px=720.0, cx_px=610.0, cy_px=173.0, height_m=1.65, pitch_rad=0.01
)
CONFIG = PseudoLidarConfig()
LOCALISATION = LocalisationConfig()
CAR = LOCALISATION.vehicles["car"]


def scene(poses: list[SE2], cells: tuple[int, int] = (96, 320)) -> tuple[DepthMap, NDArray[np.float64]]:
    """The exact depth of cuboid cars on a flat road, and their boxes, by ray casting (slabs in three axes)."""
    height, width = cells
    u = (np.arange(width) + 0.5) * CAMERA.width_px / width - 0.5
    v = (np.arange(height) + 0.5) * CAMERA.height_px / height - 0.5
    uu, vv = np.meshgrid(u, v)
    rays = np.stack([(uu - CAMERA.cx_px) / CAMERA.fx_px, (vv - CAMERA.cy_px) / CAMERA.fy_px, np.ones_like(uu)], -1)
    rays = rays @ CAMERA.ground.R_ego_cam.T  # a unit along the optical axis
    origin = np.array([0.0, 0.0, CAMERA.height_m])
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0.0, -origin[2] / rays[..., 2], 200.0)
    boxes = []
    for pose in poses:
        R = np.eye(3)
        R[:2, :2] = pose.rotation()
        low = np.array([-CAR.length_m / 2, -CAR.width_m / 2, 0.0])
        high = np.array([CAR.length_m / 2, CAR.width_m / 2, CAR.height_m])
        start, along = (origin - [pose.x_m, pose.y_m, 0.0]) @ R, rays @ R
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.stack([(low - start) / along, (high - start) / along])
        enter, leave = t.min(axis=0).max(axis=-1), t.max(axis=0).min(axis=-1)
        depth = np.where((enter <= leave) & (enter > 0.0), np.minimum(depth, enter), depth)
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0, high[2])])
        px = ego_to_pixel(CAMERA, CAMERA.ground, corners @ R.T + [pose.x_m, pose.y_m, 0.0])
        boxes.append(np.concatenate([px.min(axis=0), px.max(axis=0)]))
    return DepthMap(np.minimum(depth, 200.0).astype(np.float32), 1242, 375, sigma_rel=0.05), np.array(boxes)


def observed(boxes: NDArray[np.float64]) -> list[Observation]:
    """In the order of the boxes."""
    scores, labels = np.linspace(0.9, 0.8, len(boxes)), ("car",) * len(boxes)
    seen = observe_boxes(boxes, scores, labels, CAMERA, CAMERA.ground, LOCALISATION)
    assert len(seen) == len(boxes)
    return seen


def axis_error(a_rad: float, b_rad: float) -> float:
    return abs(wrap(2.0 * (a_rad - b_rad))) / 2.0


@settings(max_examples=25)
@given(st.floats(8.0, 35.0), st.floats(-0.35, 0.35), st.floats(-math.pi, math.pi))
def test_exact_depth_gives_position_and_axis(x_m: float, bearing: float, yaw_rad: float) -> None:
    pose = SE2(x_m, bearing * x_m, yaw_rad)
    depth, boxes = scene([pose], (188, 621))
    found = fit_footprint(observed(boxes)[0], depth, CAMERA, CAMERA.ground, CONFIG)
    off_m = found.centre_m - [pose.x_m, pose.y_m]
    # Seen face on, its far half is known by its class alone: the yaw there is soft
    assert np.linalg.norm(off_m) < 0.45 + 0.02 * x_m
    assert off_m @ np.linalg.solve(found.cov, off_m) < 9.0
    assert axis_error(found.yaw_rad, yaw_rad) < max(3.0 * found.sigma_yaw_rad, 0.15)


def test_axis_is_accurate_near_and_oblique() -> None:
    for degrees in (20, 45, 70, 110, 150):
        depth, boxes = scene([SE2(10.0, 1.0, math.radians(degrees))])
        found = fit_footprint(observed(boxes)[0], depth, CAMERA, CAMERA.ground, CONFIG)
        assert axis_error(found.yaw_rad, math.radians(degrees)) < math.radians(6)
        assert found.sigma_yaw_rad < math.radians(15)


def test_covariance_covers_depth_noise() -> None:
    rng = np.random.default_rng(5)
    d2 = []
    for _ in range(60):
        pose = SE2(rng.uniform(8, 30), rng.uniform(-4, 4), rng.uniform(-math.pi, math.pi))
        depth, boxes = scene([pose])
        noisy = DepthMap(
            (depth.depth_m * np.exp(rng.normal(0, 0.05) + rng.normal(0, 0.02, depth.depth_m.shape))).astype(np.float32),
            *(1242, 375),
            sigma_rel=0.05,
        )
        found = fit_footprint(observed(boxes)[0], noisy, CAMERA, CAMERA.ground, CONFIG)
        off_m = found.centre_m - [pose.x_m, pose.y_m]
        d2.append(off_m @ np.linalg.solve(found.cov, off_m))
    assert np.mean(np.array(d2) < 2.30) > 0.6  # 0.68 of a Gaussian
    assert np.mean(np.array(d2) < 6.18) > 0.9


def test_no_position_without_usable_depth() -> None:
    depth, boxes = scene([SE2(12.0, 0.0, 0.0)])
    (seen,) = observed(boxes)
    tiny = DepthMap(depth.depth_m[:8, :8], 1242, 375)  # too few columns in the box
    assert fit_footprint(seen, tiny, CAMERA, CAMERA.ground, CONFIG) is None
    far = DepthMap(np.full((96, 320), 90.0, np.float32), 1242, 375)
    assert fit_footprint(seen, far, CAMERA, CAMERA.ground, CONFIG) is None
    assert locate_in_depth_map([seen], depth, CAMERA, CAMERA.ground, PseudoLidarConfig(rule="off")) == [None]
    assert locate_in_depth_map([], depth, CAMERA, CAMERA.ground, CONFIG) == []


def test_unscaled_depth_map_is_scaled_by_the_road() -> None:
    depth, boxes = scene([SE2(12.0, 3.0, 0.3)])
    u, v = np.meshgrid(np.arange(1242), np.arange(375))
    road = (v > 220) & ((u < boxes[0, 0]) | (u > boxes[0, 2]))
    unscaled = DepthMap(depth.depth_m / 7.0, 1242, 375, metric=False)
    metres = in_metres(unscaled, CAMERA, CAMERA.ground, road, CONFIG)
    assert metres.metric
    np.testing.assert_allclose(np.median(metres.depth_m / depth.depth_m), 1.0, atol=0.01)
    for nothing in (None, np.zeros((375, 1242), bool)):
        assert in_metres(unscaled, CAMERA, CAMERA.ground, nothing, CONFIG) is None
        assert locate_in_depth_map(observed(boxes), unscaled, CAMERA, CAMERA.ground, CONFIG, nothing) == [None]
    exact = locate_in_depth_map(observed(boxes), depth, CAMERA, CAMERA.ground, CONFIG)[0]
    scaled = locate_in_depth_map(observed(boxes), unscaled, CAMERA, CAMERA.ground, CONFIG, road)[0]
    np.testing.assert_allclose(scaled.centre_m, exact.centre_m, rtol=0.02)


class Told:
    """A network that answers what it was made with, and remembers what it was asked."""

    def __init__(self, bodies: Boxes3d | None) -> None:
        self.bodies = bodies
        self.asked: list[int] = []

    def locate(self, frusta_cam_m: list, labels: list[str], camera: Camera) -> Boxes3d | None:
        self.asked = [len(points) for points in frusta_cam_m]
        return None if self.bodies is None else self.bodies.take(range(len(frusta_cam_m)))


def told(poses: list[SE2]) -> Boxes3d:
    centres = np.array([[p.x_m, p.y_m, CAR.height_m / 2] for p in poses])
    cam = (centres - [0, 0, CAMERA.height_m]) @ CAMERA.ground.R_ego_cam
    bearing = np.arctan2(centres[:, 1], centres[:, 0])
    n = len(poses)
    return Boxes3d(
        centre_px=cam[:, :2] / cam[:, 2:] * [CAMERA.fx_px, CAMERA.fy_px] + [CAMERA.cx_px, CAMERA.cy_px],
        depth_m=cam[:, 2],
        size_m=np.tile([CAR.length_m, CAR.width_m, CAR.height_m], (n, 1)),
        alpha_rad=np.array([p.yaw_rad for p in poses]) - bearing,
        sigma_depth_m=np.full(n, 0.5),
        sigma_size_m=np.full((n, 3), 0.1),
        sigma_alpha_rad=np.full(n, 0.1),
        flip=np.full(n, 0.05),
    )


def test_network_gets_boxes_with_points_and_gives_poses_in_ego() -> None:
    poses = [SE2(10.0, 2.0, 0.4), SE2(55.0, -3.0, 2.0)]
    depth, boxes = scene(poses)
    network = Told(told(poses))
    config = PseudoLidarConfig(least_points=100)
    near, far = locate_in_depth_map(observed(boxes), depth, CAMERA, CAMERA.ground, config, network=network)
    assert len(network.asked) == 1  # the far one has too few points
    assert far is None
    np.testing.assert_allclose(near.centre_m, [10.0, 2.0], atol=1e-6)
    assert near.yaw_rad == pytest.approx(0.4)
    assert (near.flip, near.size_m) == (0.05, (CAR.length_m, CAR.width_m, CAR.height_m))
    depth_m = network.bodies.depth_m[0] if network.bodies is not None else math.nan
    assert near.cov[0, 0] == pytest.approx(0.5**2 + (0.05 * depth_m) ** 2)  # its sigma and that of the map
    # One that gives no numbers leaves the fit
    fallback = locate_in_depth_map(observed(boxes), depth, CAMERA, CAMERA.ground, config, network=Told(None))
    assert fallback[0].size_m is None


def found_with(poses: list[SE2], bodies: Boxes3d) -> Detections:
    _, boxes = scene(poses)
    return Detections(boxes, np.linspace(0.9, 0.8, len(boxes)), ("car",) * len(boxes), bodies)


def test_bodies_of_the_detector_are_the_second_source() -> None:
    poses = [SE2(10.0, 2.0, 0.4), SE2(25.0, -3.0, 2.0)]
    detections = found_with(poses, told(poses))
    seen = observed(detections.boxes_px)[::-1]  # as bodies go with their boxes, the order is of no matter
    measured, (far, near) = locate_detected_bodies(seen, detections, CAMERA, CAMERA.ground, CONFIG)
    np.testing.assert_allclose(near.centre_m, [10.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(far.centre_m, [25.0, -3.0], atol=1e-6)
    assert near.cov[0, 0] == pytest.approx(0.5**2)
    assert near.has_front
    assert [o.box_px for o in measured] == [o.box_px for o in seen]
    off = PseudoLidarConfig(rule="off")
    assert locate_detected_bodies(seen, detections, CAMERA, CAMERA.ground, off) == (seen, [None, None])
    without = Detections(detections.boxes_px, detections.scores, detections.labels)
    assert locate_detected_bodies(seen, without, CAMERA, CAMERA.ground, CONFIG) == (seen, [None, None])


def test_equal_boxes_keep_their_own_bodies() -> None:
    bodies = told([SE2(10.0, 2.0, 0.4), SE2(12.0, 2.4, 0.4)])
    detections = found_with([SE2(10.0, 2.0, 0.4)], bodies)
    boxes_px, scores = detections.boxes_px.repeat(2, axis=0), np.array([0.9, 0.8])
    twice = replace(detections, boxes_px=boxes_px, scores=scores, labels=("car",) * 2)
    seen = observe_boxes(boxes_px, scores, twice.labels, CAMERA, CAMERA.ground, LOCALISATION)
    assert [o.row for o in seen] == [0]  # one vehicle, by the better score
    _, (found,) = locate_detected_bodies(seen, twice, CAMERA, CAMERA.ground, CONFIG)
    np.testing.assert_allclose(found.centre_m, [10.0, 2.0], atol=1e-6)


@given(st.floats(3.0, 7.0), st.floats(0.05, 3.0), st.floats(8.0, 40.0), st.floats(-math.pi, math.pi))
def test_length_fuses_class_and_body_and_keeps_the_face(
    length_m: float, sigma_m: float, x_m: float, yaw_rad: float
) -> None:
    poses = [SE2(x_m, 0.0, yaw_rad)]
    size = replace(told(poses), size_m=np.array([[length_m, CAR.width_m, CAR.height_m]]))
    detections = found_with(poses, replace(size, sigma_size_m=np.full((1, 3), sigma_m)))
    (seen,), (found,) = locate_detected_bodies(observed(detections.boxes_px), detections, CAMERA, CAMERA.ground, CONFIG)
    together_m, of_class_m = seen.dimensions.length_m, CAR.sigma_length_rel * CAR.length_m
    assert min(length_m, CAR.length_m) - 1e-9 <= together_m <= max(length_m, CAR.length_m) + 1e-9
    assert seen.dimensions.sigma_length_rel * together_m == pytest.approx(1 / math.hypot(1 / sigma_m, 1 / of_class_m))
    half_m = 0.5 * abs(math.cos(yaw_rad))
    assert found.centre_m[0] - half_m * together_m == pytest.approx(x_m - half_m * length_m)


@given(st.floats(0.0, 2 * math.pi), st.floats(6.0, 40.0), st.floats(-3.0, 3.0), st.floats(-0.4, 0.4))
def test_the_visible_surface_is_on_the_footprint_and_in_front(yaw: float, x_m: float, y_m: float, ray: float) -> None:
    pose = SE2(x_m, y_m, yaw)
    _, boxes = scene([SE2(20.0, 0.0, 0.0)])
    corners = footprints(observed(boxes)[0], np.array([yaw])) + np.array([x_m, y_m])
    (hit,) = surface_m(corners, np.array([ray]))[0]
    if math.isnan(hit):
        slopes = corners[0, :, 1] / corners[0, :, 0]
        assert ray <= slopes.min() + 1e-9 or ray >= slopes.max() - 1e-9
        return
    local = pose.inverse() @ np.array([hit, ray * hit])
    half = np.array([CAR.length_m, CAR.width_m]) / 2
    assert np.isclose(np.abs(local) / half, 1.0).any()
    assert (np.abs(local) <= half + 1e-6).all()
    beyond = pose.inverse() @ np.array([hit - 1e-4, ray * (hit - 1e-4)])
    assert (np.abs(beyond) > half - 1e-9).any()


def by_box(x_m: float = 20.0) -> Place:
    return Place(x_m - 2.0, np.array([x_m, 1.0]), np.diag([4.0, 0.04]))


def by_depth(x_m: float = 20.0, var: float = 4.0) -> DepthPlace:
    return DepthPlace(np.array([x_m, 1.2]), np.diag([var, 0.04]), 0.0, 0.1)


def test_fusion_reduces_the_covariance() -> None:
    both = fuse(by_box(20.0), by_depth(21.0), CONFIG)
    np.testing.assert_allclose(both.centre_m, [20.5, 1.0])  # sideways both rest on the edges of the one box
    np.testing.assert_allclose(both.cov, np.diag([2.0, 0.04]))
    assert both.depth_m == pytest.approx(18.5)
    sure = fuse(by_box(20.0), by_depth(21.0, 1e-6), CONFIG)
    assert sure.centre_m[0] == pytest.approx(21.0, abs=1e-3)


def test_contradicting_sources_grow_the_covariance() -> None:
    both = fuse(by_box(20.0), by_depth(60.0), CONFIG)
    assert both.centre_m[0] == pytest.approx(40.0)
    assert both.cov[0, 0] > by_box().cov[0, 0]


def test_papers_rule_uses_the_depth() -> None:
    config = PseudoLidarConfig(rule="paper")
    near, far = fuse(by_box(15.0), by_depth(16.0), config), fuse(by_box(40.0), by_depth(42.0), config)
    assert near.centre_m.tolist() == [16.0, 1.2]
    assert far.centre_m.tolist() == [40.0, 1.0]
    assert fuse(by_box(), None, CONFIG).centre_m.tolist() == [20.0, 1.0]
    assert fuse(by_box(), by_depth(), PseudoLidarConfig(rule="off")).centre_m.tolist() == [20.0, 1.0]


@given(st.floats(5.0, 50.0), st.floats(5.0, 50.0), st.floats(1e-3, 100.0), st.floats(1e-3, 100.0), st.floats(-0.9, 0.9))
def test_combined_covariance_is_valid(a_m: float, b_m: float, a_var: float, b_var: float, rho: float) -> None:
    cov = np.array([[a_var, rho * math.sqrt(a_var * 0.1)], [rho * math.sqrt(a_var * 0.1), 0.1]])
    both = fuse(Place(a_m, np.array([a_m, 0.0]), cov), by_depth(b_m, b_var), CONFIG)
    assert np.linalg.eigvalsh(both.cov).min() > 0.0
    assert np.allclose(both.cov, both.cov.T)
    assert both.depth_m > 0.0
    assert np.isfinite(both.centre_m).all()


def test_depth_and_box_agree_at_equal_depth_and_yaw() -> None:
    """The same edges, so the same bearing: only where along it differs."""
    pose = SE2(15.0, -3.0, 0.5)
    depth, boxes = scene([pose], (188, 621))
    (seen,) = observed(boxes)
    found = fit_footprint(seen, depth, CAMERA, CAMERA.ground, PseudoLidarConfig(yaws=90))
    alone = place(seen, math.log(15.0 - 1.96), 0.0, pose.yaw_rad, LOCALISATION)
    assert found.centre_m[1] / found.centre_m[0] == pytest.approx(alone.centre_m[1] / alone.centre_m[0], abs=0.01)
