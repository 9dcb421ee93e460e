"""Networks on threads: which are awaited, until which deadline, and which run in the background."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import islice

import numpy as np
import pytest

from birdslam import open_recording
from birdslam.perception import Findings, ModelSpec
from birdslam.runtime.configuration import Configuration, ModelsConfig, PerceiveConfig, SourceConfig
from birdslam.runtime.nodes import inference
from birdslam.runtime.nodes.inference import Inference
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
