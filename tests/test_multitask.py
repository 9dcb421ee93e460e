"""The multi-task network: targets are decoded back, properties of its decoder, its schedule, the shipped file."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.perception import Detections, Findings, ModelSpec, Networks, Segmentation, load_network
from birdslam.perception.decoding.multitask import (
    BODY_CHANNELS,
    CANONICAL_FOCAL_REL,
    CLASSES,
    KINDS,
    MEAN_SIZE_M,
    MultiTaskDecoder,
    body_slices,
)
from birdslam.perception.manifest import SHIPPED_NETWORKS, FitPad, Input, ManifestMismatch, MultiTask, Stretch
from birdslam.perception.onnx_files.unread_outputs import without_outputs
from birdslam.perception.shipped import run_at_once
from birdslam.perception.views import make_views
from birdslam.types import Status
from birdslam.world.training.augmentation import AugmentationConfig
from birdslam.world.training.grading import Grades, average_precision, best_score_threshold
from birdslam.world.training.stream import StreamConfig, examples
from birdslam.world.training.targets import COLUMN, Example, TargetsConfig, Window, encode
from birdslam.world.training.validation import validate
from birdslam.world.truth import CLASSES as SURFACES
from birdslam.world.truth import WorldFrame, WorldObject
from tests.heads import Head

WIDTH, HEIGHT, CELL = 320, 96, 4
BODY = body_slices()
WHOLE = Window(0, 0, WIDTH, HEIGHT)
SIZE = Input(name="image", width_px=WIDTH, height_px=HEIGHT, layout="NCHW", colour="BGR", resize=Stretch())
SHAPES = {
    "segmentation": (1, 2, HEIGHT // 2, WIDTH // 2),
    "depth": (1, 1, HEIGHT // 2, WIDTH // 2),
    "heat": (1, len(CLASSES), HEIGHT // CELL, WIDTH // CELL),
    "body": (1, sum(BODY_CHANNELS.values()), HEIGHT // CELL, WIDTH // CELL),
}


def camera(focal: float = 0.7, width_px: int = WIDTH, height_px: int = HEIGHT) -> Camera:
    return Camera(
        width_px=width_px,
        height_px=height_px,
        fx_px=focal * width_px,
        fy_px=focal * width_px,
        cx_px=0.5 * width_px,
        cy_px=0.4 * height_px,
        height_m=1.6,
        pitch_rad=0.01,
    )


def vehicle(cam: Camera, pose: SE2, label: str = "car", size_m: tuple[float, float, float] = (4.2, 1.8, 1.5)) -> Any:
    """A cuboid on the road; its box is that of its corners."""
    length_m, width_m, height_m = size_m
    R_cam_ego = cam.ground.R_ego_cam.T
    T = pose.rotation()
    corners = [
        np.array([*(np.array([pose.x_m, pose.y_m]) + T @ [sx * length_m / 2, sy * width_m / 2]), z - cam.height_m])
        for sx in (-1, 1)
        for sy in (-1, 1)
        for z in (0.0, height_m)
    ]
    points = np.array(corners) @ R_cam_ego.T
    pixels = (points @ cam.K.T)[:, :2] / points[:, 2:]
    full = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    box = np.clip(full, -0.5, np.array([cam.width_px, cam.height_px] * 2) - 0.5)
    base = R_cam_ego @ [pose.x_m, pose.y_m, -cam.height_m]
    area, shown = np.prod(full[2:] - full[:2]), np.prod(box[2:] - box[:2])
    return WorldObject(
        object_id=0,
        label=label,
        length_m=length_m,
        width_m=width_m,
        height_m=height_m,
        T_ego_object=pose,
        base_cam_m=base,
        yaw_cam_rad=pose.yaw_rad,
        box_px=box,
        full_box_px=full,
        visible=1.0,
        truncated=float(1.0 - shown / area),
        pixels=int(shown),
        velocity_mps=np.zeros(2),
    )


def world(cam: Camera, *bodies: WorldObject) -> WorldFrame:
    """A road to the horizon with a marking at each side, and boxes on it."""
    shape = (cam.height_px, cam.width_px)
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    rays = np.stack([(u - cam.cx_px) / cam.fx_px, (v - cam.cy_px) / cam.fy_px, np.ones(shape)], axis=-1)
    down = -(rays @ cam.ground.normal_cam)
    with np.errstate(divide="ignore"):
        depth_m = np.where(down > 1e-3, cam.height_m / np.maximum(down, 1e-3), np.inf)
    across = np.abs(rays[..., 0] * np.minimum(depth_m, 1e4))
    names = np.where(np.isinf(depth_m), "sky", np.where(across < 4.0, "road", "vegetation"))
    names = np.where((names == "road") & (np.abs(across - 2.0) < 0.2), "lane", names)
    classes = np.vectorize(SURFACES.index, otypes=[np.uint8])(names)
    image = np.repeat((classes * 25)[..., None], 3, axis=2).astype(np.uint8)
    return WorldFrame(
        image=image,
        depth_m=depth_m.astype(np.float32),
        classes=classes,
        instances=np.zeros(shape, dtype=np.uint16),
        objects=tuple(bodies),
        lanes=(),
        road_m=(),
        camera=cam,
        T_world_cam=np.eye(4),
        frame_id=0,
        t_source_ns=0,
    )


def perfect_answer(example: Example) -> dict[str, NDArray[np.float32]]:
    """The outputs of a perfect network for an example."""
    out = {name: np.zeros(shape, dtype=np.float32) for name, shape in SHAPES.items()}
    out["segmentation"][0] = 8.0 * (2.0 * example.masks - 1.0)
    out["depth"][0, 0] = example.log_depth
    out["heat"][:] = -8.0
    for row in example.objects[example.objects[:, COLUMN["taught"]] > 0.0]:
        value = {name: float(row[index]) for name, index in COLUMN.items()}
        x = int(0.5 * (value["x1_px"] + value["x2_px"]) / CELL)
        y = int(0.5 * (value["y1_px"] + value["y2_px"]) / CELL)
        out["heat"][0, int(value["class"]), y, x] = 6.0
        body = out["body"][0, :, y, x]
        cx, cy = x + 0.5, y + 0.5
        sides = [cx - value["x1_px"] / CELL, cy - value["y1_px"] / CELL]
        sides += [value["x2_px"] / CELL - cx, value["y2_px"] / CELL - cy]
        body[BODY["sides"]] = np.log(sides)
        body[BODY["kind"]] = 5.0 * (np.arange(3) == value["kind"])
        body[BODY["offset"]] = [value["u_px"] / CELL - cx, value["v_px"] / CELL - cy]
        body[BODY["log_depth"]] = value["log_depth"]
        body[BODY["log_sigma"]] = -3.0
        log_size = [value[name] for name in ("log_length", "log_width", "log_height")]
        body[BODY["log_size"]] = np.array(log_size) - np.log(MEAN_SIZE_M)
        sin, cos = value["sin_alpha"], value["cos_alpha"]
        body[BODY["axis"]] = 40.0 * np.array([cos * cos - sin * sin, 2.0 * sin * cos])
        body[BODY["front"]] = 4.0 * np.array([cos, sin])
    return out


def decoder(table: MultiTask | None = None, size: Input = SIZE) -> MultiTaskDecoder:
    return MultiTaskDecoder(table or MultiTask(), size, SHAPES)


def read(tensors: dict[str, NDArray[np.float32]], width_px: int = WIDTH, height_px: int = HEIGHT) -> Findings:
    (view,) = make_views(width_px, height_px, SIZE, None)
    return decoder().read(tensors, view)


poses = st.builds(SE2, st.floats(9.0, 35.0), st.floats(-4.0, 4.0), st.floats(-math.pi, math.pi))
sizes_m = st.tuples(st.floats(3.0, 12.0), st.floats(1.5, 2.6), st.floats(1.3, 3.5))


@settings(max_examples=20)
@given(poses, sizes_m, st.sampled_from(["car", "truck", "bus"]), st.floats(0.45, 1.3))
def test_encoded_body_is_decoded(pose: SE2, size_m: tuple[float, float, float], label: str, focal: float) -> None:
    cam = camera(focal)
    body = vehicle(cam, pose, label, size_m)
    example = encode(world(cam, body), WHOLE, WIDTH, HEIGHT, TargetsConfig())
    if example.objects[0, COLUMN["taught"]] == 0.0:
        return
    found = read(perfect_answer(example)).detections
    assert found.labels == (label,)
    assert found.boxes_px[0] == pytest.approx(body.box_px + 0.5, abs=1e-3)
    bodies = found.boxes3d.in_metres(cam)
    assert bodies.size_m[0] == pytest.approx(size_m, rel=1e-4)
    centre_m = bodies.centres_cam_m(cam)[0]
    assert centre_m == pytest.approx(body.base_cam_m + 0.5 * size_m[2] * cam.ground.normal_cam, abs=0.01)
    x_m, y_m, yaw_rad = bodies.in_ego(cam, cam.ground)[0]
    assert (x_m, y_m) == pytest.approx((pose.x_m, pose.y_m), abs=0.02)
    assert math.remainder(yaw_rad - pose.yaw_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-3)
    assert bodies.flip[0] < 0.05


@settings(max_examples=10)
@given(poses)
def test_mirrored_world_is_decoded_mirrored(pose: SE2) -> None:
    cam = camera()
    frame = world(cam, vehicle(cam, pose))
    plain = encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig())
    mirrored = encode(frame, replace(WHOLE, mirrored=True), WIDTH, HEIGHT, TargetsConfig())
    assert np.array_equal(mirrored.masks, plain.masks[..., ::-1])
    if plain.objects[0, COLUMN["taught"]] == 0.0:
        return
    a, b = (read(perfect_answer(example)).detections for example in (plain, mirrored))
    assert b.boxes_px[0, [2, 1, 0, 3]] == pytest.approx(a.boxes_px[0] * [-1, 1, -1, 1] + [WIDTH, 0, WIDTH, 0], abs=1e-3)
    assert math.remainder(a.boxes3d.alpha_rad[0] + b.boxes3d.alpha_rad[0], 2.0 * math.pi) == pytest.approx(0, abs=1e-3)
    assert b.boxes3d.depth_m == pytest.approx(a.boxes3d.depth_m)


@pytest.mark.parametrize("focal", [0.45, 0.58, 1.3])
def test_canonical_depth_is_metric_for_every_camera(focal: float) -> None:
    cam = camera(focal)
    frame = world(cam)
    found = read(perfect_answer(encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig())))
    assert found.depth.canonical_focal_rel == pytest.approx(CANONICAL_FOCAL_REL)
    upper, lower = 1.0 / frame.depth_m[::2, ::2], 1.0 / frame.depth_m[1::2, 1::2]
    nearness = 0.5 * (upper + lower)  # of a plane at the corner where four pixels meet
    near = nearness > 1.0 / 30.0
    assert near.sum() > 1000
    assert 1.0 / found.depth.in_metres(cam).depth_m[near] == pytest.approx(nearness[near], rel=1e-3)


def test_crop_scales_the_canonical_focal_length() -> None:
    cam = camera()
    body = vehicle(cam, SE2(20.0, 0.5, 0.3))
    example = encode(world(cam, body), Window(80, 24, 240, 72), WIDTH, HEIGHT, TargetsConfig())
    whole = encode(world(cam, body), WHOLE, WIDTH, HEIGHT, TargetsConfig())
    shift = example.objects[0, COLUMN["log_depth"]] - whole.objects[0, COLUMN["log_depth"]]
    assert shift == pytest.approx(math.log(0.5), abs=1e-5)
    width = COLUMN["x2_px"], COLUMN["x1_px"]
    assert example.objects[0, width[0]] - example.objects[0, width[1]] == pytest.approx(
        2.0 * (whole.objects[0, width[0]] - whole.objects[0, width[1]]), rel=1e-4
    )


def test_barely_visible_objects_are_ignored() -> None:
    cam = camera()
    body = replace(vehicle(cam, SE2(15.0, 0.0, 0.0)), visible=0.1)
    row = encode(world(cam, body), WHOLE, WIDTH, HEIGHT, TargetsConfig()).objects[0]
    assert row[COLUMN["taught"]] == 0.0
    assert row[COLUMN["x2_px"]] > row[COLUMN["x1_px"]]
    hidden = replace(body, pixels=0)
    assert not encode(world(cam, hidden), WHOLE, WIDTH, HEIGHT, TargetsConfig()).objects.any()


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (1242, 375), (640, 480)])
def test_masks_cover_the_image(size: tuple[int, int]) -> None:
    frame = world(camera())
    found = read(perfect_answer(encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig())), *size).segmentation
    assert found.road.shape == found.lane.shape == size[::-1]
    rows = (np.arange(size[1]) * HEIGHT) // size[1]
    columns = (np.arange(size[0]) * WIDTH) // size[0]
    lane = frame.classes == SURFACES.index("lane")
    road = (frame.classes == SURFACES.index("road")) | lane
    truth = road[rows[:, None], columns]
    assert (found.road & truth).sum() > 0.97 * (found.road | truth).sum()
    assert (found.lane & ~found.road).sum() < 0.05 * found.lane.sum()
    painted = lane[rows[:, None], columns]
    assert (found.lane & painted).sum() > 0.5 * (found.lane | painted).sum()
    assert (found.lane & painted).sum() > 0.9 * painted.sum()


def test_better_of_two_boxes_is_kept() -> None:
    cam = camera()
    example = encode(world(cam, vehicle(cam, SE2(9.0, 0.0, 0.1))), WHOLE, WIDTH, HEIGHT, TargetsConfig())
    tensors = perfect_answer(example)
    (_, y, x) = np.argwhere(tensors["heat"][0] > 0.0)[0]
    tensors["heat"][0, 0, y, x + 2] = 3.0
    tensors["body"][0, :, y, x + 2] = tensors["body"][0, :, y, x]
    tensors["body"][0, BODY["sides"], y, x + 2] = np.log(
        np.exp(tensors["body"][0, BODY["sides"], y, x]) + np.array([2.0, 0.0, -2.0, 0.0])
    )
    found = read(tensors).detections
    assert len(found) == 1
    assert found.scores[0] == pytest.approx(1.0 / (1.0 + math.exp(-6.0)))


@pytest.mark.parametrize(("name", "channels"), [("segmentation", 3), ("heat", 1), ("body", 7), ("depth", 2)])
def test_mismatched_outputs_are_refused(name: str, channels: int) -> None:
    shape = SHAPES[name]
    with pytest.raises(ManifestMismatch, match=name):
        MultiTaskDecoder(MultiTask(), SIZE, {**SHAPES, name: (1, channels, *shape[2:])})


def test_padding_is_part_of_the_focal_length() -> None:
    size = Input(name="image", width_px=WIDTH, height_px=HEIGHT, layout="NCHW", colour="BGR", resize=FitPad())
    (view,) = make_views(160, HEIGHT, size, None)  # fills half of the input's width
    found = decoder(size=size).read(
        perfect_answer(encode(world(camera()), WHOLE, WIDTH, HEIGHT, TargetsConfig())), view
    )
    assert found.depth.canonical_focal_rel == pytest.approx(2.0 * CANONICAL_FOCAL_REL)
    assert found.depth.depth_m.shape == (HEIGHT // 2, WIDTH // 4)


def test_perfect_findings_get_the_best_grades() -> None:
    cam = camera()
    grades = Grades()
    for pose in (SE2(14.0, 2.0, 0.2), SE2(22.0, -3.0, 3.0), SE2(11.0, 0.0, -1.4)):
        frame = world(cam, vehicle(cam, pose))
        grades.add(read(perfect_answer(encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig()))), frame)
    figures = grades.figures()
    assert figures["vehicles"] == 3
    assert figures["vehicle_ap50"] == 1.0
    assert figures["flips"] == 0.0
    assert figures["yaw_median_deg"] < 0.1
    assert figures["centre_median_rel"] < 1e-3
    assert figures["box_sigma_rel"] < 1e-3
    assert figures["road_iou"] > 0.97
    assert figures["depth_absrel"] < 0.1


@pytest.mark.parametrize("certain", [-0.45, -0.75, -1.35])
def test_validation_finds_the_best_threshold_of_markings(certain: float) -> None:
    cam = camera()
    frame = world(cam, vehicle(cam, SE2(14.0, 2.0, 0.2)))
    example = encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig())
    said = perfect_answer(example)
    said["segmentation"][0, 1] = np.where(example.masks[1] > 0.0, certain, certain - 0.3)

    def answer(image: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        assert image.shape == (1, 3, HEIGHT, WIDTH)
        return said

    rng = np.random.default_rng(3)
    figures = validate(answer, lambda *_: frame, (WIDTH, HEIGHT), 2, AugmentationConfig(), rng)
    assert certain - 0.3 < figures["lane_logit"] < certain
    assert figures["lane_iou"] > 0.5  # by the threshold that was found
    assert (figures["frames"], figures["vehicle_ap50"]) == (2, 1.0)


def test_false_and_missed_boxes_lower_the_metrics() -> None:
    cam = camera()
    frame = world(cam, vehicle(cam, SE2(14.0, 2.0, 0.2)), replace(vehicle(cam, SE2(14.0, -2.5, 0.2)), object_id=1))
    found = read(perfect_answer(encode(frame, WHOLE, WIDTH, HEIGHT, TargetsConfig()))).detections
    grades = Grades()
    false = Detections(np.array([found.boxes_px[0], [10.0, 10.0, 40.0, 40.0]]), np.array([0.9, 0.8]), ("car", "car"))
    grades.add(Findings(detections=false), frame)
    assert grades.figures()["vehicle_ap50"] == pytest.approx(0.5)
    assert average_precision([0.9, 0.8, 0.7], [False, True, True], 2) == pytest.approx(2.0 / 3.0)
    assert best_score_threshold([0.5, 0.9, 0.1, 0.8], [True, True, False, True], 3) == 0.5


def test_examples_repeat_from_their_seed() -> None:
    config = StreamConfig(width_px=WIDTH, height_px=HEIGHT, batch=3, looks=2, pool_frames=2)
    drawn: list[int] = []

    def render(seed: int, width_px: int, height_px: int) -> WorldFrame:
        drawn.append(seed)
        cam = camera(0.6 + 0.1 * (seed % 5), width_px, height_px)
        return world(cam, vehicle(cam, SE2(10.0 + seed % 7, 0.0, 0.1)))

    first, again = examples(5, config, render), examples(5, config, render)
    for _ in range(3):
        a, b = next(first), next(again)
        assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))
        assert a.image.dtype == np.uint8
        assert a.image.shape == (3, HEIGHT, WIDTH, 3)
    assert min(drawn) >= 1_000_000  # held-out seeds are not learnt from
    other = next(examples(6, config, render))
    assert not np.array_equal(other.image, a.image)


def test_every_augmentation_gives_an_image() -> None:
    always = AugmentationConfig(**{**dict.fromkeys(AugmentationConfig.__struct_fields__, 1.0), "crop_min": 0.6})
    config = StreamConfig(width_px=WIDTH, height_px=HEIGHT, batch=8, augmentation=always)
    batch = next(examples(1, config, lambda seed, width_px, height_px: world(camera(0.7, width_px, height_px))))
    assert batch.image.std() > 5.0
    assert np.isfinite(batch.log_depth).all()


def findings(label: str) -> Findings:
    mask = np.zeros((2, 2), dtype=bool)
    return Findings(Detections(np.zeros((1, 4)), np.ones(1), (label,)), Segmentation(mask, mask))


def test_multitask_network_yields_roles_to_other_networks() -> None:
    image = np.zeros((2, 2), dtype=np.uint8)
    alone = Networks([Head("multitask", findings("car"), every=2)], run_at_once)
    first, second = (alone.start(frame, image).result() for frame in (0, 1))
    assert first.ages == {"detector": 0, "segmenter": 0, "depth": 0}
    assert first.status == ()
    assert second.ages == {"detector": 1, "segmenter": 1, "depth": 1}
    carried = {Status.DETECTIONS_CARRIED, Status.SEGMENTATION_CARRIED, Status.DEPTH_CARRIED}
    assert set(second.status) == carried
    own = Head("detector", Findings(detections=findings("bus").detections))
    beside = Networks([own, Head("multitask", findings("car"), every=2)], run_at_once)
    first, second = (beside.start(frame, image).result() for frame in (0, 1))
    assert first.detections.labels == ("bus",)
    assert first.segmentation is not None
    assert second.ages == {"detector": 0, "segmenter": 1, "depth": 1}
    assert set(second.status) == carried - {Status.DETECTIONS_CARRIED}


def test_a_network_whose_roles_are_all_taken_does_not_run() -> None:
    heads = [Head(role, Findings()) for role in ("detector", "segmenter", "depth")]
    shipped = Head("multitask", findings("car"))
    perception = Networks([*heads, shipped], run_at_once).start(0, np.zeros((2, 2), dtype=np.uint8)).result()
    assert perception.detections is None
    assert perception.ages == {"detector": 0, "segmenter": 0, "depth": 0}


@pytest.fixture(scope="module", params=["multitask", "multitask_int8"])
def shipped(request: pytest.FixtureRequest) -> Any:
    return load_network("multitask", ModelSpec(path=str(SHIPPED_NETWORKS / f"{request.param}.onnx")))


@pytest.mark.parametrize("size", [(1242, 375), (640, 192), (1920, 1080), (640, 480), (97, 61), (33, 16)])
@pytest.mark.parametrize("grey", [False, True])
def test_the_shipped_network_takes_any_image(shipped: Any, size: tuple[int, int], grey: bool) -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (size[1], size[0]) if grey else (size[1], size[0], 3), dtype=np.uint8)
    found = shipped.run(image)
    assert found.segmentation.road.shape == found.segmentation.lane.shape == size[::-1]
    assert np.isfinite(found.depth.depth_m).all()
    assert (found.depth.depth_m > 0.0).all()
    bodies = found.detections.boxes3d
    assert len(bodies) == len(found.detections)
    for array in (found.detections.boxes_px, bodies.centre_px, bodies.depth_m, bodies.size_m, bodies.sigma_alpha_rad):
        assert np.isfinite(array).all()
    assert (np.diff(found.detections.scores) <= 0.0).all()
    assert ((bodies.flip >= 0.0) & (bodies.flip <= 0.5)).all()
    assert set(found.detections.labels) <= {*KINDS, "person"}


def test_unread_outputs_are_not_computed_and_the_rest_is_bit_identical(shipped: Any) -> None:
    image = np.random.default_rng(5).integers(0, 256, (192, 640, 3), dtype=np.uint8)
    cut = load_network("multitask", ModelSpec(path=str(shipped.path)), unread=("depth",))
    assert cut.run(image).depth is None
    whole, part = shipped.raw_outputs(image), cut.raw_outputs(image)
    assert set(part) == set(whole) - {"depth"}
    assert all(part[name].tobytes() == whole[name].tobytes() for name in part)
    content = shipped.path.read_bytes()
    assert without_outputs(content, ()) == content
    assert len(without_outputs(content, ("depth",))) < len(content)


def test_shipped_network_is_deterministic(shipped: Any) -> None:
    image = np.random.default_rng(4).integers(0, 256, (375, 1242, 3), dtype=np.uint8)
    again = load_network("multitask", ModelSpec(path=str(shipped.path)))
    a, b = shipped.run(image), again.run(image)
    assert a.depth.depth_m.tobytes() == b.depth.depth_m.tobytes()
    assert a.segmentation.road.tobytes() == b.segmentation.road.tobytes()
    assert a.detections.boxes_px.tobytes() == b.detections.boxes_px.tobytes()


def test_the_shipped_networks_are_small() -> None:
    assert sum(path.stat().st_size for path in Path(SHIPPED_NETWORKS).glob("*.onnx")) < 15e6


needs_torch = pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="needs the extra [train]: torch")


@needs_torch
def test_perfect_output_has_the_least_loss() -> None:
    import torch

    from birdslam.world.training.losses import LossConfig, loss
    from birdslam.world.training.stream import stack
    from birdslam.world.training.trainer import as_batch, as_tensors

    cam = camera()
    example = encode(world(cam, vehicle(cam, SE2(12.0, 1.0, 0.4))), WHOLE, WIDTH, HEIGHT, TargetsConfig())
    batch = as_batch(as_tensors(stack([example])))
    answer = perfect_answer(example)
    best = loss(tuple(torch.from_numpy(answer[name]) for name in SHAPES), batch, LossConfig())
    for name, part in {"depth": "depth", "segmentation": "road", "heat": "heat", "body": "box"}.items():
        worse = {**answer, name: answer[name] + np.float32(0.5)}
        cost = loss(tuple(torch.from_numpy(worse[key]) for key in SHAPES), batch, LossConfig())
        assert cost[part] > best[part]


@needs_torch
def test_training_steps_reduce_the_loss() -> None:
    from birdslam.world.training.stream import examples as stream
    from birdslam.world.training.trainer import Trainer, TrainerConfig, as_tensors

    config = StreamConfig(width_px=WIDTH, height_px=HEIGHT, batch=2, looks=100)
    cam = camera()
    batches = stream(2, config, lambda *_: world(cam, vehicle(cam, SE2(12.0, 1.0, 0.4))))
    trainer = Trainer(TrainerConfig(warm_up_steps=5), half=False)
    costs = [trainer.train_step(as_tensors(next(batches)), 0.0, step, 2e-3)["total"] for step in range(30)]
    assert np.mean(costs[-5:]) < 0.6 * np.mean(costs[:5])


@pytest.mark.slow
@needs_torch
@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="needs the extra [train]: numba")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's, of its older ONNX export
def test_training_writes_a_valid_network_and_resumes(tmp_path: Path) -> None:
    from birdslam.runtime.world.train import main

    path, out = tmp_path / "a.toml", tmp_path / "out"
    path.write_text(
        "processes = 1\nheld_out_frames = 2\nfinal_frames = 2\nrow_steps = 1\ngrade_steps = 2\n"
        "[[stages]]\nwidth_px = 64\nheight_px = 32\nbatch = 2\nsteps = 3\nrate = 1e-3\nlooks = 2\n"
    )
    for _ in range(2):
        main(["--config", str(path), "--output", str(out)])
        assert load_network("multitask", ModelSpec(path=str(out / "multitask.onnx"))).role == "multitask"
    assert len((out / "curves.csv").read_text().splitlines()) == 4
