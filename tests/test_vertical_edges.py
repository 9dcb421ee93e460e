"""Lens distortion from vertical edges of houses and poles, in images of one drive."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.calibration.lens import FIELD_OF_VIEW_DEG, WIDE_SIGMA_REL, k1_by_bend
from birdslam.calibration.lens_adjustment import SIGMA_K1
from birdslam.calibration.vertical_edges import LensByVerticalEdges, find_vertical_edges, lens_by_vertical_edges
from birdslam.runtime.calibration.given import FocalLength
from birdslam.runtime.calibration.lens import focal_by_vertical_edges

Floats = NDArray[np.float64]
FOCAL = 0.65  # in image widths
WIDTH_PX = 1000


def street(focal: float, k1: float = 0.0, fisheye: bool = False, roll_rad: float = 0.0, seed: int = 0) -> list[Floats]:
    """Edges in 12 images of a street through this lens: vertical ones with noise, and a third that lean."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(12):
        n = 60
        x = np.repeat(rng.uniform(-1.3, 1.3, n), 2).reshape(n, 2)  # of the vertical line, at unit distance
        low = rng.uniform(-0.75, 0.0, n)
        ends = np.stack([x, np.stack([low - rng.uniform(0.06, 0.15, n), low], axis=1)], axis=-1)
        ends[: n // 3, 0, 0] += rng.normal(0.0, 0.03, n // 3)
        ends = ends @ np.array([[np.cos(roll_rad), np.sin(roll_rad)], [-np.sin(roll_rad), np.cos(roll_rad)]])
        r = np.linalg.norm(ends, axis=-1, keepdims=True)
        angle = np.arctan(r) if fisheye else r
        seen = focal * ends / r * angle * (1.0 + k1 * angle**2) + rng.normal(0.0, 2e-4, ends.shape)
        inside = (np.abs(seen[..., 0]) < 0.5).all(axis=1) & (seen[..., 1] > -0.28).all(axis=1)
        out.append(seen[inside])
    return out


@given(st.floats(-0.3, 0.05), st.floats(-0.03, 0.03), st.integers(0, 3))
@settings(max_examples=8, deadline=None)
def test_straight_drive_gives_distortion_within_sigma(k1: float, roll_rad: float, seed: int) -> None:
    found = lens_by_vertical_edges(street(FOCAL, k1, roll_rad=roll_rad, seed=seed))
    assert abs(found.bend - k1 / FOCAL**2) < 3.0 * found.bend_sigma
    assert found.bend_sigma < 0.3
    assert found.fisheye_focal is None


@pytest.mark.parametrize("focal", [0.48, 0.42])
def test_fisheye_and_its_focal_length_are_estimated(focal: float) -> None:
    found = lens_by_vertical_edges(street(focal, fisheye=True))
    assert found.fisheye_focal == pytest.approx(focal, rel=WIDE_SIGMA_REL)


def test_narrow_fisheye_is_not_distinguished_from_distorted_pinhole() -> None:
    found = lens_by_vertical_edges(street(0.57, fisheye=True))
    assert found.fisheye_focal is None


def test_too_few_edges_give_no_lens() -> None:
    assert lens_by_vertical_edges([]) is None
    assert lens_by_vertical_edges([edges[:2] for edges in street(FOCAL)]) is None


def test_only_vertical_edges_in_upper_half_are_found() -> None:
    image = np.full((562, WIDTH_PX), 200, np.uint8)
    cv2.line(image, (300, 40), (300, 200), 20, 5)  # vertical
    cv2.line(image, (100, 100), (260, 110), 20, 5)  # horizontal
    cv2.line(image, (500, 60), (650, 200), 20, 5)  # leans too far
    cv2.line(image, (700, 350), (700, 540), 20, 5)  # in the lower half, where vehicles are
    edges = find_vertical_edges(image)
    assert len(edges) >= 2  # both sides of the one
    ends_px = edges * WIDTH_PX + 0.5 * (np.array([WIDTH_PX, 562]) - 1.0)
    assert np.abs(ends_px[..., 0] - 300.0).max() < 6.0
    assert (ends_px[:, 0, 1] < ends_px[:, 1, 1]).all()
    assert np.array_equal(edges, find_vertical_edges(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))
    assert find_vertical_edges(np.full((90, 160), 128, np.uint8)).shape == (0, 2, 2)


def test_fisheye_of_unknown_view_takes_focal_length_from_vertical_edges() -> None:
    view_deg, sigma_rel = FIELD_OF_VIEW_DEG["dashcam"]
    unknown = FocalLength(650.0, sigma_rel, f"that of a dashcam, {view_deg:g} deg across")
    vertical = LensByVerticalEdges(bend=-0.9, bend_sigma=0.1, fisheye_focal=0.45, edges=500)
    found = focal_by_vertical_edges(unknown, vertical, WIDTH_PX)
    assert found.fisheye
    assert found.px == 450.0
    assert found.sigma_rel == WIDE_SIGMA_REL
    assert "fisheye" in found.by
    stated = FocalLength(650.0, 0.03, "as stated, 75 deg across")
    assert focal_by_vertical_edges(stated, vertical, WIDTH_PX) is stated
    assert focal_by_vertical_edges(unknown, None, WIDTH_PX) is unknown


def test_k1_of_edges_and_prior_are_weighted_by_sigma() -> None:
    k1, sigma = k1_by_bend((-0.5, 0.1), FOCAL)
    assert k1 == pytest.approx(-0.5 * FOCAL**2, rel=0.05)
    assert sigma == pytest.approx(0.1 * FOCAL**2, rel=0.05)
    k1, sigma = k1_by_bend((-0.5, 100.0), FOCAL)
    assert abs(k1) < 0.01
    assert sigma == pytest.approx(SIGMA_K1, rel=0.01)
