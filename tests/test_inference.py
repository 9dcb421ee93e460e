"""Networks on threads: deadlines, the background, and `[perceive.schedule]`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from birdslam import open_recording
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

IMAGE = np.zeros((4, 4), dtype=np.uint8)


class Gated(Head):
    """Answers when it is let."""

    def __init__(self, role: str, awaited: bool = True) -> None:
        super().__init__(role, awaited=awaited)
        self.go = threading.Semaphore(0)

    def run(self, image: np.ndarray) -> Findings:
        self.go.acquire(timeout=60.0)
        return super().run(image)


def frame(frame_id: int) -> Frame:
    return Frame(frame_id, 0, time.monotonic_ns(), 0, IMAGE)


Made = Callable[..., AbstractContextManager[Inference]]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    @contextmanager
    def make(detector: Gated, segmenter: Gated, deadline_ms: float, rate: object = None) -> Iterator[Inference]:
        heads = {"detector": detector, "segmenter": segmenter}
        monkeypatch.setattr(inference, "load_network", lambda role, spec, *others: heads[role])
        spec = ModelSpec("none.onnx")
        configuration = Configuration(
            source=SourceConfig(rate=rate),
            models=ModelsConfig(detector=spec, segmenter=spec, shipped=False),
            perceive=PerceiveConfig(deadline_ms=deadline_ms),
        )
        with Inference(configuration) as made:
            try:
                yield made
            finally:
                for head in heads.values():
                    head.go.release()

    return make


def test_a_frame_waits_until_its_deadline_and_no_longer(made: Made) -> None:
    detector, segmenter = Gated("detector"), Gated("segmenter")
    with made(detector, segmenter, deadline_ms=50.0) as networks:
        segmenter.go.release()
        seen = frame(0)
        perception = networks.start(seen).result()
        assert time.monotonic_ns() - seen.t_capture_ns >= 50_000_000
        assert perception.ages == {"segmenter": 0}
        assert perception.status == (Status.DETECTIONS_CARRIED,)
        assert detector.runs == 0  # still under way

        late = Frame(1, 0, time.monotonic_ns() - 10**9, 0, IMAGE)  # its deadline is over: it waits for nothing
        assert networks.start(late).result().status[0] == Status.DETECTIONS_CARRIED


def test_a_frame_continues_once_its_awaited_networks_have_answered(made: Made) -> None:
    detector, segmenter = Gated("detector"), Gated("segmenter", awaited=False)
    with made(detector, segmenter, deadline_ms=60_000.0) as networks:
        detector.go.release()
        perception = networks.start(frame(0)).result()
        assert perception.ages == {"detector": 0}
        assert perception.status == (Status.SEGMENTATION_CARRIED,)


def test_wait_is_limited_by_the_remaining_budget(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    clock_ns = [10**12]
    monkeypatch.setattr(inference.time, "monotonic_ns", lambda: clock_ns[0])
    monkeypatch.setattr(inference, "wait", lambda awaited, timeout: waited_s.append(timeout))
    waited_s: list[float] = []
    detector, segmenter = Gated("detector"), Gated("segmenter")
    with made(detector, segmenter, deadline_ms=100.0) as networks:
        for frame_id in range(2):  # the front end takes 1 s after the first: that is past any budget
            networks.start(Frame(frame_id, 0, clock_ns[0], 0, IMAGE)).result()
            clock_ns[0] += 10**9
            networks.finish_frame()
        networks.start(Frame(9, 0, clock_ns[0], 0, None, (Status.FRAME_UNREADABLE,)))
        networks.finish_frame()  # without waiting there is no information
    assert waited_s == [0.1, 0.0]


def test_rate_max_awaits_all(made: Made) -> None:
    detector, segmenter = Gated("detector"), Gated("segmenter", awaited=False)
    with made(detector, segmenter, deadline_ms=0.001, rate="max") as networks:
        pending = networks.start(frame(0))
        threading.Timer(0.05, segmenter.go.release).start()
        detector.go.release()
        perception = pending.result()
        assert perception.ages == {"detector": 0, "segmenter": 0}
        assert perception.status == ()


def test_background_work_starts_after_its_frame(made: Made) -> None:
    detector, segmenter = Gated("detector"), Gated("segmenter")
    with made(detector, segmenter, 1.0) as networks:
        aside = networks.run_in_background
        networks.start(frame(0))
        begun = threading.Event()
        future = aside(begun.set)
        assert not begun.wait(0.05)
        networks.finish_frame()
        future.result(timeout=60.0)
        assert begun.is_set()
        networks.start(frame(1))
        last = aside(lambda: 7)  # a run that is closed ends without waiting for a frame that does not end
    assert last.done()


def test_background_work_yields_to_frames(made: Made) -> None:
    with made(Gated("detector"), Gated("segmenter"), 1.0) as networks:
        first, second = threading.Event(), threading.Event()

        def parts() -> None:
            first.set()
            networks.lane_head.yield_core()
            second.set()

        aside = networks.run_in_background
        networks.start(frame(0))
        future = aside(lambda: (begun.wait(60.0), parts()))
        begun = threading.Event()
        networks.finish_frame()
        networks.start(frame(1))  # comes while the first part is at work
        begun.set()
        assert first.wait(60.0)
        assert not second.wait(0.05)
        networks.finish_frame()
        future.result(timeout=60.0)
        assert second.is_set()


def test_at_rate_max_there_is_no_background_work(made: Made) -> None:
    detector, segmenter = Gated("detector"), Gated("segmenter")
    with made(detector, segmenter, 1.0, rate="max") as networks:
        assert networks.run_in_background is None
        networks.start(frame(0))
        networks.lane_head.yield_core()  # at once: lanes are found within the frame


def test_boxes_alone_are_those_of_the_whole_network() -> None:
    """The shipped network computes masks with its boxes; without them the boxes are bit-identical."""
    configuration = Configuration(source=SourceConfig(rate="max"))
    recording = open_recording("demo")
    images = [shown.image for shown in islice(recording.undistorted_frames(), 3)]
    found = []
    for boxes_only in (False, True):
        with Inference(configuration, boxes_only) as networks:
            seen = [networks.start(Frame(k, 0, 0, 0, image)).result() for k, image in enumerate(images)]
        found.append([result.detections for result in seen])
    for whole, boxes in zip(*found, strict=True):
        np.testing.assert_array_equal(whole.boxes_px, boxes.boxes_px)
        np.testing.assert_array_equal(whole.scores, boxes.scores)


def test_boxes_alone_need_only_the_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ModelSpec("none.onnx")
    monkeypatch.setattr(inference, "load_network", lambda role, spec, *others: Head(role))
    models = ModelsConfig(detector=spec, segmenter=spec, shipped=False)
    with Inference(Configuration(source=SourceConfig(rate="max"), models=models), boxes_only=True) as networks:
        assert networks.roles == {"detector"}


CAMERA = Camera(640, 192, 370.0, 370.0, 320.0, 88.0, 1.6)


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


class Blocked(Head):
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
    head = Blocked("detector", ModelSpec("none.onnx", every=2, awaited=False))
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
    heads: dict[str, Blocked] = {}

    def loaded(role: str, spec: ModelSpec, *others: object) -> Head:
        heads[role] = Blocked(role, spec)
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
