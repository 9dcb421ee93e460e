"""Depth by manifest: disparity and metric depth become metres at the image's pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.perception import ModelError, ModelSpec, load_network
from birdslam.perception.decoding.depth import DepthMap
from tests import tiny_networks as tiny

INPUT = tiny.SEGMENTER.partition("[segmenter]")[0].replace("segmenter", "depth")
DISPARITY = INPUT + '[depth]\ndecoding = "disparity"\noutput = "disp"\n'
METRIC = INPUT + '[depth]\ndecoding = "metric"\noutput = "disp"\n'
CAMERA = Camera(width_px=64, height_px=32, fx_px=40.0, fy_px=42.0, cx_px=31.0, cy_px=14.0, height_m=1.5)


def run(tmp_path: Path, text: str, answer: NDArray[np.float32], image_px: tuple[int, int] = (32, 64)) -> DepthMap:
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 16, 32), {"disp": answer})
    network.with_suffix(".toml").write_text(text)
    found = load_network("depth", ModelSpec(str(network))).run(np.zeros((*image_px, 3), np.uint8))
    assert found.depth is not None
    return found.depth


def test_monodepth2_disparity(tmp_path: Path) -> None:
    """Its own layers.disp_to_depth, times the 5.4 of stereo training."""
    disparity = np.linspace(0, 1, 16 * 32, dtype=np.float32).reshape(1, 1, 16, 32)
    depth = run(tmp_path, DISPARITY + "depth_scale = 5.4\nsigma_rel = 0.2\n", disparity)
    np.testing.assert_allclose(depth.depth_m, 5.4 / (1 / 100 + (1 / 0.1 - 1 / 100) * disparity[0, 0]), rtol=1e-5)
    assert (depth.sigma_rel, depth.metric) == (0.2, True)
    assert depth.scale == (0.5, 0.5)
    assert not run(tmp_path, DISPARITY + "metric = false\n", disparity).metric


def test_disparity_out_of_its_range_is_a_bound(tmp_path: Path) -> None:
    text = DISPARITY + "min_depth_m = 0.5\nmax_depth_m = 80.0\n"
    depth = run(tmp_path, text, np.array([-1.0, 2.0], np.float32).reshape(1, 1, 1, 2))
    np.testing.assert_allclose(depth.depth_m, [[80.0, 0.5]], rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 8, 16), (1, 8, 16)])
def test_metric_depth_in_its_unit_and_bounds(tmp_path: Path, shape: tuple[int, ...]) -> None:
    text = METRIC + "metres_per_unit = 0.001\nmin_depth_m = 1.0\nmax_depth_m = 50.0\n"
    values = np.full(shape, 20000.0, np.float32)
    values[..., 0, 0], values[..., 0, 1] = -5.0, 1e9
    depth = run(tmp_path, text, values)
    assert depth.depth_m.shape == (8, 16)
    assert depth.depth_m[0, :3].tolist() == [1.0, 50.0, 20.0]


def test_canonical_depth_is_converted_to_the_camera(tmp_path: Path) -> None:
    """Twice the canonical focal length makes everything appear at half the distance."""
    depth = run(tmp_path, METRIC + "canonical_focal_rel = 0.3125\n", np.full((1, 1, 8, 16), 10.0, np.float32))
    own = depth.in_metres(CAMERA)  # fx / width = 0.625
    np.testing.assert_allclose(own.depth_m, 20.0)
    assert own.in_metres(CAMERA) is own


def test_padding_is_removed(tmp_path: Path) -> None:
    text = METRIC.replace('{ mode = "stretch" }', '{ mode = "fit_pad", align = "centre" }')
    values = np.full((1, 1, 16, 32), 99.0, np.float32)
    values[..., 4:12, :] = 7.0  # position of a 4:1 image in the 2:1 input
    depth = run(tmp_path, text, values, (16, 64))
    assert depth.depth_m.shape == (8, 32)
    np.testing.assert_array_equal(depth.depth_m, 7.0)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (
            DISPARITY + "min_depth_m = 5.0\nmax_depth_m = 2.0\n",
            "max_depth_m = 2.0 must be larger than min_depth_m",
        ),
        (DISPARITY + "max_depth_m = inf\n", "max_depth_m"),
        (METRIC + "metres_per_unit = inf\n", "metres_per_unit"),
        (METRIC + "sigma_rel = 0.0\n", "sigma_rel"),
        (METRIC + "[tiles]\ncolumns = 2\n", "tiles"),
        (METRIC.replace("[depth]", "[segmenter]"), "segmenter"),
    ],
)
def test_a_bad_manifest_is_refused_by_name(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(ModelError, match=named):
        run(tmp_path, text, np.ones((1, 1, 8, 16), np.float32))


def test_network_without_map_output_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"depth\.output.*\(1, 2, 8, 16\)"):
        run(tmp_path, METRIC, np.ones((1, 2, 8, 16), np.float32))


@given(
    st.tuples(st.floats(-20, 90), st.floats(-20, 50), st.floats(0, 60), st.floats(0, 60)),
    st.integers(1, 40),
    st.integers(1, 40),
)
def test_cells_are_those_whose_centres_lie_in_the_box(
    corner: tuple[float, float, float, float], width: int, height: int
) -> None:
    x1, y1, w, h = corner
    depth = DepthMap(np.ones((height, width), np.float32), 64, 32)
    rows, columns = depth.cells((x1, y1, x1 + w, y1 + h))
    xs, ys = (np.arange(width) + 0.5) * 64 / width, (np.arange(height) + 0.5) * 32 / height
    margin = 1e-9  # a centre on the very edge may fall on either side
    inside_x = (xs >= x1 + margin) & (xs < x1 + w - margin)
    inside_y = (ys >= y1 + margin) & (ys < y1 + h - margin)
    chosen_x, chosen_y = np.zeros(width, bool), np.zeros(height, bool)
    chosen_x[columns], chosen_y[rows] = True, True
    assert (chosen_x >= inside_x).all()
    assert (chosen_y >= inside_y).all()
    assert not (chosen_x & ((xs < x1 - margin) | (xs > x1 + w + margin))).any()
    assert not (chosen_y & ((ys < y1 - margin) | (ys > y1 + h + margin))).any()


@given(st.integers(1, 64), st.integers(1, 32), st.floats(0.5, 100.0))
def test_pseudo_lidar_projects_to_its_pixels(width: int, height: int, depth_m: float) -> None:
    depth = DepthMap(np.full((height, width), depth_m, np.float32), 64, 32)
    points = depth.points_cam_m(CAMERA, slice(0, height), slice(0, width))
    px = points[:, :2] / points[:, 2:] * [CAMERA.fx_px, CAMERA.fy_px] + [CAMERA.cx_px, CAMERA.cy_px]
    np.testing.assert_allclose(depth.at(px), depth_m, rtol=1e-6)
    np.testing.assert_allclose(px[0] + 0.5, [32 / width, 16 / height], atol=1e-6)
