"""Decoders of box lists: SSD priors, YOLOv8-like and DETR-like exports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.perception import Detections, ModelError, ModelSpec, load_network
from birdslam.perception.decoding.box_lists import BoxListDecoder, SsdDecoder
from birdslam.perception.manifest import BoxList, Input, Ssd, Stretch
from birdslam.perception.views import make_views
from tests import tiny_networks as tiny

INPUT = """
role = "detector"
[input]
name = "images"
width_px = 64
height_px = 32
layout = "NCHW"
colour = "BGR"
resize = { mode = "stretch" }
[detector]
score_threshold = 0.3
nms_iou = 0.5
"""
SSD = (
    INPUT
    + """
decoding = "ssd"
locations = "loc"
scores = "conf"
priors = "priors"
variances = [0.1, 0.1, 0.2, 0.2]
classes = 3
labels = { 1 = "car", 2 = "truck" }
rivals = [["car", "truck"]]
"""
)
LIST = (
    INPUT
    + """
decoding = "boxes"
boxes = "boxes"
classes = 2
labels = { 0 = "car" }
"""
)
IMAGE = np.zeros((64, 256, 3), np.uint8)  # four times as wide as the input, twice as high
STRETCH = Input(name="images", width_px=64, height_px=32, layout="NCHW", colour="BGR", resize=Stretch())
Numbers = dict[str, Any]


def run(tmp_path: Path, text: str, answers: Numbers) -> Detections:
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 32, 64), {k: np.float32(v) for k, v in answers.items()})
    network.with_suffix(".toml").write_text(text)
    found = load_network("detector", ModelSpec(str(network))).run(IMAGE)
    assert found.detections is not None
    return found.detections


def ssd(**changed: Any) -> Numbers:
    """Three priors: one is shifted and narrowed, one is background, one a worse truck where the first comes to be."""
    narrower = 5.0 * np.log(0.8)
    answers: Numbers = {
        "priors": [[0.25, 0.25, 0.5, 0.75], [0.0, 0.0, 0.2, 0.2], [0.5, 0.25, 0.75, 0.75]],
        "loc": [[[10.0, 0.0, narrower, 0.0], [0.0] * 4, [0.0, 0.0, narrower, 0.0]]],
        "conf": [[[0.1, 0.8, 0.1], [0.9, 0.05, 0.05], [0.4, 0.1, 0.5]]],
    }
    return answers | changed


def test_priors_are_shifted_by_their_variances(tmp_path: Path) -> None:
    found = run(tmp_path, SSD, ssd())
    assert found.labels == ("car",)  # the truck is at the same place and its rival
    assert found.scores.tolist() == pytest.approx([0.8])
    # The centre moves by 10 * 0.1 widths of its prior, 0.25; the width is 0.25 * 0.8
    expected = [256 * (0.625 - 0.1), 64 * 0.25, 256 * (0.625 + 0.1), 64 * 0.75]
    assert found.boxes_px[0] == pytest.approx(expected, abs=1e-3)
    apart = run(tmp_path, SSD.replace('rivals = [["car", "truck"]]', ""), ssd())
    assert apart.labels == ("car", "truck")


def test_logits_become_scores(tmp_path: Path) -> None:
    shares = np.array(ssd()["conf"])
    by_softmax = run(tmp_path, SSD + 'scoring = "softmax"\n', ssd(conf=np.log(shares) + 3.0))
    by_sigmoid = run(tmp_path, SSD + 'scoring = "sigmoid"\n', ssd(conf=np.log(shares / (1.0 - shares))))
    for found in (by_softmax, by_sigmoid):
        assert found.scores.tolist() == pytest.approx([0.8], abs=1e-5)


CORNERS = np.array([[8.0, 8.0, 24.0, 16.0], [40.0, 4.0, 56.0, 12.0]])
SCORES = np.array([[0.9, 0.1], [0.2, 0.95]])  # the second one is of a class without a label


def test_all_box_formats_agree(tmp_path: Path) -> None:
    centred = np.hstack([(CORNERS[:, :2] + CORNERS[:, 2:]) / 2.0, CORNERS[:, 2:] - CORNERS[:, :2]])
    shares = (centred / [64.0, 32.0, 64.0, 32.0])[None]
    ways: list[tuple[str, Numbers]] = [
        ('form = "corners"', {"boxes": np.hstack([CORNERS, SCORES])[None]}),
        ("", {"boxes": np.hstack([centred, SCORES])[None]}),
        ('layout = "channels"', {"boxes": np.hstack([centred, SCORES]).T[None]}),  # as YOLOv8
        (
            'unit = "fractions"\nscores = "logits"\nscoring = "sigmoid"',  # as RT-DETR
            {"boxes": shares, "logits": np.log(SCORES / (1.0 - SCORES))[None]},
        ),
    ]
    for text, answers in ways:
        found = run(tmp_path, f"{LIST}{text}\n", answers)
        assert found.labels == ("car",), text
        assert found.scores.tolist() == pytest.approx([0.9], abs=1e-6)
        assert found.boxes_px[0] == pytest.approx(CORNERS[0] * [4.0, 2.0, 4.0, 2.0], abs=1e-3)


@pytest.mark.parametrize(
    ("text", "answers", "said"),
    [
        (SSD, ssd(loc=[[[0.0] * 4] * 2]), r"detector.locations.*loc of shape \(1, 3, 4\)"),
        (SSD.replace("classes = 3", "classes = 4"), ssd(), r"detector.scores.*\(1, 3, 4\)"),
        (SSD, ssd(priors=[[0.0] * 3] * 3), r"detector.priors.*\(N, 4\)"),
        (LIST, {"boxes": np.zeros((1, 5, 7))}, r"detector.boxes.*\(1, N, 6\)"),
        (LIST + 'layout = "channels"\n', {"boxes": np.zeros((1, 7, 5))}, r"detector.boxes.*\(1, 6, N\)"),
        (LIST + 'scores = "s"\n', {"boxes": np.zeros((1, 5, 4)), "s": np.zeros((1, 6, 2))}, "as many as boxes has"),
        (LIST.replace("0 = ", "2 = "), {"boxes": np.zeros((1, 5, 6))}, "class 2 is not one of 2"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(tmp_path: Path, text: str, answers: Numbers, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        run(tmp_path, text, answers)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["none", "sigmoid", "softmax"]))
def test_extreme_numbers_stay_in_bounds(seed: int, scoring: Any) -> None:
    rng, (view,) = np.random.default_rng(seed), make_views(640, 320, STRETCH, None)
    rules: Any = {"classes": 2, "labels": {0: "car"}, "score_threshold": 0.1, "nms_iou": 0.5, "scoring": scoring}
    shapes = {"l": (1, 9, 4), "s": (1, 9, 2), "p": (9, 4), "b": (1, 9, 6)}

    def wild(shape: tuple[int, ...]) -> NDArray[np.float32]:
        return (rng.normal(size=shape) * 10.0 ** rng.integers(0, 30)).astype(np.float32)

    tensors = {name: wild(shape) for name, shape in shapes.items()}
    for decoder in (
        SsdDecoder(Ssd(locations="l", scores="s", priors="p", **rules), STRETCH, shapes),
        BoxListDecoder(BoxList(boxes="b", **rules), STRETCH, shapes),
    ):
        boxes = decoder.merge([decoder.read(tensors, view)], [view]).boxes_px
        assert ((boxes >= 0.0) & (boxes <= [640, 320, 640, 320])).all()
