"""Poses in SE(2), and the road in bird's-eye view."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from birdslam.geometry import bev
from birdslam.geometry.camera import PLANE_AT_M, Camera, GroundPlane, Undistorter
from birdslam.geometry.se2 import SE2, wrap

metres = st.floats(-1e3, 1e3)
angles = st.floats(-math.pi, math.pi, exclude_max=True)
poses = st.builds(SE2, metres, metres, angles)
twists = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)).map(np.array)
small_twists = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1e-5, 1e-5)).map(np.array)


def assert_same(a: SE2, b: SE2, tol: float = 1e-8) -> None:
    assert math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) < tol
    assert abs(wrap(a.yaw_rad - b.yaw_rad)) < tol


@given(poses, poses, poses)
def test_associative(a: SE2, b: SE2, c: SE2) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_identity_and_inverse(a: SE2) -> None:
    assert_same(a @ SE2(), a)
    assert_same(SE2() @ a, a)
    assert_same(a @ a.inverse(), SE2())
    assert_same(a.inverse() @ a, SE2())


@given(poses, poses)
def test_between_undoes_composition(a: SE2, b: SE2) -> None:
    assert_same(a @ a.between(b), b)


@given(poses, poses, metres, metres)
def test_acts_on_points(a: SE2, b: SE2, x: float, y: float) -> None:
    p = np.array([x, y])
    np.testing.assert_allclose((a @ b) @ p, a @ (b @ p), atol=1e-8)
    np.testing.assert_allclose(np.append(a @ p, 1.0), a.matrix() @ [x, y, 1.0], atol=1e-8)


@given(twists | small_twists)
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(SE2.exp(xi).log(), xi, atol=1e-9)


@given(st.builds(SE2, metres, metres, st.floats(-3.1, 3.1)))
@example(SE2(0.0, 225.0, 1e-6))
def test_exp_undoes_log(a: SE2) -> None:
    assert_same(SE2.exp(a.log()), a)


@given(twists, st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_exp_is_a_one_parameter_subgroup(xi: np.ndarray, s: float, t: float) -> None:
    assert_same(SE2.exp(s * xi) @ SE2.exp(t * xi), SE2.exp((s + t) * xi))


@given(poses, st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-1.5, 1.5)).map(np.array))
def test_adjoint_moves_twists(a: SE2, xi: np.ndarray) -> None:
    assert_same(a @ SE2.exp(xi), SE2.exp(a.adjoint() @ xi) @ a, tol=1e-6)


@given(st.floats(-1e4, 1e4))
def test_wrap(angle: float) -> None:
    wrapped = wrap(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_refuses_what_is_not_finite(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        SE2(0.0, bad, 0.0)
    with pytest.raises(msgspec.ValidationError, match="finite"):
        msgspec.convert([0.0, 0.0, bad], SE2)


KITTI_LIKE = {"width_px": 1242, "height_px": 375, "fx_px": 721.5, "fy_px": 721.5, "cx_px": 609.6, "cy_px": 172.9}
grounds = st.builds(GroundPlane, st.floats(0.5, 3.0), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))


def camera(**changes: object) -> Camera:
    return Camera(**{**KITTI_LIKE, "height_m": 1.65, **changes})


@given(grounds, st.floats(3.0, 60.0), st.floats(-1.0, 1.0))
def test_back_projection_undoes_projection(ground: GroundPlane, x_m: float, slope: float) -> None:
    p_ego = np.array([[x_m, slope * x_m]])
    px = bev.ego_to_pixel(camera(), ground, p_ego)
    np.testing.assert_allclose(bev.pixel_to_ego(camera(), ground, px), p_ego, rtol=1e-6, atol=1e-6)


@given(grounds, st.floats(3.0, 40.0), st.floats(-1.0, 1.0), st.floats(-1e-3, 3e-3))
def test_back_projection_follows_vertical_curvature(
    ground: GroundPlane, x_m: float, side: float, vertical_per_m: float
) -> None:
    """Up to the crest of a falling road, which hides the road beyond."""
    if vertical_per_m < 0.0:
        x_m = min(x_m, 0.9 * math.sqrt(2.0 * ground.height_m / -vertical_per_m))
    height_m = 0.5 * vertical_per_m * x_m * (x_m - PLANE_AT_M)
    px = bev.ego_to_pixel(camera(), ground, np.array([[x_m, side * x_m, height_m]]))
    found = bev.pixel_to_ego(camera(), ground, px, vertical_per_m)
    np.testing.assert_allclose(found, [[x_m, side * x_m]], rtol=1e-5, atol=1e-6)
    ((_, slope),) = bev.bearing_and_slope(camera(), ground, px)
    assert bev.RoadProfile(ground.height_m, vertical_per_m).slope(x_m) == pytest.approx(slope, abs=1e-9)


def test_equation_1_as_in_the_paper() -> None:
    """On level ground the normal is [0, -1, 0], and depth is H * fy / (v - cy)."""
    ground = GroundPlane(1.65)
    np.testing.assert_allclose(ground.normal_cam, [0.0, -1.0, 0.0], atol=1e-12)
    x, y, z = bev.road_point_cam(camera(), ground, np.array([[700.0, 300.0]]))[0]
    assert z == pytest.approx(1.65 * 721.5 / (300.0 - 172.9))
    assert x == pytest.approx(z * (700.0 - 609.6) / 721.5)
    assert y == pytest.approx(1.65)


@given(grounds, st.floats(3.0, 60.0), st.floats(-1.0, 1.0))
def test_slope_and_bearing_of_a_ray_give_the_same_road_point(ground: GroundPlane, x_m: float, side: float) -> None:
    """The vehicles' path has Eq. 1 along its rays' forward axis, the others in camera axes."""
    px = bev.ego_to_pixel(camera(), ground, np.array([[x_m, side * x_m]]))
    ((bearing, slope),) = bev.bearing_and_slope(camera(), ground, px)
    (found_m,) = bev.meet_road(np.ones(1), np.array([slope]), ground.height_m)
    np.testing.assert_allclose([found_m, bearing * found_m], [x_m, side * x_m], rtol=1e-6, atol=1e-6)
    assert bev.road_slope(found_m, ground.height_m) == pytest.approx(slope)


def test_axes_are_rep_103() -> None:
    ahead_left = bev.pixel_to_ego(camera(), GroundPlane(1.65), np.array([[400.0, 300.0]]))[0]
    assert ahead_left[0] > 0.0
    assert ahead_left[1] > 0.0
    assert GroundPlane(1.65, pitch_rad=0.1).R_ego_cam[2, 2] < 0.0  # nose down: the optical axis meets the road


def test_no_road_above_the_horizon() -> None:
    assert np.isnan(bev.pixel_to_ego(camera(), GroundPlane(1.65), np.array([[600.0, 172.0], [600.0, 173.0]]))).all()


@settings(max_examples=6)
@given(st.floats(5.0, 25.0), st.floats(-6.0, 6.0), st.floats(-0.02, 0.02))
def test_covariance_is_that_of_sampled_errors(x_m: float, y_m: float, pitch_rad: float) -> None:
    lens, ground, sigma_px, sigma_pitch, sigma_height = camera(), GroundPlane(1.65, pitch_rad), 0.3, 0.0005, 0.01
    px = bev.ego_to_pixel(lens, ground, np.array([[x_m, y_m]]))
    cov = bev.road_point_cov(lens, ground, px, sigma_px, sigma_pitch, sigma_height)[0]
    rng = np.random.default_rng(0)
    samples = np.array(
        [
            bev.pixel_to_ego(
                lens,
                GroundPlane(1.65 * (1 + sigma_height * h), pitch_rad + sigma_pitch * p),
                px + sigma_px * np.array([[u, v]]),
            )[0]
            for u, v, p, h in rng.standard_normal((1500, 4))
        ]
    )
    np.testing.assert_allclose(np.cov(samples.T), cov, rtol=0.2, atol=0.15 * np.trace(cov))


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"fx_px": 0.0}, "fx_px"),
        ({"fx_px": 10.0}, "focal"),
        ({"cx_px": 5000.0}, "principal point"),
        ({"height_m": 16.5}, "height_m"),
        ({"pitch_rad": 2.0}, "pitch_rad"),
        ({"cy_px": math.nan}, "finite"),
        ({"distortion": (0.1, 0.2)}, "distortion"),
        ({"hight_m": 1.6}, "hight_m"),
    ],
)
def test_wrong_calibrations_are_named(changes: dict[str, object], names: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=names):
        msgspec.convert({**KITTI_LIKE, "height_m": 1.65, **changes}, Camera)


def test_undistortion_straightens_a_line() -> None:
    lens = camera(distortion=(-0.3, 0.1, 0.0, 0.0))
    image = np.zeros((375, 1242), np.uint8)
    y = (np.arange(-0.2, 0.25, 0.0005))[:, None]
    x = np.full_like(y, 0.6)
    r2 = x**2 + y**2
    bent = np.hstack([x, y]) * (1 - 0.3 * r2 + 0.1 * r2**2)
    columns = np.rint(bent[:, 0] * 721.5 + 609.6).astype(int)
    rows = np.rint(bent[:, 1] * 721.5 + 172.9).astype(int)
    for shift in (-1, 0, 1):
        image[np.clip(rows, 0, 374), columns + shift] = 255
    straight = Undistorter(lens)(image)
    centres = [np.average(np.arange(1242), weights=row) for row in straight[60:300].astype(float) if row.sum() > 0]
    assert len(centres) > 200
    assert np.ptp(centres) < 1.5
    with pytest.raises(ValueError, match="1241x375"):
        Undistorter(lens)(image[:, :-1])
