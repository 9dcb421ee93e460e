"""Corners: tracks without drift, features below the road plane, and the scale of the keyframe window."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.below_plane import BelowPlaneConfig, BelowPlaneFilter
from birdslam.odometry.corners.feature_tracks import FeatureConfig, FeatureTracker, Tracks
from birdslam.odometry.corners.keyframes import KeyframeConfig, KeyframeWindow
from birdslam.odometry.corners.resection import resect
from birdslam.odometry.corners.sliding_window import SlidingWindow, match_ids
from birdslam.odometry.corners.templates import CornerTemplates
from birdslam.odometry.median import quantile
from birdslam.odometry.road.points import is_night, outside
from birdslam.odometry.scale_config import RoadScaleConfig

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


WIDTH_PX, HEIGHT_PX = 640, 240
CENTRE = np.array([WIDTH_PX / 2.0, HEIGHT_PX / 2.0])


def texture(seed: int = 0) -> NDArray[np.float32]:
    """A smooth random texture of twice the image's resolution."""
    noise = np.random.default_rng(seed).normal(size=(2 * HEIGHT_PX, 2 * WIDTH_PX)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return np.asarray(128.0 + 50.0 * smooth / smooth.std(), np.float32)


def view(
    scene: NDArray[np.float32], scale: float, shift_px: NDArray[np.float64], gain: float = 1.0
) -> NDArray[np.uint8]:
    """The image (H, W) of the texture, enlarged about the centre and shifted."""
    A = np.column_stack([np.eye(2) * scale * 0.5, CENTRE * (1.0 - scale) + shift_px])
    image = cv2.warpAffine(scene, A, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_AREA)
    return np.clip(np.rint(gain * image), 0, 255).astype(np.uint8)


def moved(px: NDArray[np.float64], scale: float, shift_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where corners (N, 2) of the first image appear."""
    return (px - CENTRE) * scale + CENTRE + shift_px


def approach(images: int, rate: float, shift_px: NDArray[np.float64]) -> list[tuple[float, NDArray[np.float64]]]:
    return [((1.0 + rate) ** k, k * shift_px) for k in range(images)]


@settings(max_examples=10, deadline=None)
@given(
    rate=st.floats(-0.01, 0.02),
    shift=st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0)),
    noise_grey=st.floats(0.5, 3.0),
    seed=st.integers(0, 100),
)
def test_tracks_do_not_drift_while_the_scene_grows(
    rate: float, shift: tuple[float, float], noise_grey: float, seed: int
) -> None:
    scene, rng = texture(seed), np.random.default_rng(seed)
    tracker = FeatureTracker(WIDTH_PX, HEIGHT_PX, FeatureConfig())
    first = None
    for scale, shift_px in approach(25, rate, np.array(shift)):
        image = view(scene, scale, shift_px) + rng.normal(0.0, noise_grey, (HEIGHT_PX, WIDTH_PX))
        tracks = tracker.track(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        tracker.accept(tracks)
        first = tracks if first is None else first
    at = np.searchsorted(first.ids, tracks.ids[tracks.age == 24])
    error_px = np.abs(tracks.px[tracks.age == 24] - moved(first.px[at], scale, shift_px)).max(axis=1)
    assert len(error_px) > 40
    assert np.median(error_px) < 0.15


def test_an_alignment_is_independent_of_brightness() -> None:
    scene, px = texture(), np.array([[200.0, 100.0], [300.0, 60.0], [420.0, 170.0]])
    templates = CornerTemplates()
    templates.update(view(scene, 1.0, np.zeros(2)), np.arange(3), px, np.zeros(0))
    shift_px = np.array([0.4, -0.3])
    aligned = templates.align(view(scene, 1.0, shift_px, gain=0.6), np.arange(3), px)
    assert aligned.good.all()
    assert aligned.px == pytest.approx(px + shift_px, abs=0.08)
    assert aligned.scale == pytest.approx(np.ones(3), abs=0.03)


def test_a_corner_that_is_covered_is_lost() -> None:
    scene, tracker = texture(), FeatureTracker(WIDTH_PX, HEIGHT_PX, FeatureConfig())
    for _ in range(2):
        tracker.accept(tracker.track(view(scene, 1.0, np.zeros(2))))
        scene[0, 0] += 1.0  # not frozen
    image = view(scene, 1.0, np.zeros(2))
    image[:, 320:] = view(texture(7), 1.0, np.zeros(2))[:, 320:]
    tracks = tracker.track(image)
    old = tracks.age > 0
    covered = tracks.px[old, 0] > 330.0
    assert covered.mean() < 0.03
    assert old.sum() > 50


def near_road(x_m: float) -> NDArray[np.uint8]:
    """A textured road, seen by a level camera at a height of 1.65 m, `x_m` along the road."""
    u, v = np.meshgrid(np.arange(WIDTH_PX, dtype=np.float32), np.arange(HEIGHT_PX, dtype=np.float32))
    ahead_m = 260.0 * 1.65 / np.maximum(v - CENTRE[1], 0.5)
    side_m = (u - CENTRE[0]) * ahead_m / 260.0
    at = (24.0 * side_m + WIDTH_PX).astype(np.float32), (24.0 * (ahead_m + x_m)).astype(np.float32)
    return cv2.remap(texture(), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.uint8)


def test_the_near_road_is_tracked_at_a_low_frame_rate() -> None:
    """Its patches are stretched by more than one alignment covers."""

    def predict(reference: Tracks) -> NDArray[np.float64]:
        ahead_m = 260.0 * 1.65 / np.maximum(reference.px[:, 1] - CENTRE[1], 0.5)
        return (reference.px - CENTRE) * (ahead_m / np.maximum(ahead_m - 0.8, 0.5))[:, None] + CENTRE

    tracker = FeatureTracker(WIDTH_PX, HEIGHT_PX, FeatureConfig())
    first = tracker.track(near_road(0.0))
    tracker.accept(first)
    tracks = tracker.track(near_road(0.8), predict)
    old = tracks.age > 0
    error_px = tracks.px[old] - predict(first)[np.searchsorted(first.ids, tracks.ids[old])]
    assert old.sum() > 100
    assert np.median(np.abs(error_px).max(axis=1)) < 1.0


FOCAL_PX, HALF_XY = 370.0, (0.86, 0.26)  # of the shipped drive's camera; half the image in normalised coordinates
STEP_M = 0.45
POINTS = 700


def unit_of_length(seed: int, way_m: float, sigma_px: float) -> Floats:
    """Estimated over true length of pieces of a straight street between points at both sides, seen with noise.

    The first two poses are the true ones; afterwards the scale is not observable.
    """
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0], POINTS)
    points = np.column_stack(
        [side * rng.uniform(3.0, 8.0, POINTS), rng.uniform(-4.0, 1.5, POINTS), rng.uniform(3.0, way_m + 50.0, POINTS)]
    )
    window = KeyframeWindow(FOCAL_PX, KeyframeConfig())
    step = Pose(np.eye(3), np.array([0.0, 0.0, STEP_M]))
    poses = [Pose(np.eye(3), np.zeros(3))]
    for frame in range(int(way_m / STEP_M)):
        at = points - frame * step.p
        near = np.flatnonzero((at[:, 2] > 3.0) & (at[:, 2] < 50.0))
        xy = at[near, :2] / at[near, 2:]
        seen = (np.abs(xy) < HALF_XY).all(axis=1)
        ids, xy = near[seen], xy[seen] + rng.normal(0.0, sigma_px / FOCAL_PX, (int(seen.sum()), 2))
        if frame == 0:
            window.append(frame, poses[0], ids, xy)
            continue
        pose = poses[-1] @ step
        if frame > 1:
            pose, _, _ = resect(window, poses[-1] @ poses[-2].between(poses[-1]), ids, xy)
        window.extend(frame, pose, ids, xy)
        poses.append(window.refine())
    ways_m = [float(np.linalg.norm(b.p - a.p)) for a, b in zip(poses[9::3], poses[12::3], strict=False)]
    return np.array(ways_m) / (3 * STEP_M)


def test_scale_drifts_no_faster_than_stated_to_the_road_filter() -> None:
    """Over 60 m of 4 streets: the root mean square of what it walked, in which a drift to one side would show too."""
    way_m, walked = 60.0, []
    for seed in range(4):
        unit = np.log(unit_of_length(seed, way_m, 0.35))
        walked.append(unit[-8:].mean() - unit[:8].mean())
    assert np.sqrt(np.mean(np.square(walked))) < RoadScaleConfig().scale_walk_rel_per_sqrt_m * np.sqrt(way_m)


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_common_ids_match_numpy(a: set[int], b: set[int]) -> None:
    first, second = (np.array(sorted(ids), dtype=np.int64) for ids in (a, b))
    _, at_first, at_second = np.intersect1d(first, second, return_indices=True)
    found = match_ids(first, second)
    assert found[0].tolist() == at_first.tolist()
    assert found[1].tolist() == at_second.tolist()


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30), st.floats(0.0, 1.0))
def test_quantile_matches_numpy(values: list[float], share: float) -> None:
    assert quantile(np.array(values), share) == pytest.approx(float(np.quantile(values, share)), abs=1e-9)
