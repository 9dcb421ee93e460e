"""Decoders of boxes: SSD priors, YOLOv8-like and DETR-like exports, CenterNet."""

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
from birdslam.perception.decoding.centernet import CenterNetDecoder
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.perception.manifest import BoxList, CenterNet, FitPad, Input, Ssd, Stretch, Tiles
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


MANIFEST = """
role = "detector"
[input]
name = "images"
width_px = 64
height_px = 32
layout = "NCHW"
colour = "BGR"
resize = { mode = "stretch" }
[detector]
decoding = "centernet"
heat_map = "hm"
sizes = "wh"
offsets = "reg"
heat = "logits"
classes = 3
score_threshold = 0.3
labels = { 0 = "car", 2 = "truck" }
rivals = [["car", "truck"]]
"""
CELLS = (8, 16)  # of 4 px


def maps(objects: list[tuple[int, tuple[float, float, float, float], float]]) -> dict[str, NDArray[np.float32]]:
    """Outputs that encode class, box in input pixels, score."""
    heat = np.full((1, 3, *CELLS), -9.0, np.float32)
    sizes, offsets = np.zeros((1, 2, *CELLS), np.float32), np.zeros((1, 2, *CELLS), np.float32)
    for index, (x1, y1, x2, y2), score in objects:
        x, y = (x1 + x2) / 8.0, (y1 + y2) / 8.0
        row, column = int(y), int(x)
        heat[0, index, row, column] = np.log(score / (1.0 - score))
        heat[0, index, row, max(column - 1, 0)] = np.log(score / (1.0 - score)) - 0.5  # its foothills
        sizes[0, :, row, column] = (x2 - x1) / 4.0, (y2 - y1) / 4.0
        offsets[0, :, row, column] = x - column, y - row
    return {"hm": heat, "wh": sizes, "reg": offsets}


def load(tmp_path: Path, text: str, answers: dict[str, NDArray[np.float32]]):
    network = tiny.constants(tmp_path / "net.onnx", (1, 3, 32, 64), answers)
    network.with_suffix(".toml").write_text(text)
    return load_network("detector", ModelSpec(str(network)))


def test_peaks_are_boxes_of_the_image_best_first(tmp_path: Path) -> None:
    objects = [
        (0, (8.0, 8.0, 20.0, 16.0), 0.6),
        (2, (30.0, 10.0, 50.0, 30.0), 0.9),
        (1, (2.0, 20.0, 10.0, 30.0), 0.9),  # of a class without label
        (0, (40.0, 2.0, 44.0, 6.0), 0.2),  # below the threshold
        (2, (8.0, 8.0, 20.0, 16.0), 0.4),  # on the first car: a rival
    ]
    found = load(tmp_path, MANIFEST, maps(objects)).run(np.zeros((64, 256, 3), np.uint8))
    assert found.detections.labels == ("truck", "car")
    np.testing.assert_allclose(found.detections.scores, [0.9, 0.6], atol=1e-6)
    np.testing.assert_allclose(found.detections.boxes_px, [[120, 20, 200, 60], [32, 16, 80, 32]], atol=1e-4)


def test_scores_sizes_in_pixels_and_no_offsets(tmp_path: Path) -> None:
    text = MANIFEST.replace('heat = "logits"', 'heat = "scores"\nsize_unit = "pixels"').replace('offsets = "reg"\n', "")
    answers = maps([(0, (8.0, 8.0, 24.0, 16.0), 0.6)])
    answers["hm"] = 1.0 / (1.0 + np.exp(-answers["hm"]))
    answers["wh"] *= 4.0
    found = load(tmp_path, text, answers).run(np.zeros((32, 64, 3), np.uint8))
    np.testing.assert_allclose(found.detections.boxes_px, [[8, 8, 24, 16]], atol=1e-4)


def test_an_object_in_two_tiles_is_one() -> None:
    table = CenterNet(
        heat_map="hm", sizes="wh", offsets="reg", heat="logits", classes=3, labels={0: "car"}, score_threshold=0.3
    )
    fit = Input(name="i", width_px=64, height_px=32, layout="NCHW", colour="BGR", resize=FitPad())
    decoder = CenterNetDecoder(table, fit, {k: v.shape for k, v in maps([]).items()})
    views = make_views(128, 32, fit, Tiles(columns=3, overlap=0.5))
    box = np.array([[50.0, 10.0, 62.0, 20.0]])  # in the overlap of the first two
    parts = []
    for view in views:
        inside = view.x0_px <= box[0, 0] and box[0, 2] <= view.x1_px
        seen = tuple(view.to_network(box)[0].tolist())
        parts.append(decoder.read(maps([(0, seen, 0.8)] if inside else []), view))
    assert sum(len(part.scores) for part in parts) == 2
    found = decoder.merge(parts, views)
    np.testing.assert_allclose(found.boxes_px, box, atol=1e-4)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"hm": np.zeros((1, 2, *CELLS), np.float32)}, ["detector.classes", "3", "2 in hm"]),
        ({"hm": np.zeros((3, *CELLS), np.float32)}, ["detector.heat_map", "(1, classes, h, w)"]),
        ({"wh": np.zeros((1, 2, 4, 8), np.float32)}, ["detector.sizes", "(1, 2, 8, 16)", "(1, 2, 4, 8)"]),
        ({"reg": np.zeros((1, 1, *CELLS), np.float32)}, ["detector.offsets", "(1, 1, 8, 16)"]),
    ],
)
def test_a_network_of_another_shape_is_refused(
    tmp_path: Path, changed: dict[str, NDArray[np.float32]], named: list[str]
) -> None:
    with pytest.raises(ModelError) as caught:
        load(tmp_path, MANIFEST, {**maps([]), **changed})
    for part in named:
        assert part in str(caught.value)


def test_a_class_without_a_channel_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="class 3 is not one of 3"):
        load(tmp_path, MANIFEST.replace("2 = ", "3 = "), maps([]))


def test_extreme_maps_stay_in_bounds() -> None:
    table = CenterNet(heat_map="hm", sizes="wh", heat="logits", classes=3, labels={0: "car"}, score_threshold=0.1)
    stretch = Input(name="i", width_px=64, height_px=32, layout="NCHW", colour="BGR", resize=Stretch())
    shapes = {k: v.shape for k, v in maps([]).items()}
    (view,) = make_views(640, 320, stretch, None)
    rng = np.random.default_rng(3)
    tensors = {k: (rng.normal(size=s) * 1e9).astype(np.float32) for k, s in shapes.items()}
    decoder = CenterNetDecoder(table, stretch, shapes)
    boxes = decoder.merge([decoder.read(tensors, view)], [view]).boxes_px
    assert len(boxes)
    assert (boxes >= 0).all()
    assert (boxes <= [640, 320, 640, 320]).all()


def test_manifest_states_the_sigma_of_edges(tmp_path: Path) -> None:
    image, objects = np.zeros((64, 256, 3), np.uint8), [(0, (8.0, 8.0, 20.0, 16.0), 0.6)]
    assert load(tmp_path, MANIFEST, maps(objects)).run(image).detections.edge_sigma is None
    said = MANIFEST + "box_sigma = { rel = 0.1, px = 1.5 }\n"
    found = load(tmp_path, said, maps(objects)).run(image).detections
    # The image is four times as wide as the input, and twice as high: to be safe the larger pixel counts
    assert found.edge_sigma == EdgeSigma((0.1,) * 4, 1.5 * 4)
    assert found.only(("car",)).edge_sigma == found.edge_sigma
    by_edge = MANIFEST + "box_sigma = { rel = 0.1, px = 1.5, upper = 0.05, lower = 0.02 }\n"
    assert load(tmp_path, by_edge, maps(objects)).run(image).detections.edge_sigma.rel == (0.1, 0.1, 0.05, 0.02)
    with pytest.raises(ModelError, match=r"px.*\$\.detector\.box_sigma"):
        load(tmp_path, MANIFEST + "box_sigma = { rel = 0.1 }\n", maps(objects))


def test_edges_that_are_drawn_inside_are_moved_out(tmp_path: Path) -> None:
    image = np.zeros((64, 256, 3), np.uint8)
    objects = [(0, (8.0, 8.0, 20.0, 16.0), 0.6), (0, (40.0, 16.0, 60.0, 32.0), 0.5)]  # the second is cut at the bottom
    plain = load(tmp_path, MANIFEST, maps(objects)).run(image).detections.boxes_px
    inside = "drawn_inside = { left = 0.1, right = -0.05, upper = 0.25, lower = 0.125 }\n"
    (whole, cut) = load(tmp_path, MANIFEST + inside, maps(objects)).run(image).detections.boxes_px
    width, height = plain[0, 2:] - plain[0, :2]
    moves = [-0.1 * width, -0.25 * height, -0.05 * width, 0.125 * height]
    np.testing.assert_allclose(whole, plain[0] + moves)
    assert cut[3] == 64.0
    assert cut[1] < plain[1, 1]
    with pytest.raises(ModelError, match=r"drawn_inside"):
        load(tmp_path, MANIFEST + "drawn_inside = { lower = 0.5 }\n", maps(objects))
