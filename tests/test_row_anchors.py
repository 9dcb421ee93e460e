"""Lane lines by rows and columns, as Ultra-Fast-Lane-Detection's exports give them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from birdslam.perception import ModelError, ModelSpec, load_network
from tests import tiny_networks as tiny

COLUMNS, ROWS = 20, (0.9, 0.75, 0.6, 0.45)
MANIFEST = f"""
role = "segmenter"
[input]
name = "images"
width_px = 64
height_px = 32
layout = "NCHW"
colour = "RGB"
resize = {{ mode = "stretch" }}
[segmenter]
decoding = "row_anchors"
output = "lines"
columns = {COLUMNS}
rows = [{", ".join(map(str, ROWS))}]
lines = 2
"""


def answer() -> np.ndarray:
    """Line 0 from column 4 below to column 7.5 above; line 1 in no row but one."""
    logits = np.zeros((1, COLUMNS + 1, len(ROWS), 2), np.float32)
    logits[0, COLUMNS] = 20.0  # not there
    for row, column in enumerate((4.0, 5.0, 6.0, 7.5)):
        low = int(column)
        logits[0, low, row, 0] = 30.0
        if column > low:
            logits[0, low + 1, row, 0] = 30.0  # the mean of two columns
    logits[0, 3, 1, 1] = 30.0
    return logits


def test_lines_are_drawn_where_their_columns_are(tmp_path: Path) -> None:
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 32, 64), {"lines": answer()})
    network.with_suffix(".toml").write_text(MANIFEST)
    found = load_network("segmenter", ModelSpec(str(network))).run(np.zeros((160, 640, 3), np.uint8))
    lane = found.segmentation.lane
    assert not found.segmentation.road.any()
    for row, column in zip(ROWS, (4.0, 5.0, 6.0, 7.5), strict=True):
        xs = np.flatnonzero(lane[min(159, int(row * 160 - 0.5))])
        wanted = (column / (COLUMNS - 1) * 63 + 0.5) * 10.0
        assert len(xs)
        assert abs(xs.mean() - wanted) < 6.0
    assert not lane[: int(0.45 * 160) - 4].any()
    assert not lane[:, 400:].any()  # one point is no line


def test_a_shape_that_the_manifest_does_not_state_is_refused(tmp_path: Path) -> None:
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 32, 64), {"lines": answer()})
    network.with_suffix(".toml").write_text(MANIFEST.replace("lines = 2", "lines = 4"))
    with pytest.raises(ModelError, match="lines of shape"):
        load_network("segmenter", ModelSpec(str(network)))
