"""`python -m perf films`: all variants of a film use one fixed camera; noise is one of the variants."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.perf.accuracy.films import CAMERAS, FILMS, camera_of
from birdslam.perf.robustness.film_variants import variants

CAMERA = Camera(640, 360, 500.0, 500.0, 320.0, 180.0, 1.4)


def test_every_video_has_its_camera_file() -> None:
    videos = {name for name, film in FILMS.items() if film.uri.startswith("video:")}
    assert {path.stem for path in CAMERAS.iterdir()} == videos
    assert {name for name in FILMS if camera_of(name) is not None} == videos


def test_noise_draws_differ_are_repeatable_and_invisible() -> None:
    unchanged, *draws = variants(CAMERA, "noise")
    image = np.full((36, 64, 3), 120, np.uint8)
    assert unchanged.shown is None
    shown = [draw.shown(7, image) for draw in draws if draw.shown is not None]
    assert len(shown) == len(draws) >= 5
    for k, one in enumerate(shown):
        assert 1.0 < one.std() < 2.0
        assert abs(one.mean() - 120.0) < 0.2
        assert all((one != other).any() for other in shown[:k])
    assert draws[0].shown is not None
    np.testing.assert_array_equal(shown[0], draws[0].shown(7, image))
