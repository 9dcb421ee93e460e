"""What later frames show of the road behind a vehicle judges what was said of it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from birdslam.bench.lanes.hidden_cells import HiddenCells
from birdslam.geometry import bev
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lanes import ROAD, LanesConfig
from birdslam.perception import Segmentation

CAMERA = Camera(fx_px=400.0, fy_px=400.0, cx_px=320.0, cy_px=120.0, width_px=640, height_px=240, height_m=1.5)
CONFIG = LanesConfig()
NOBODY = np.zeros((0, 4))


def masks(half_width_m: float) -> Segmentation:
    """A straight road so wide."""
    rows, columns = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px]
    px = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        points = bev.pixel_to_ego(CAMERA, CAMERA.ground, px)
        road = (np.abs(points[:, 1]) < half_width_m).reshape(rows.shape)
    return Segmentation(road, np.zeros_like(road))


class Road:
    """A completion that says road wherever the ego's lane is."""

    def __call__(self, grids: NDArray[np.float32]) -> NDArray[np.float32]:
        out = np.zeros_like(grids)
        middle = grids.shape[2] // 2
        out[ROAD, :, middle - 12 : middle + 12] = 1.0  # 3 m to each side
        return out


@pytest.mark.parametrize("truly_road", [True, False])
def test_the_road_behind_a_car_is_judged_once_it_has_gone(truly_road: bool) -> None:
    cells = HiddenCells(CAMERA, CONFIG, Road())
    car = np.array([[250.0, 60.0, 390.0, 190.0]])  # from 8.6 m on, the ego's lane
    assert cells.add(SE2(), CAMERA.ground, masks(4.0), car) == 0
    assert cells.add(SE2(0.1, 0.0, 0.0), CAMERA.ground, masks(4.0), car) == -1  # the ego has hardly moved
    for k in range(1, 12):
        cells.add(SE2(0.5 * k, 0.0, 0.0), CAMERA.ground, masks(4.0 if truly_road else 0.01), NOBODY)
    report, best = cells.report("toy")
    assert report.frames == 1
    assert report.cells > 100
    assert report.line_iou["network"] is None  # there was none
    found = report.road_iou["network"]
    assert found is not None
    if truly_road:
        assert report.road_iou["seen"] == 0.0
        assert found > 0.7
        assert best is not None
        assert best.look == 0
    else:
        assert found < 0.1
