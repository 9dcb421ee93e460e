"""`python -m perf films`: variants show the same points at the same times, with one fixed camera for each film."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.perf.accuracy.films import CAMERAS, FILMS, camera_of
from birdslam.perf.robustness.film_figures import Step, over, summary
from birdslam.perf.robustness.film_variants import PARTS, Timed, Variant, variants

CAMERA = Camera(640, 360, 500.0, 500.0, 318.0, 181.0, height_m=1.4)
EVERY = list({variant.name: variant for part in PARTS for variant in variants(CAMERA, part)}.values())


def film(images: int = 6) -> list[Timed]:
    """Colour images of a slope of brightness, each brighter than the one before, 0.1 s apart."""
    slope = np.linspace(0, 150, 640)[None, :, None] + np.zeros((360, 1, 3))
    return [(k * 100_000_000, np.asarray(slope + 10 * k, np.uint8)) for k in range(images)]


def test_every_video_has_its_camera_file() -> None:
    videos = {name for name, film in FILMS.items() if film.uri.startswith("video:")}
    assert {path.stem for path in CAMERAS.iterdir()} == {FILMS[name].camera or name for name in videos}
    assert {name for name in FILMS if camera_of(name) is not None} == videos


@given(st.floats(0.5, 3.0), st.floats(0.0, 639.0), st.floats(0.0, 359.0))
def test_pixel_at_another_size_is_the_same_ray(size: float, u: float, v: float) -> None:
    camera = Variant("", size=size).camera(CAMERA)
    x, y = camera.width_px / CAMERA.width_px, camera.height_px / CAMERA.height_px
    there = (np.array([[u, v]]) + 0.5) * [x, y] - 0.5
    np.testing.assert_allclose(camera.to_xy(there), CAMERA.to_xy(np.array([[u, v]])), atol=1e-9)


@pytest.mark.parametrize("variant", EVERY, ids=lambda variant: variant.name)
def test_variant_shows_every_nth_image_at_its_size(variant: Variant) -> None:
    camera, shown = variant.camera(CAMERA), list(variant.images(iter(film())))
    assert 320 <= camera.width_px <= 3840
    assert [t_ns for t_ns, _ in shown] == [t_ns for t_ns, _ in film()[:: variant.every]]
    for (_, image), (_, given_image) in zip(shown, film()[:: variant.every], strict=True):
        assert image.shape == (camera.height_px, camera.width_px, 3)
        assert image.mean() == pytest.approx(given_image.mean(), abs=1.0)


def test_uneven_true_steps_do_not_affect_the_ratio_at_any_rate() -> None:
    """As in KITTI: distances per second are compared, not frames."""
    courses = []
    for every in (1, 2):
        steps = []
        for k in range(every, 61, every):
            true = sum(1.2 if step % 3 == 0 else 0.9 for step in range(k - every, k))
            steps.append(Step(0.1 * k, 0.1 * every, 10.0, 10.0 * true / every, valid=k > 5, sigma_rel=0.02))
        courses.append(summary(steps))
    ratio = over(courses[1], courses[0])
    assert abs(ratio - 1.0) < 0.015
    assert abs(courses[0]["speed_over_truth"] - courses[1]["speed_over_truth"]) > 0.03  # of frames it would be
    assert courses[0]["first_valid_s"] == pytest.approx(0.6)
