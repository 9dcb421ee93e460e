"""Films at other sizes, rates and compressions show the same points at the same times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.geometry.camera import Camera
from birdslam.perf.robustness.film_figures import Course, over, summary
from birdslam.perf.robustness.film_variants import PARTS, Timed, Variant, variants

CAMERA = Camera(640, 360, 500.0, 500.0, 318.0, 181.0, height_m=1.4)
EVERY = list({variant.name: variant for part in PARTS for variant in variants(CAMERA, part)}.values())


def film(images: int = 6) -> list[Timed]:
    """Colour images of a slope of brightness, each brighter than the one before, 0.1 s apart."""
    slope = np.linspace(0, 150, 640)[None, :, None] + np.zeros((360, 1, 3))
    return [(k * 100_000_000, np.asarray(slope + 10 * k, np.uint8)) for k in range(images)]


@given(st.floats(0.5, 3.0), st.floats(0.0, 639.0), st.floats(0.0, 359.0))
def test_pixel_at_another_size_is_the_same_ray(size: float, u: float, v: float) -> None:
    camera = Variant("", size=size).camera(CAMERA)
    x, y = camera.width_px / CAMERA.width_px, camera.height_px / CAMERA.height_px
    there = (np.array([[u, v]]) + 0.5) * [x, y] - 0.5
    np.testing.assert_allclose(camera.to_xy(there), CAMERA.to_xy(np.array([[u, v]])), atol=1e-9)


def test_unsupported_widths_are_left_out() -> None:
    sizes = {variant.size for variant in EVERY}
    assert min(sizes) == 0.5
    assert all(320 <= 640 * size <= 3840 for size in sizes)
    assert 0.5 not in {variant.size for variant in variants(replace(CAMERA, width_px=600), "sizes")}


def test_rates(tmp_path: Path) -> None:
    every = list(Variant("", every=2).images(iter(film()), tmp_path))
    assert [t_ns for t_ns, _ in every] == [0, 200_000_000, 400_000_000]
    twice = list(Variant("", repeats=2).images(iter(film(3)), tmp_path))
    assert [t_ns for t_ns, _ in twice] == [0, 50_000_000, 100_000_000, 150_000_000, 200_000_000]
    assert np.array_equal(twice[0][1], twice[1][1])
    assert not np.array_equal(twice[1][1], twice[2][1])


@pytest.mark.parametrize("variant", EVERY, ids=lambda variant: variant.name)
def test_images_keep_their_size_and_times(variant: Variant, tmp_path: Path) -> None:
    if variant.crf is not None:
        pytest.importorskip("av", reason="PyAV is not installed")
    camera, given_film = variant.camera(CAMERA), film()
    brightness = {t_ns: image.mean() for t_ns, image in given_film}
    for t_ns, image in variant.images(iter(given_film), tmp_path):
        assert image.shape == (camera.height_px, camera.width_px, 3)
        if variant.shown is None and not variant.interlaced and t_ns in brightness:
            assert image.mean() == pytest.approx(brightness[t_ns], abs=4.0)  # colours lose a little in an encoder


def test_repetitions_go_through_the_encoder(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    shown = list(Variant("", repeats=2, crf=23).images(iter(film(3)), tmp_path))
    assert [t_ns for t_ns, _ in shown] == [0, 50_000_000, 100_000_000, 150_000_000, 200_000_000]
    assert shown[1][1].mean() == pytest.approx(shown[0][1].mean(), abs=1.0)


def test_an_interlaced_image_is_of_two_times_half_its_period_apart(tmp_path: Path) -> None:
    raw = film(6)
    shown = list(Variant("", every=2, interlaced=True).images(iter(raw), tmp_path))
    assert [t_ns for t_ns, _ in shown] == [0, 200_000_000, 400_000_000]
    assert np.array_equal(shown[1][1][::2], raw[2][1][::2])
    assert np.array_equal(shown[1][1][1::2], raw[3][1][1::2])


def test_uneven_true_steps_do_not_affect_the_ratio_at_any_rate() -> None:
    """As in KITTI: distances per second are compared, not frames."""
    courses = []
    for every in (1, 2):
        course = Course()
        for k in range(every, 61, every):
            true = sum(1.2 if step % 3 == 0 else 0.9 for step in range(k - every, k))
            course.add(0.1 * k, 0.1 * every, 10.0, 10.0 * true / every, valid=k > 5, sigma_rel=0.02)
        courses.append(summary(course))
    ratio = over(courses[1], courses[0])
    assert ratio is not None
    assert abs(ratio - 1.0) < 0.015
    assert abs(courses[0]["speed_over_truth"] - courses[1]["speed_over_truth"]) > 0.03  # of frames it would be
    assert courses[0]["first_valid_s"] == pytest.approx(0.6)
