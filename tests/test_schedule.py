"""`[perceive.schedule]`: each head runs as configured."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.perception import Findings, ModelSpec, Networks, Perception
from birdslam.runtime.configuration import (
    Configuration,
    ConfigurationError,
    ModelsConfig,
    PerceiveConfig,
    SourceConfig,
    complete,
    load,
)
from birdslam.runtime.nodes import inference
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.sections import NetworkTurn, ScheduleConfig, Turn
from birdslam.types import Frame, Status
from tests.heads import Head

CAMERA = Camera(640, 192, 370.0, 370.0, 320.0, 88.0, 1.6)
IMAGE = np.zeros((4, 4), dtype=np.uint8)


def of_toml(tmp_path: Path, text: str) -> ScheduleConfig:
    path = tmp_path / "a.toml"
    path.write_text(text)
    return load(path).perceive.schedule


def test_dividers_and_rates_of_each_head(tmp_path: Path) -> None:
    text = """
[perceive.schedule]
detector = { every = 2 }
segmenter = { hz = 10, awaited = false }
lanes = { hz = 8 }
"""
    schedule = of_toml(tmp_path, text).at(33.0)
    assert schedule.detector == NetworkTurn(every=2)
    assert schedule.segmenter == NetworkTurn(every=3, awaited=False)
    assert schedule.lanes == Turn(every=4)
    spec = ModelSpec("n.onnx", every=5, threads=2)
    assert schedule.of("segmenter", spec) == ModelSpec("n.onnx", every=3, threads=2, awaited=False)
    assert schedule.of("depth", spec) == spec  # not configured


@pytest.mark.parametrize(("rate_hz", "every"), [(33.0, 7), (10.0, 2), (5.0, 1), (2.0, 1)])
def test_lanes_run_five_times_a_second_by_default(rate_hz: float, every: int) -> None:
    configuration = complete(Configuration(), CAMERA, rate_hz)
    assert configuration.perceive.schedule.lanes.every == every
    fixed = complete(Configuration(source=SourceConfig(rate=50.0)), CAMERA, rate_hz)  # the rate it is paced at
    assert fixed.perceive.schedule.lanes.every == 10


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("detector = { every = 2, hz = 3 }", "every and hz exclude each other"),
        ("lanes = { awaited = true }", "perceive.schedule.lanes.awaited: no such key"),
        ("pointnet = { every = 2 }", "perceive.schedule.pointnet: no such key"),
        ("detector = { every = 0 }", "perceive.schedule.detector.every"),
    ],
)
def test_invalid_schedule_is_refused_by_name(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        of_toml(tmp_path, f"[perceive.schedule]\n{text}\n")


class Gated(Head):
    """Answers when it is let."""

    def __init__(self, role: str, spec: ModelSpec) -> None:
        said = {key: getattr(spec, key) for key in ("every", "awaited") if getattr(spec, key) is not None}
        super().__init__(role, **said)
        self.go, self.done = threading.Event(), threading.Event()

    def answer(self, image: np.ndarray) -> Findings:
        self.go.wait(60.0)
        self.done.set()
        return super().answer(image)


def test_networks_run_on_the_next_frame_while_the_caller_processes_one() -> None:
    def frame(k: int) -> Frame:
        return Frame(k, k, k, k, None if k == 3 else IMAGE)

    def carried(perception: Perception) -> tuple[dict[str, int], tuple[Status, ...]]:
        return perception.ages, perception.status

    with ThreadPoolExecutor(1) as threads:
        alone, ahead = (Networks([Head("detector", every=2)], threads.submit) for _ in range(2))
        expected = [carried(alone.start(k, frame(k).image).result()) for k in range(8)]
        found, started, read = [], [], []

        def frames() -> Iterator[Frame]:
            for k in range(8):
                read.append(k)
                yield frame(k)

        for each, pending in ahead.in_order(frames()):
            found.append(carried(pending.result()))
            started.append((each.frame_id, read[-1]))
        assert found == expected
        assert started == [(k, min(k + 1, 7)) for k in range(8)]


def test_frames_whose_perception_is_not_taken_are_yielded_too() -> None:
    with ThreadPoolExecutor(1) as threads:
        networks = Networks([Head("detector")], threads.submit)
        frames = [Frame(k, k, k, k, IMAGE) for k in range(3)]
        assert [frame.frame_id for frame, _ in networks.in_order(frames)] == [0, 1, 2]
        assert list(networks.in_order([])) == []


def test_no_detections_come_for_earlier_frames() -> None:
    head = Gated("detector", ModelSpec("none.onnx", every=2, awaited=False))
    with ThreadPoolExecutor(1) as threads:
        networks = Networks([head], threads.submit, patience_s=0.0)
        networks.start(4, IMAGE)
        assert networks.start(5, IMAGE).result().awaited_from == 4
        head.go.set()
        head.done.wait()
        threads.submit(int).result()  # the one before has ended too
        pending = networks.start(6, None)
        assert pending.result().awaited_from == 7


def test_late_head_is_skipped_with_status(monkeypatch: pytest.MonkeyPatch) -> None:
    heads: dict[str, Gated] = {}

    def loaded(role: str, spec: ModelSpec, *others: object) -> Head:
        heads[role] = Gated(role, spec)
        return heads[role]

    monkeypatch.setattr(inference, "load_network", loaded)
    spec = ModelSpec("none.onnx")
    schedule = ScheduleConfig(detector=NetworkTurn(every=1), segmenter=NetworkTurn(hz=11.0, awaited=False))
    configuration = complete(
        Configuration(
            models=ModelsConfig(detector=spec, segmenter=spec, shipped=False),
            perceive=PerceiveConfig(deadline_ms=60.0, schedule=schedule),
        ),
        CAMERA,
        33.0,
    )
    with Inference(configuration) as networks:
        heads["detector"].go.set()
        seen: list[Perception] = []

        def look() -> Perception:
            k = len(seen)
            frame = Frame(k, 0, time.monotonic_ns(), 0, np.full(IMAGE.shape, k, np.int32))  # its number, over 255 too
            seen.append(networks.start(frame).result())
            return seen[-1]

        late = [look() for _ in range(5)]
        heads["segmenter"].go.set()
        heads["segmenter"].done.wait()
        while "segmenter" not in look().ages:  # it is done by now, or in no time
            pass
        first = len(seen) - 1
        while len(heads["segmenter"].frames) < 4:
            look()
            heads["segmenter"].done.wait()
    assert heads["detector"].frames == list(range(len(seen)))
    for perception in late:
        assert "segmenter" not in perception.ages
        assert perception.status == (Status.SEGMENTATION_CARRIED,)
        assert perception.ages["detector"] == 0
    assert seen[first].ages["segmenter"] == first  # the run of frame 0, with its age
    assert seen[first].status == (Status.SEGMENTATION_CARRIED,)
    ran = heads["segmenter"].frames
    assert ran[0] == 0
    assert min(np.diff(ran)) >= 3
