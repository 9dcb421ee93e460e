"""Dashcams drawn by seed: always the same ones, as their words say, each with a lens that can be."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from birdslam.perf.cameras.dashcams import draw

if importlib.util.find_spec("numba") is None:
    pytest.skip("the built-in world is rendered with numba (extra `train`)", allow_module_level=True)


def test_drawn_dashcams_have_lenses_that_fold_no_image() -> None:
    for seed in range(1, 40):
        drawn, again = draw(seed), draw(seed)
        assert drawn.words == again.words
        camera = drawn.dashcam.camera
        assert camera.width_px % 2 == camera.height_px % 2 == 0  # H.264 has no odd sizes
        if not camera.fisheye:  # out to the corner, the radius in the image grows with that of the ray
            r = np.linspace(0.0, np.tan(np.radians(0.5 * drawn.dashcam.fov_deg)) * np.hypot(1.0, 9.0 / 16.0), 50)
            assert (np.diff(r * (1.0 + camera.distortion[0] * r**2)) > 0.0).all()


def test_a_loose_mount_swings_as_far_as_it_says() -> None:
    from birdslam.world.dashcam import Dashcam  # needs numba

    loose, at_s = Dashcam(tremble_rad=0.01, tremble_hz=10.0), np.linspace(0.0, 0.1, 101)
    pitch, roll = np.array([loose.trembled(t) for t in at_s]).T
    assert np.abs(pitch).max() == pytest.approx(0.01, rel=1e-3)
    assert np.abs(roll).max() == pytest.approx(0.005, rel=1e-2)
    assert Dashcam().trembled(0.03) == (0.0, 0.0)
