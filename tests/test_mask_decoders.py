"""Decoders of masks: any classes by argmax or threshold, and lines by row anchors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from birdslam.perception import ModelError, ModelSpec, Segmentation, load_network
from tests import tiny_networks as tiny

MANIFEST = (
    re.sub(r"(width|height)_px = \d+", r"\1_px = 8", tiny.SEGMENTER)
    .replace('"output"', '"classes"')
    .replace("channel = 1", "channel = CHANNEL")
    .replace("channels = 3", "channels = 4")
)


def run(tmp_path: Path, text: str, scores: np.ndarray) -> Segmentation:
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 8, 8), {"classes": scores.astype(np.float32)})
    network.with_suffix(".toml").write_text(text)
    found = load_network("segmenter", ModelSpec(str(network))).run(np.zeros((8, 8, 3), np.uint8))
    assert found.segmentation is not None
    return found.segmentation


def test_list_of_classes_selects_by_argmax(tmp_path: Path) -> None:
    scores = np.random.default_rng(0).normal(size=(1, 4, 8, 8))
    road = run(tmp_path, MANIFEST.replace("CHANNEL", "[0, 3]"), scores).road
    np.testing.assert_array_equal(road, np.isin(scores[0].argmax(axis=0), [0, 3]))
    road = run(tmp_path, MANIFEST.replace("CHANNEL", "2"), scores).road
    np.testing.assert_array_equal(road, scores[0].argmax(axis=0) == 2)


def test_logits_are_compared_with_a_probability(tmp_path: Path) -> None:
    logits = np.random.default_rng(1).normal(size=(1, 4, 8, 8))
    probability = 1.0 / (1.0 + np.exp(-logits[0]))
    text = MANIFEST + 'rule = "above"\nthreshold = 0.7\nsigmoid = true\n'
    road = run(tmp_path, text.replace("CHANNEL", "[1, 2]"), logits).road
    np.testing.assert_array_equal(road, (probability[1] > 0.7) | (probability[2] > 0.7))
    plain = run(tmp_path, text.replace("CHANNEL", "1").replace("sigmoid = true", ""), logits).road
    np.testing.assert_array_equal(plain, logits[0, 1] > 0.7)


@pytest.mark.parametrize(
    ("channel", "more", "named"),
    [
        ("[]", "", "channel must be a channel or a list"),
        ("[1, 1]", "", "channel must be a channel or a list"),
        ("[0, 4]", "", "4 is not one of 4 channels"),
        ("-1", "", "-1 is not one of"),
        ("[0, 1, 2, 3]", "", "argmax"),
        ("0", "sigmoid = true", "sigmoid needs rule"),
        ("0", 'rule = "above"\nsigmoid = true\nthreshold = 1.0', "sigmoid needs rule"),
    ],
)
def test_invalid_list_is_refused(tmp_path: Path, channel: str, more: str, named: str) -> None:
    with pytest.raises(ModelError, match=named.replace("[", r"\[")):
        run(tmp_path, MANIFEST.replace("CHANNEL", channel) + more, np.zeros((1, 4, 8, 8)))


COLUMNS, ROWS = 20, (0.9, 0.75, 0.6, 0.45)
ROW_ANCHORS = f"""
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
    network.with_suffix(".toml").write_text(ROW_ANCHORS)
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
    network.with_suffix(".toml").write_text(ROW_ANCHORS.replace("lines = 2", "lines = 4"))
    with pytest.raises(ModelError, match="lines of shape"):
        load_network("segmenter", ModelSpec(str(network)))
