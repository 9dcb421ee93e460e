"""Segmentation networks with any classes: lists of classes by argmax, scores and logits with a threshold."""

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
