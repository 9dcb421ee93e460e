"""Feature tracks: alignment with the template removes the drift of the optical flow."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.odometry.corners.feature_tracks import FeatureConfig, FeatureTracker, Tracks
from birdslam.odometry.corners.templates import CornerTemplates

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
