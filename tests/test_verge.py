"""Grass is removed from a road mask by its colour in any light; grey images and roads are unchanged."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from birdslam.perception.verge import SHRINK, without_verge

HEIGHT_PX, WIDTH_PX, HORIZON_PX = 180, 320, 60
VERGE_PX = 220  # from this column on
ASPHALT, GRASS = (105.0, 105.0, 105.0), (60.0, 110.0, 80.0)  # blue, green, red


def street(light: tuple[float, float, float] = (1.0, 1.0, 1.0), seed: int = 0) -> NDArray[np.uint8]:
    """A road with noise and a verge at its right, seen in a light of some brightness and colour."""
    image = np.empty((HEIGHT_PX, WIDTH_PX, 3))
    image[:, :VERGE_PX], image[:, VERGE_PX:] = ASPHALT, GRASS
    image = image * light + np.random.default_rng(seed).normal(0.0, 6.0, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def mask(right_px: int = WIDTH_PX) -> NDArray[np.bool_]:
    road = np.zeros((HEIGHT_PX, WIDTH_PX), np.bool_)
    road[HORIZON_PX:, 40:right_px] = True
    return road


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.4, 0.4, 0.4), (1.3, 1.0, 0.85), (0.8, 1.1, 1.0)])
def test_only_the_verge_is_removed_in_any_light(light: tuple[float, float, float]) -> None:
    left = without_verge(mask(), street(light))
    assert left[:, : VERGE_PX - SHRINK].sum() == mask(VERGE_PX - SHRINK).sum()
    assert not left[:, VERGE_PX + SHRINK :].any()


def test_road_without_verge_is_unchanged() -> None:
    road = mask(VERGE_PX - SHRINK)
    assert (without_verge(road, street()) == road).all()


def test_grey_and_night_images_are_unchanged() -> None:
    grey = cv2.cvtColor(street(), cv2.COLOR_BGR2GRAY)
    assert (without_verge(mask(), grey) == mask()).all()
    assert (without_verge(mask(), street((0.1, 0.1, 0.1))) == mask()).all()


def test_red_bricks_do_not_affect_grey_road() -> None:
    image, road = street(), mask(VERGE_PX - SHRINK)
    image[HORIZON_PX:, :130] = (60, 60, 110)
    assert (without_verge(road, image) == road).all()


def test_leaf_on_the_road_is_not_a_verge() -> None:
    image, road = street(), mask(VERGE_PX - SHRINK)
    image[HORIZON_PX + 40 : HORIZON_PX + 44, 100:104] = GRASS
    assert (without_verge(road, image) == road).all()


@settings(max_examples=50)
@given(st.integers(1, 40), st.integers(1, 40), st.data())
def test_mask_only_shrinks_for_any_image(height_px: int, width_px: int, data: st.DataObject) -> None:
    image = data.draw(hnp.arrays(np.uint8, (height_px, width_px, 3)))
    road = data.draw(hnp.arrays(np.bool_, (height_px, width_px)))
    before = road.copy()
    left = without_verge(road, image)
    assert left.shape == road.shape
    assert left.dtype == np.bool_
    assert not (left & ~before).any()
    assert (road == before).all()
