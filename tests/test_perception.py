"""Perception: laws of views, decoding and merging, the schedule of heads, and real networks on real frames."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.perception import Detections, Findings, ModelSpec, Networks, Perception, Ready, Segmentation, load_network
from birdslam.perception.decoding.detection import MAX_CANDIDATES, YoloxDecoder, intersections, suppress
from birdslam.perception.manifest import SHIPPED_NETWORKS, FitPad, Input, Schedule, Stretch, Tiles, Yolox
from birdslam.perception.network import Network
from birdslam.perception.views import Preparation, View, make_views
from birdslam.types import Status
from tests import tiny_networks as tiny

SIZE_PX = 128
STRIDES = (8, 16, 32)
CELLS = sum((SIZE_PX // s) ** 2 for s in STRIDES)
TABLE = Yolox(
    output="output",
    strides=STRIDES,
    classes=4,
    labels={0: "car", 1: "truck", 2: "person"},
    score_threshold=0.3,
    nms_iou=0.5,
    rivals=(("car", "truck"),),
)


def square_input(**changes: Any) -> Input:
    said: dict[str, Any] = {"layout": "NCHW", "colour": "BGR", "resize": FitPad()} | changes
    return Input(name="images", width_px=SIZE_PX, height_px=SIZE_PX, **said)


def decoder() -> YoloxDecoder:
    return YoloxDecoder(TABLE, square_input(), {"output": (1, CELLS, 9)})


def encode(boxes_px: NDArray[np.float64], classes: Sequence[int], scores: Any) -> dict[str, NDArray[np.float32]]:
    """The YOLOX output for boxes (N, 4) of the input, one per cell."""
    raw = np.zeros((CELLS, 9), np.float32)
    first = np.cumsum([0, *[(SIZE_PX // s) ** 2 for s in STRIDES]])
    for index, (box, label, score) in enumerate(zip(boxes_px, classes, scores, strict=True)):
        level = index % len(STRIDES)
        stride, across = STRIDES[level], SIZE_PX // STRIDES[level]
        row = int(first[level]) + index // len(STRIDES) * 7 % across**2
        cell = np.array([(row - first[level]) % across, (row - first[level]) // across])
        raw[row, :2] = (box[:2] + box[2:]) / 2 / stride - cell
        raw[row, 2:4] = np.log((box[2:] - box[:2]) / stride)
        raw[row, 4] = 1.0
        raw[row, 5 + label] = score
    return {"output": raw[None]}


@st.composite
def boxes_in(draw: st.DrawFn, width_px: float, height_px: float, least_px: float = 4.0) -> NDArray[np.float64]:
    w = draw(st.floats(least_px, width_px))
    h = draw(st.floats(least_px, height_px))
    x = draw(st.floats(0, width_px - w))
    y = draw(st.floats(0, height_px - h))
    return np.array([x, y, x + w, y + h])


image_sizes = st.tuples(st.integers(16, 2000), st.integers(16, 1200))
resizes = st.sampled_from([Stretch(), FitPad(), FitPad(align="centre")])
tilings = st.none() | st.builds(Tiles, columns=st.integers(1, 6), overlap=st.floats(0.0, 0.8))


# --- views


@given(image_sizes, resizes, tilings, st.data())
def test_box_round_trips_through_network_pixels(
    size: tuple[int, int], resize: Stretch | FitPad, tiles: Tiles | None, data: st.DataObject
) -> None:
    width_px, height_px = size
    box = data.draw(boxes_in(width_px, height_px))[None]
    for view in make_views(width_px, height_px, square_input(resize=resize), tiles):
        np.testing.assert_allclose(view.to_image(view.to_network(box)), box, atol=1e-8)


@given(image_sizes, resizes, tilings)
def test_views_cover_the_image_within_the_input(
    size: tuple[int, int], resize: Stretch | FitPad, tiles: Tiles | None
) -> None:
    width_px, height_px = size
    views = make_views(width_px, height_px, square_input(resize=resize), tiles)
    assert len(views) <= (tiles.columns if tiles else 1)
    assert views[0].x0_px == 0
    assert views[-1].x1_px == width_px
    for a, b in pairwise(views):
        assert a.x1_px - b.x0_px >= tiles.overlap * (a.x1_px - a.x0_px) - 2.0  # whole pixels
        assert a.x1_px - a.x0_px == b.x1_px - b.x0_px
    for view in views:
        corners = view.to_network(np.array([[view.x0_px, 0, view.x1_px, height_px]], dtype=float))[0]
        assert corners.min() >= 0.0
        assert corners.max() <= SIZE_PX
        if isinstance(resize, FitPad):  # the aspect is kept to a pixel
            ratio = view.ratio
            assert abs(ratio[0] - ratio[1]) <= 1.0 / min(view.x1_px - view.x0_px, height_px)


def test_tiles_are_not_more_than_useful() -> None:
    count = {w: len(make_views(w, 376, square_input(), Tiles(columns=3, overlap=0.2))) for w in (300, 376, 640, 1241)}
    assert count == {300: 1, 376: 1, 640: 2, 1241: 3}


@given(st.sampled_from(["RGB", "BGR"]), st.sampled_from(["NCHW", "NHWC"]), st.booleans(), st.integers(0, 2**32 - 1))
def test_the_input_is_the_manifests_arithmetic(colour: str, layout: str, grey: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, std = tuple(rng.uniform(-1, 1, 3)), tuple(rng.uniform(0.5, 2, 3))
    entry = square_input(colour=colour, layout=layout, scale=1 / 255, mean=mean, std=std, resize=FitPad(pad_value=7))
    preparation = Preparation(entry)
    for height_px in (SIZE_PX // 2, SIZE_PX):  # the padding is painted again where the size changes
        image = rng.integers(0, 256, (height_px, SIZE_PX) if grey else (height_px, SIZE_PX, 3), dtype=np.uint8)
        (view,) = make_views(SIZE_PX, height_px, entry, None)
        preparation.fill(image, view)
        expected = np.full((SIZE_PX, SIZE_PX, 3), 7.0)
        expected[:height_px] = image[..., None] if grey else image[..., :: 1 if colour == "BGR" else -1]
        expected = (expected / 255 - mean) / std
        got = preparation.tensor[0] if layout == "NHWC" else np.moveaxis(preparation.tensor[0], 0, -1)
        np.testing.assert_allclose(got, expected, atol=1e-5)


# --- detection


@given(image_sizes, st.integers(0, 2), st.floats(0.35, 1.0), st.data())
def test_an_encoded_box_is_decoded(size: tuple[int, int], label: int, score: float, data: st.DataObject) -> None:
    reader = decoder()
    (view,) = make_views(*size, square_input(), None)
    box = data.draw(boxes_in(*size))
    assume(np.all(view.to_network(box[None])[0].reshape(2, 2)[1] - view.to_network(box[None])[0][:2] > 0.05))
    found = reader.merge([reader.read(encode(view.to_network(box[None]), [label], [score]), view)], [view])
    assert found.labels == (TABLE.labels[label],)
    np.testing.assert_allclose(found.boxes_px[0], box, atol=2e-6 * max(size) * 8)
    assert found.scores[0] == pytest.approx(score)


def test_only_labelled_classes_above_the_threshold_are_reported() -> None:
    reader = decoder()
    view = View(SIZE_PX, SIZE_PX, 0, SIZE_PX, 0, 0, SIZE_PX, SIZE_PX)
    boxes = np.array([[0, 0, 20, 20], [40, 0, 60, 20], [80, 0, 100, 20]], dtype=float)
    tensors = encode(boxes, [0, 3, 2], [0.29, 0.9, 0.31])
    found = reader.merge([reader.read(tensors, view)], [view])
    assert found.labels == ("person",)


def test_candidates_are_bounded() -> None:
    reader = decoder()
    view = View(SIZE_PX, SIZE_PX, 0, SIZE_PX, 0, 0, SIZE_PX, SIZE_PX)
    raw = np.zeros((1, 3549, 9), np.float32)
    raw[..., 2:4], raw[..., 4:6] = -9.0, 1.0  # a tiny car in every cell
    found = reader.merge([reader.read({"output": raw[:, :CELLS]}, view)] * 3, [view] * 3)
    assert len(found) <= 3 * MAX_CANDIDATES
    raw[..., 2:4] = 200.0  # sizes beyond all numbers
    huge = reader.merge([reader.read({"output": raw[:, :CELLS]}, view)], [view])
    assert np.all(np.isfinite(huge.boxes_px))


def iou(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    shared = intersections(boxes)
    area = np.diagonal(shared)
    out: NDArray[np.float64] = shared / (area[:, None] + area[None, :] - shared)
    return out


@given(st.lists(boxes_in(200.0, 100.0), min_size=1, max_size=12), st.integers(0, 2**32 - 1))
def test_nms_keeps_the_best_box_in_any_order(boxes_list: list[NDArray[np.float64]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes, n = np.array(boxes_list), len(boxes_list)
    scores, groups, whole = rng.permutation(n) / n, rng.integers(0, 2, n), np.zeros((n, 2), bool)
    kept = suppress(boxes, scores, groups, whole, 0.5)
    rivals = (iou(boxes) > 0.5) & (groups[:, None] == groups[None, :])
    assert not np.any(rivals[np.ix_(kept, kept)] & ~np.eye(len(kept), dtype=bool))
    for lost in set(range(n)) - set(kept.tolist()):
        assert any(rivals[lost, k] and scores[k] > scores[lost] for k in kept)
    order = rng.permutation(n)
    again = suppress(boxes[order], scores[order], groups[order], whole, 0.5)
    assert order[again].tolist() == kept.tolist()


def test_rivals_suppress_each_other_and_others_do_not() -> None:
    reader = decoder()
    view = View(SIZE_PX, SIZE_PX, 0, SIZE_PX, 0, 0, SIZE_PX, SIZE_PX)
    boxes = np.array([[10, 10, 60, 60]] * 3, dtype=float)
    found = reader.merge([reader.read(encode(boxes, [0, 1, 2], [0.5, 0.9, 0.8]), view)], [view])
    assert found.labels == ("truck", "person")
    assert found.scores.tolist() == sorted(found.scores, reverse=True)


WIDE = (1240, 376)


def seen_on_tiles(objects: NDArray[np.float64], tiles: Tiles, scores: Any) -> Detections:
    """Detections of an ideal detector, which sees in each tile the part of the object inside it."""
    reader, entry = decoder(), square_input()
    views = make_views(*WIDE, entry, tiles)
    parts = []
    for view in views:
        clipped = objects.copy()
        clipped[:, 0::2] = np.clip(objects[:, 0::2], view.x0_px, view.x1_px)
        visible = clipped[:, 2] - clipped[:, 0] > 4.0
        chosen = clipped[visible]
        parts.append(reader.read(encode(view.to_network(chosen), [0] * len(chosen), np.array(scores)[visible]), view))
    return reader.merge(parts, views)


@given(boxes_in(*WIDE, 12.0), st.integers(2, 4), st.sampled_from([0.1, 0.2, 0.45]))
def test_object_across_tiles_is_one_box(box: NDArray[np.float64], columns: int, overlap: float) -> None:
    found = seen_on_tiles(box[None], Tiles(columns=columns, overlap=overlap), [0.9])
    assert len(found) == 1
    np.testing.assert_allclose(found.boxes_px[0], box, atol=0.1)


@given(st.lists(boxes_in(WIDE[0], 70.0, 12.0), min_size=2, max_size=5), st.integers(0, 2**32 - 1))
def test_vertically_separate_objects_are_not_joined(objects: list[NDArray[np.float64]], seed: int) -> None:
    boxes = np.array([np.add(box, [0, 75 * i, 0, 75 * i]) for i, box in enumerate(objects)])
    found = seen_on_tiles(
        boxes, Tiles(columns=3, overlap=0.2), np.random.default_rng(seed).uniform(0.4, 1.0, len(boxes))
    )
    np.testing.assert_allclose(found.boxes_px[np.argsort(found.boxes_px[:, 1])], boxes, atol=0.1)


@given(st.lists(st.integers(20, 300), min_size=2, max_size=8), st.floats(1.0, 30.0), st.integers(0, 2**32 - 1))
def test_horizontally_separate_objects_are_not_joined(widths: list[int], gap_px: float, seed: int) -> None:
    left = np.cumsum([0.0, *[w + gap_px for w in widths]])
    boxes = np.array([[x, 150, x + w, 220] for x, w in zip(left[:-1], widths, strict=True) if x + w <= WIDE[0]])
    found = seen_on_tiles(
        boxes, Tiles(columns=3, overlap=0.2), np.random.default_rng(seed).uniform(0.4, 1.0, len(boxes))
    )
    np.testing.assert_allclose(found.boxes_px[np.argsort(found.boxes_px[:, 0])], boxes, atol=0.1)


def test_cut_box_yields_to_the_whole_one() -> None:
    reader = decoder()
    views = make_views(*WIDE, square_input(), Tiles(columns=2, overlap=0.2))
    edge_px = views[0].x1_px
    whole = np.array([[edge_px - 60.0, 100, edge_px + 60.0, 180]])
    part = np.array([[edge_px - 58.0, 102, edge_px, 182]])
    parts = [
        reader.read(encode(view.to_network(box), [0], [score]), view)
        for view, box, score in zip(views, (part, whole), (0.95, 0.4), strict=True)
    ]
    found = reader.merge(parts, views)
    np.testing.assert_allclose(found.boxes_px, whole, atol=0.1)


# --- networks made here

DETECTOR = tiny.DETECTOR.replace("_px = 64", f"_px = {SIZE_PX}").replace("classes = 2", "classes = 4")

SEGMENTER = """
role = "segmenter"
[input]
name = "images"
width_px = 64
height_px = 64
layout = "NCHW"
colour = "BGR"
resize = { mode = "fit_pad", pad_value = 255, align = "centre" }
[segmenter]
decoding = "class_maps"
[[segmenter.maps]]
meaning = "road"
output = "output"
channel = 1
channels = 3
[[segmenter.maps]]
meaning = "lane"
output = "more"
channel = 2
channels = 3
rule = "above"
threshold = 99.5
"""


def write(network: Path, manifest: str) -> ModelSpec:
    network.with_suffix(".toml").write_text(manifest)
    return ModelSpec(str(network))


def test_masks_follow_their_class(tmp_path: Path) -> None:
    """The network echoes its input, so that colours are classes: green is road, red above the threshold is a lane."""
    spec = write(tiny.echo(tmp_path / "a.onnx", (1, 3, 64, 64), outputs=("output", "more")), SEGMENTER)
    image = np.zeros((100, 400, 3), np.uint8)
    image[60:, 100:300] = (0, 200, 50)
    image[60:, 180:220] = (0, 200, 150)
    findings = load_network("segmenter", spec).run(image)
    masks = findings.segmentation
    assert isinstance(masks, Segmentation)
    assert masks.road.shape == masks.lane.shape == (100, 400)
    expected_road, expected_lane = image[..., 1] > 0, image[..., 2] > 100
    for mask, expected in ((masks.road, expected_road), (masks.lane, expected_lane)):
        assert np.sum(mask & expected) / np.sum(mask | expected) > 0.85  # an input pixel is 6 of the image
    assert findings.detections is None


@pytest.mark.parametrize("shape", [(376, 1241), (376, 1241, 3), (16, 16), (1080, 1920, 3)])
def test_images_of_any_size(tmp_path: Path, shape: tuple[int, ...]) -> None:
    answer = encode(np.array([[32.0, 8.0, 96.0, 24.0]]), [0], [0.8])["output"]
    network = load_network(
        "detector", write(tiny.constant(tmp_path / "a.onnx", (1, 3, SIZE_PX, SIZE_PX), answer), DETECTOR)
    )
    findings = network.run(np.full(shape, 90, np.uint8))
    assert findings.detections.labels == ("car",)
    (view,) = network.views(np.zeros(shape, np.uint8))
    np.testing.assert_allclose(view.to_network(findings.detections.boxes_px)[0][[0, 2]], [32, 96], atol=1e-3)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4), np.float32), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4), np.uint8)]
)
def test_invalid_image_is_refused(tmp_path: Path, image: NDArray[Any]) -> None:
    network = load_network(
        "segmenter", write(tiny.echo(tmp_path / "a.onnx", (1, 3, 64, 64), outputs=("output", "more")), SEGMENTER)
    )
    with pytest.raises(ValueError, match="segmenter"):
        network.run(image)


def test_non_finite_output_is_a_status_and_carries_the_last_result(tmp_path: Path) -> None:
    answer = encode(np.array([[32.0, 8.0, 96.0, 24.0]]), [0], [0.8])["output"]
    spec = write(tiny.constant(tmp_path / "a.onnx", (1, 3, SIZE_PX, SIZE_PX), answer), DETECTOR)
    white, black = np.full((60, 80), 255, np.uint8), np.zeros((60, 80), np.uint8)
    black_pad = DETECTOR.replace('"fit_pad"', '"fit_pad", pad_value = 0')
    with ThreadPoolExecutor(1) as pool:
        networks = Networks([load_network("detector", write(Path(spec.path), black_pad))], pool.submit)
        first = networks.start(0, white).result()
        failed = networks.start(1, black).result()
        again = networks.start(2, white).result()
    assert first.status == ()
    assert failed.status == (Status.NETWORK_FAILED, Status.DETECTIONS_CARRIED)
    assert failed.detections is first.detections
    assert failed.ages == {"detector": 1}
    assert again.status == ()
    assert again.ages == {"detector": 0}


# --- schedule


@dataclass
class FakeHead:
    name: str = "detector"
    role: Any = "detector"
    schedule: Schedule = field(default_factory=Schedule)
    fell_back: str = ""

    def run(self, image: NDArray[np.uint8]) -> Findings | None:
        raise AssertionError("the fake executor answers for it")


class Executor:
    """Runs nothing; the test finishes each run by hand."""

    def __init__(self) -> None:
        self.runs: list[tuple[Any, Any, Future[Any]]] = []

    def submit(self, run: Any, image: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        self.runs.append((run, image, future))
        return future

    def finish(self, result: Any = None) -> None:
        self.runs[-1][2].set_result(result)


def some(score: float) -> Findings:
    return Findings(detections=Detections(np.zeros((1, 4)), np.array([score]), ("car",)))


def step(networks: Networks, executor: Executor, frame_id: int, finish: bool = True) -> Perception:
    pending = networks.start(frame_id, IMAGE)
    if finish and executor.runs and not executor.runs[-1][2].done():
        executor.finish(some(frame_id / 1000))
    return pending.result()


IMAGE = np.zeros((2, 2), np.uint8)


@given(st.integers(1, 5), st.lists(st.integers(1, 4), min_size=1, max_size=30))
def test_dropped_frames_do_not_starve_a_head(every: int, gaps: list[int]) -> None:
    executor = Executor()
    networks = Networks([FakeHead(schedule=Schedule(every=every))], executor.submit)
    frames = np.cumsum([0, *gaps]).tolist()
    started = None
    for frame_id in frames:
        before = len(executor.runs)
        perception = step(networks, executor, frame_id)
        runs = len(executor.runs) - before
        due = started is None or frame_id - started >= every
        assert runs == due
        started = frame_id if due else started
        assert perception.ages == {"detector": frame_id - started}
        assert perception.detections.scores[0] == started / 1000
        assert perception.status == (() if due else (Status.DETECTIONS_CARRIED,))


def test_a_late_head_is_carried_with_its_age_and_never_run_twice_at_once() -> None:
    executor = Executor()
    networks = Networks([FakeHead()], executor.submit, patience_s=0.0)
    nothing = step(networks, executor, 0, finish=False)
    assert (nothing.detections, nothing.ages, nothing.status) == (None, {}, (Status.DETECTIONS_CARRIED,))
    step(networks, executor, 1, finish=False)
    assert len(executor.runs) == 1
    executor.finish(some(0.5))
    late = networks.start(2, IMAGE).result()  # collected on frame 2, computed on frame 0; frame 2 starts none
    assert late.ages == {"detector": 2}
    assert late.detections is not None
    assert late.status == (Status.DETECTIONS_CARRIED,)
    now = step(networks, executor, 3)
    assert len(executor.runs) == 2
    assert now.ages == {"detector": 0}
    assert now.status == ()


def test_unawaited_head_is_awaited_without_patience_limit() -> None:
    lazy = FakeHead("segmenter", "segmenter", Schedule(awaited=False))
    executor = Executor()
    networks = Networks([lazy, FakeHead()], executor.submit, patience_s=30.0)
    pending = networks.start(0, IMAGE)
    executor.finish(some(0.1))
    perception = pending.result()  # comes at once: only the detector is awaited
    assert perception.ages == {"detector": 0}
    assert perception.status == (Status.SEGMENTATION_CARRIED,)

    with ThreadPoolExecutor(2) as pool:
        heads = [FakeHead("segmenter", "segmenter", Schedule(awaited=False)), FakeHead()]
        for head in heads:
            head.run = lambda image: some(0.2)
        assert Networks(heads, pool.submit).start(5, IMAGE).result().ages == {"segmenter": 0, "detector": 0}


def test_a_bug_in_a_head_surfaces() -> None:
    executor = Executor()
    networks = Networks([FakeHead()], executor.submit, patience_s=0.0)
    networks.start(0, IMAGE).result()
    executor.runs[-1][2].set_exception(ZeroDivisionError("bug"))
    with pytest.raises(ZeroDivisionError, match="bug"):
        networks.start(1, IMAGE).result()


def test_a_frame_without_pixels_starts_nothing_and_carries() -> None:
    executor = Executor()
    networks = Networks([FakeHead()], executor.submit)
    step(networks, executor, 0)
    blind = networks.start(1, None).result()
    assert len(executor.runs) == 1
    assert blind.ages == {"detector": 1}
    assert blind.status == (Status.DETECTIONS_CARRIED,)


def test_restarted_source_discards_old_results() -> None:
    executor = Executor()
    networks = Networks([FakeHead()], executor.submit, patience_s=0.0)
    step(networks, executor, 7)
    networks.start(8, IMAGE).result()  # still under way when the source restarts
    fresh = networks.start(0, IMAGE).result()
    assert (fresh.detections, fresh.ages) == (None, {})
    executor.finish(some(0.8))
    assert networks.start(1, IMAGE).result().ages == {}  # the old run is thrown away
    assert step(networks, executor, 2).ages == {"detector": 0}


@given(st.integers(1, 3), st.integers(1, 4), st.lists(st.integers(1, 3), min_size=1, max_size=20))
def test_masks_come_every_nth_run(slowdown: int, masks: int, gaps: list[int]) -> None:
    executor, alone = Executor(), object()
    head = FakeHead("multitask", "multitask")
    networks = Networks([head], executor.submit, boxes_alone=alone)
    networks.slowdown, networks.masks_every = slowdown, masks
    looks: list[int] = []
    for frame_id in np.cumsum([0, *gaps]).tolist():
        pending = networks.start(frame_id, IMAGE)
        if len(executor.runs) > len(looks):
            whole = len(looks) % masks == 0
            assert (executor.runs[-1][0] == head.run) == whole
            assert (executor.runs[-1][0] is alone) != whole
            mask = np.full((2, 2), frame_id, np.int64)
            found = some(frame_id / 1000)
            executor.finish(replace(found, segmentation=Segmentation(mask, mask)) if whole else found)
            looks.append(frame_id)
        perception = pending.result()
        with_masks = looks[(len(looks) - 1) // masks * masks]
        assert perception.ages["detector"] == frame_id - looks[-1]
        assert perception.ages["segmenter"] == frame_id - with_masks
        assert perception.segmentation.road[0, 0] == with_masks
        assert (Status.SEGMENTATION_CARRIED in perception.status) == (with_masks != frame_id)
        assert (Status.DETECTIONS_CARRIED in perception.status) == (looks[-1] != frame_id)


def test_boxes_of_shipped_network_do_not_depend_on_masks() -> None:
    spec = ModelSpec(str(SHIPPED_NETWORKS / "multitask_int8.onnx"))
    network = load_network("multitask", spec, 1, ("depth",), ("segmentation",))
    image = np.random.default_rng(3).integers(0, 255, (96, 320, 3), np.uint8)
    whole, boxes = network.run(image), network.run_without(image)
    assert whole.segmentation is not None
    assert (boxes.segmentation, boxes.depth, whole.depth) == (None, None, None)
    np.testing.assert_array_equal(whole.detections.boxes_px, boxes.detections.boxes_px)
    np.testing.assert_array_equal(whole.detections.scores, boxes.detections.scores)


def test_two_heads_of_one_role_are_refused() -> None:
    with pytest.raises(ValueError, match="each role must be unique"):
        Networks([FakeHead("a"), FakeHead("b")], Executor().submit)
    with pytest.raises(ValueError, match="patience_s"):
        Networks([], Executor().submit, patience_s=-1.0)
    assert Networks([], Executor().submit).start(0, IMAGE).result() == Perception(awaited_from=1)
    assert Ready(Perception()).result() == Perception()


# --- real networks on real frames


@functools.cache
def public(path: Path) -> Network:
    """A network of another project, loaded once."""
    return load_network("detector" if "yolox" in path.name else "segmenter", ModelSpec(str(path)))


def frame(data_dir: Path, folder: str, index: int) -> NDArray[np.uint8]:
    path = sorted((data_dir / folder).iterdir())[index]
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


SEQUENCE_00 = "kitti_odometry/sequences/00/image_0"
SEQUENCE_06 = "kitti_odometry/sequences/06/image_0"
RAW_CLIP = "kitti_raw_clip/image_02"

# Near cars as a person drew them, x1 y1 x2 y2.
NEAR_CARS = [
    (SEQUENCE_00, 0, (752, 190, 982, 328)),
    (SEQUENCE_00, 119, (362, 188, 648, 340)),
    (SEQUENCE_00, 119, (918, 178, 1241, 372)),
    (SEQUENCE_06, 0, (716, 176, 862, 257)),
    (RAW_CLIP, 3, (556, 187, 703, 325)),
]


@pytest.mark.parametrize(("folder", "index", "box"), NEAR_CARS)
def test_near_cars_are_found(data_dir: Path, models_dir: Path, folder: str, index: int, box: tuple[float, ...]) -> None:
    network = public(models_dir / "yolox_nano_416.onnx")
    findings = network.run(frame(data_dir, folder, index))
    cars = findings.detections.only({"car", "truck", "bus"})
    overlap = iou(np.vstack([np.array(box, float), cars.boxes_px]))[0, 1:]
    assert np.sum(overlap > 0.75) == 1
    assert np.sum(overlap > 0.3) <= 2  # no second box of the same car; a car behind may show
    assert set(findings.detections.labels) <= {"car", "truck", "bus", "person", "bicycle", "motorcycle"}


def test_the_road_ahead_is_road_and_the_sky_is_not(data_dir: Path, models_dir: Path) -> None:
    network = public(models_dir / "twinlitenet_640x360.onnx")
    for folder, index in ((SEQUENCE_00, 10), (SEQUENCE_06, 5)):
        image = frame(data_dir, folder, index)
        findings = network.run(image)
        masks = findings.segmentation
        assert masks.road.shape == image.shape[:2]
        assert masks.road[300:360, 500:650].mean() > 0.95
        assert masks.road[:150].mean() < 0.01
        assert masks.lane[:150].mean() < 0.01
        assert 0.0 < masks.lane.mean() < 0.05


@pytest.mark.parametrize(("role", "name"), [("detector", "yolox_nano_416"), ("segmenter", "twinlitenet_640x360")])
def test_grey_and_colour_agree_and_are_deterministic(data_dir: Path, models_dir: Path, role: str, name: str) -> None:
    grey = frame(data_dir, SEQUENCE_00, 50)
    images = [grey, cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)]
    network = public(models_dir / f"{name}.onnx")
    found = [network.run(image) for image in images]
    found.append(load_network(role, ModelSpec(str(models_dir / f"{name}.onnx"))).run(grey))
    for other in found[1:]:
        for one, two in ((found[0].detections, other.detections), (found[0].segmentation, other.segmentation)):
            assert (one is None) == (two is None)
            for key, value in vars(one or Perception()).items():
                np.testing.assert_array_equal(value, vars(two or Perception())[key])
    assert network.sha256 == network.manifest.sha256
    assert msgspec.json.encode(network.describe())


TILED = (
    DETECTOR
    + """
[tiles]
columns = 3
overlap = 0.2
"""
)


def test_detector_runs_on_each_tile(tmp_path: Path) -> None:
    """A network that sees one box wherever it looks sees it once in each tile, enlarged as the tile is."""
    box = np.array([[40.0, 10.0, 60.0, 40.0]])
    path = tiny.constant(tmp_path / "a.onnx", (1, 3, SIZE_PX, SIZE_PX), encode(box, [0], [0.9])["output"])
    image = np.full((SIZE_PX, 3 * SIZE_PX, 3), 9, np.uint8)
    network = load_network("detector", write(path, TILED))
    views = network.views(image)
    assert [view.x0_px for view in views] == [0, 118, 236]
    found = network.run(image)
    rx, ry = 148.0 / SIZE_PX, SIZE_PX / views[0].height_px  # tiles are 148 px wide: three, less their overlaps
    expected = [[view.x0_px + 40.0 * rx, 10.0 * ry, view.x0_px + 60.0 * rx, 40.0 * ry] for view in views]
    np.testing.assert_allclose(sorted(found.detections.boxes_px.tolist()), expected, atol=0.1)
    assert network.describe()["tiles"] == 3
    whole = load_network("detector", write(path, DETECTOR)).run(image)
    np.testing.assert_allclose(whole.detections.boxes_px[:, ::2], box[:, ::2] * 3.0, atol=0.1)
