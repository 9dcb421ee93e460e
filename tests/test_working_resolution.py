"""Large films are downscaled for the ego-motion, and pixels are converted back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.odometry.odometry import Odometry
from birdslam.odometry.working_resolution import (
    FOCAL_PX,
    MAX_FOCAL_PX,
    MIN_FOCAL_PX,
    MIN_UPSCALED_FOCAL_PX,
    WorkingResolution,
)


def camera(focal_px: float, width_px: int = 1920, height_px: int = 1080) -> Camera:
    return Camera(width_px, height_px, focal_px, focal_px, 0.5 * (width_px - 1), 0.52 * height_px, height_m=1.3)


@pytest.mark.parametrize("focal_px", [MAX_FOCAL_PX, MIN_FOCAL_PX, MIN_UPSCALED_FOCAL_PX - 1.0])
def test_suitable_film_is_not_scaled(focal_px: float) -> None:
    given_camera = camera(focal_px)
    resolution = WorkingResolution(given_camera)
    image, boxes = np.zeros((1080, 1920), np.uint8), np.ones((2, 4))
    assert resolution.camera is given_camera
    assert resolution.image(image) is image
    assert resolution.boxes_px(boxes) is boxes


@given(
    st.one_of(st.floats(MAX_FOCAL_PX + 1.0, 4000.0), st.floats(MIN_UPSCALED_FOCAL_PX, MIN_FOCAL_PX - 1.0)),
    st.floats(100.0, 1800.0),
    st.floats(100.0, 1000.0),
)
def test_a_pixel_is_the_same_ray_at_both_resolutions(focal_px: float, u: float, v: float) -> None:
    given_camera = camera(focal_px)
    resolution = WorkingResolution(given_camera)
    box = np.array([[u, v, u, v]])
    there = resolution.boxes_px(box)[:, :2]
    np.testing.assert_allclose(resolution.camera.to_xy(there), given_camera.to_xy(box[:, :2]), atol=1e-9)
    np.testing.assert_allclose(resolution.original_px(there), box[:, :2], atol=1e-9)
    assert 0.5 * (resolution.camera.fx_px + resolution.camera.fy_px) == pytest.approx(FOCAL_PX, rel=0.01)


def test_scaled_image_keeps_relative_positions() -> None:
    resolution = WorkingResolution(camera(1440.0))
    image = np.zeros((1080, 1920), np.uint8)
    image[400:440, 800:840] = 200
    small = resolution.image(image)
    assert small.shape == (resolution.camera.height_px, resolution.camera.width_px) == (540, 960)
    v, u = (float(at.mean()) for at in np.nonzero(small > 100))
    np.testing.assert_allclose(resolution.original_px(np.array([[u, v]])), [[819.5, 419.5]], atol=1.0)
    mask = resolution.mask(image > 0)
    assert mask.sum() == 400
    with pytest.raises(ValueError, match="640x360"):
        resolution.image(np.zeros((360, 640), np.uint8))


def test_odometry_gives_pixels_of_its_input_images() -> None:
    """A plane of texture, larger than the working resolution: corners lie where the texture is."""
    large = camera(1440.0)
    odometry = Odometry(large)
    rng = np.random.default_rng(0)
    image = np.full((1080, 1920), 90, np.uint8)
    image[700:1000, 600:1300] = np.kron(rng.integers(0, 255, (30, 70)), np.ones((10, 10))).astype(np.uint8)
    for k in range(3):
        odometry.estimate(odometry.track(np.roll(image, 4 * k, axis=0)), k, k * 33_000_000, np.zeros((0, 4)))
    ids, px = odometry.road_tracks
    assert len(ids) > 10
    assert ((px[:, 0] > 590) & (px[:, 0] < 1310) & (px[:, 1] > 690) & (px[:, 1] < 1020)).all()
