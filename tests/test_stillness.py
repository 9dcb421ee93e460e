"""A standstill needs positive evidence: static features may be on the windscreen."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.odometry.speed.stillness import NearRoadStillness, StillnessConfig
from birdslam.types import Status

pytestmark = pytest.mark.numeric

WIDTH_PX, HEIGHT_PX, HORIZON_PX = 384, 216, 96
CAMERA = Camera(WIDTH_PX, HEIGHT_PX, 320.0, 320.0, 191.5, 96.0, height_m=1.3)
NO_BOXES = np.zeros((0, 4))


def _texture(
    seed: int, contrast_grey: float, rows: int = 4000, columns: int = WIDTH_PX, grain_px: float = 3.0
) -> np.ndarray:
    grain = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(rows, columns)), (0, 0), grain_px)
    return contrast_grey * grain / float(grain.std())


ROAD = _texture(1, 1.0)


def road_image(along_m: float, contrast_grey: float) -> np.ndarray:
    """(H, W) float: a road whose texture is stretched in columns alone, under a bare sky."""
    image = np.full((HEIGHT_PX, WIDTH_PX), 120.0)
    rows = np.arange(HORIZON_PX + 4, HEIGHT_PX)
    depth_m = CAMERA.fy_px * CAMERA.height_m / (rows - HORIZON_PX)
    image[rows] = 90.0 + contrast_grey * ROAD[((along_m + depth_m) * 40.0).astype(int) % len(ROAD)]
    return image


def behind_drops(image: np.ndarray, seed: int = 2, count: int = 500) -> np.ndarray:
    """Small fixed drops over most of the image."""
    rng, out = np.random.default_rng(seed), image.astype(np.float32)
    for _ in range(count):
        centre = (int(rng.integers(0, WIDTH_PX)), int(rng.integers(0, HEIGHT_PX)))
        cv2.circle(out, centre, int(rng.integers(1, 4)), float(rng.uniform(40.0, 200.0)), -1, cv2.LINE_AA)
    return out


def shown(image: np.ndarray, rng: np.random.Generator, noise_grey: float = 1.5, gain: float = 1.0) -> np.ndarray:
    return np.clip(gain * image + rng.normal(0.0, noise_grey, image.shape), 0, 255).astype(np.uint8)


def watched(
    speed_mps: float, rate_hz: float, contrast_grey: float, drops: int, seconds: float = 1.5, drift: float = 0.0
) -> tuple[NearRoadStillness, list[bool]]:
    """The test after some seconds, and whether it was proven at each image; brightness grows by `drift` a second."""
    stillness, rng = NearRoadStillness(CAMERA, StillnessConfig()), np.random.default_rng(0)
    proven = []
    for k in range(round(seconds * rate_hz)):
        image = behind_drops(road_image(speed_mps * k / rate_hz, contrast_grey), count=drops)
        grey = shown(image, rng, gain=1.0 + drift * k / rate_hz)
        stillness.update(grey, round(k / rate_hz * 1e9), NO_BOXES)
        proven.append(stillness.is_proven)
    return stillness, proven


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("drops", [0, 500])
def test_standstill_is_reported_after_one_second(rate_hz: float, drops: int) -> None:
    stillness, proven = watched(0.0, rate_hz, 20.0, drops, drift=0.02)
    assert not stillness.is_contradicted
    first = proven.index(True) / rate_hz
    assert 0.85 <= first <= 1.1
    assert all(proven[proven.index(True) :])


@pytest.mark.parametrize("speed_mps", [0.5, 3.0, 28.0])
@pytest.mark.parametrize("contrast_grey", [8.0, 20.0])
def test_moving_car_behind_drops_is_not_stationary(speed_mps: float, contrast_grey: float) -> None:
    """At 28 m/s each image of the road is another one: a second changes it no more than a tenth does."""
    stillness, proven = watched(speed_mps, 10.0, contrast_grey, 500)
    assert stillness.is_contradicted
    assert not any(proven)


def test_slow_change_means_motion() -> None:
    stillness, proven = watched(0.12, 30.0, 20.0, 500)
    assert stillness.is_contradicted
    assert not any(proven)


def test_featureless_road_gives_no_evidence() -> None:
    stillness, proven = watched(0.0, 10.0, 0.0, 0)
    assert not stillness.is_contradicted
    assert not any(proven)


def test_vehicles_give_no_evidence() -> None:
    rng = np.random.default_rng(3)
    aside, everything = np.array([[200.0, 60.0, 384.0, 216.0]]), np.array([[0.0, 0.0, 384.0, 216.0]])
    for boxes_px, tells in ((aside, True), (everything, False)):
        stillness = NearRoadStillness(CAMERA, StillnessConfig())
        for k in range(13):
            image = road_image(0.0, 20.0)
            image[60:, 205:380] = rng.uniform(0.0, 255.0)  # it drives
            stillness.update(shown(image, rng), k * 100_000_000, boxes_px)
        assert stillness.is_proven == tells


def _drive(speed_mps: float, contrast_grey: float, seconds: float, rate_hz: float = 20.0) -> list[Motion]:
    """From the first image on behind drops; the road's grain is faint, so that the drops have the corners."""
    odometry, rng, out = Odometry(CAMERA), np.random.default_rng(0), []
    for k in range(round(seconds * rate_hz)):
        image = shown(behind_drops(road_image(speed_mps * k / rate_hz, contrast_grey)), rng, noise_grey=1.0)
        motion = odometry.estimate(odometry.track(image), k, round(k / rate_hz * 1e9), NO_BOXES)
        out += [] if motion is None else [motion]
    return out


def test_start_behind_rain_is_invalid_and_not_a_standstill() -> None:
    motions = _drive(24.0, 8.0, 2.5)
    assert not any(motion.standstill for motion in motions)
    assert all(Status.SCALE_INVALID in motion.status for motion in motions)
    held = [motion for motion in motions if Status.ODOMETRY_COASTING in motion.status]
    assert len(held) > 0.8 * len(motions)
    assert held[5].cov[0, 0] > held[0].cov[0, 0]  # the longer it is held, the less it is known


def test_stop_behind_rain_is_found_within_1_5_s() -> None:
    motions = _drive(0.0, 20.0, 2.0)
    stands = [motion.standstill for motion in motions]
    assert not any(stands[:16])
    assert all(stands[28:])
    assert np.array_equal(motions[-1].t_prev_curr_m, np.zeros(3))


def _noisy(speed_mps: float, contrast_grey: float, noise_grey: float, grain: bool = False) -> NearRoadStillness:
    """The near road after 1.5 s at 20 Hz; `grain`: its texture is as fine as the pixels."""
    rng, stillness = np.random.default_rng(3), NearRoadStillness(CAMERA, StillnessConfig())
    for k in range(30):
        image = road_image(0.05 * k * speed_mps, contrast_grey)
        if grain and speed_mps:
            image[HORIZON_PX:] = rng.normal(90.0, contrast_grey, image[HORIZON_PX:].shape)
        stillness.update(shown(image, rng, noise_grey), k * 50_000_000, NO_BOXES)
    return stillness


def test_stop_on_weak_texture_is_found_in_noise() -> None:
    """Noise alone changes a faint road's image by more than a seventh of its contrast: no motion is in that."""
    stillness = _noisy(0.0, 5.0, 1.1)
    changes = stillness.changes
    assert changes[0] > StillnessConfig().contrast_share * changes[2]
    assert stillness.is_proven


@pytest.mark.parametrize("speed_mps", [0.3, 3.0, 20.0])
def test_noise_is_not_a_standstill(speed_mps: float) -> None:
    assert not _noisy(speed_mps, 5.0, 1.1).is_proven
    assert not _noisy(speed_mps, 5.0, 1.0, grain=True).is_proven
