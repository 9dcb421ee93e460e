"""Crops of vehicles: where a box lies in its window, and what a network's outputs mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.perception.crops import (
    CHANNELS,
    MARGIN_PX,
    MEAN_SIZE_M,
    WINDOW,
    cut_out,
    read_heading,
    read_size_m,
)
from birdslam.perf.perception.vehicle_crops import NETWORK, summary


@given(
    st.integers(-30, 180),
    st.integers(-30, 120),
    st.integers(16, 220),
    st.integers(12, 160),
    st.sampled_from([1.0, 1.25]),
)
def test_a_box_lies_in_the_middle_of_its_window_at_one_scale(x: int, y: int, w: int, h: int, spare: float) -> None:
    image = np.zeros((200, 320, 3), np.uint8)
    image[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] = 255
    window = cut_out(image, np.array([x, y, x + w, y + h], float), spare)
    assert window.shape == (round(WINDOW[1] * spare), round(WINDOW[0] * spare), 3)
    if x <= 2 or y <= 2 or x + w >= 318 or y + h >= 198:
        return  # beyond the border the image repeats itself
    scale = min((WINDOW[0] - 2 * MARGIN_PX) / w, (WINDOW[1] - 2 * MARGIN_PX) / h)
    bright = window[..., 0] / 255.0
    size = np.array([bright.sum(axis=1).max(), bright.sum(axis=0).max()])
    assert size == pytest.approx([w * scale, h * scale], abs=1.5)
    ys, xs = np.mgrid[: window.shape[0], : window.shape[1]] + 0.5
    middle = [(xs * bright).sum() / bright.sum(), (ys * bright).sum() / bright.sum()]
    assert middle == pytest.approx([window.shape[1] / 2, window.shape[0] / 2], abs=0.75)


@given(st.floats(-3.1, 3.1), st.floats(0.5, 100.0), st.floats(0.1, 20.0))
def test_the_heading_is_read_as_it_is_taught(alpha_rad: float, concentration: float, logit: float) -> None:
    out = np.zeros(sum(CHANNELS.values()))
    out[6:8] = concentration * np.array([math.cos(2.0 * alpha_rad), math.sin(2.0 * alpha_rad)])
    out[8:10] = logit * np.array([math.cos(alpha_rad), math.sin(alpha_rad)])
    read_rad, swapped = read_heading(out)
    assert math.remainder(read_rad - alpha_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert swapped == pytest.approx(1.0 / (1.0 + math.exp(logit)))
    assert read_size_m(out) == pytest.approx(MEAN_SIZE_M)


def test_a_summary_counts_a_car_once() -> None:
    off = [0.0, 0.0, math.pi]
    table = np.array([[10.0, angle, 0.0, 0.0, 0.1 * k, 0.0, 0.0, 0.0] for k, angle in enumerate(off)])
    row = summary(table, np.array(["a", "a", "b"]))
    assert (row["sights"], row["cars"]) == (3, 2)
    assert row["height_sd"] == pytest.approx(np.std([0.05, 0.2]), abs=1e-3)
    assert (row["axis_off"], row["swapped"]) == (0.0, pytest.approx(1 / 3, abs=0.01))


def test_the_network_knows_left_from_right() -> None:
    from birdslam.perception.session import plain_session

    session = plain_session(NETWORK.read_bytes(), 1)
    rng = np.random.default_rng(3)
    image = rng.uniform(-1.0, 1.0, (1, 3, WINDOW[1], WINDOW[0])).astype(np.float32)
    (out,) = session.run(None, {"image": np.concatenate([image, image[..., ::-1]])})
    assert out.shape == (2, sum(CHANNELS.values()))
    assert np.isfinite(out).all()
    assert not np.allclose(out[0], out[1])
