"""The completion of lane grids: an unsuitable file is refused with its reason, and the shipped one completes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from birdslam.lanes.amodal.lanes import BOUNDARY, ROAD, LanesConfig
from birdslam.perception.completion import SHIPPED, GridCompletion
from birdslam.perception.manifest import ModelError
from tests.tiny_networks import echo

SHAPE = LanesConfig().shape


def test_a_network_of_the_right_shape_is_taken(tmp_path: Path) -> None:
    complete = GridCompletion((16, 8), echo(tmp_path / "echo.onnx", (1, 2, 16, 8)))
    grids = np.random.default_rng(0).random((2, 16, 8), dtype=np.float32)
    np.testing.assert_array_equal(complete(grids), grids)


def test_unsuitable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"none\.onnx: the network can't be read"):
        GridCompletion(SHAPE, tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ModelError, match=r"text\.onnx: onnxruntime"):
        GridCompletion(SHAPE, tmp_path / "text.onnx")
    with pytest.raises(ModelError, match=r"inputs have shapes \[\[1, 2, 16, 8\]\], grids need \[1, 2, 128, 128\]"):
        GridCompletion(SHAPE, echo(tmp_path / "small.onnx", (1, 2, 16, 8)))


@pytest.mark.skipif(not SHIPPED.is_file(), reason="built without the lane network")
def test_shipped_network_joins_a_hidden_line() -> None:
    grids = np.zeros((2, *SHAPE), dtype=np.float32)
    grids[ROAD, :92, 44:84] = 1.0  # 10 m wide, seen up to 15 m ahead
    grids[BOUNDARY, :92, 63:65] = 1.0
    hidden = slice(40, 52)  # 3 m of it
    grids[:, hidden, 50:84] = 0.0
    complete = GridCompletion(SHAPE)
    out = complete(grids)
    assert out.shape == grids.shape
    assert out.min() >= 0.0
    assert out.max() <= 1.0
    assert np.mean(out[ROAD, hidden, 50:80] > 0.5) > 0.8
    assert np.mean(out[BOUNDARY, hidden, 62:66].max(axis=1) > 0.5) > 0.8
    assert np.mean(out[BOUNDARY, hidden, 70:80] > 0.5) < 0.05
    np.testing.assert_array_equal(complete(grids), out)
