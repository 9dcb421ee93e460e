"""Sources: pacing without drift, read-ahead, slow readers, and missing cameras."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Undistorter
from birdslam.runtime.configuration import Configuration, ConfigurationError, SourceConfig, load
from birdslam.runtime.nodes.sources import (
    EndOfSource,
    Pacer,
    ReadAhead,
    RecordedSource,
    SourceError,
    offline_frames,
    open_source,
    to_frame,
)
from birdslam.sources.recording import DatasetError, RecordedFrame
from birdslam.types import Status
from tests.recordings import PERIOD_NS, Frames
from tests.recordings import SMALL as CAMERA

TORN = frozenset({2})


def image(value: int = 0) -> np.ndarray:
    return np.full((32, 64), value, dtype=np.uint8)


class Live:
    """A camera that delivers on request."""

    name, camera, rate_hz, live = "camera", CAMERA, 10.0, True

    def __init__(self, error: Exception | None = None) -> None:
        self.tick = threading.Semaphore(0)
        self.delivered = 0
        self._error = error

    def frames(self) -> Generator[RecordedFrame]:
        while True:
            self.tick.acquire()
            if self._error is not None:
                raise self._error
            self.delivered += 1
            yield RecordedFrame(self.delivered - 1, self.delivered, image())


def wait_for(condition: Callable[[], bool]) -> None:
    """The reading thread can only be seen at work, not waited for."""
    for _ in range(2000):
        if condition():
            return
        threading.Event().wait(0.002)
    raise AssertionError("never happened")


@given(st.lists(st.integers(1, 10**9), max_size=30), st.integers(0, 10**18), st.integers(0, 10**15))
def test_the_pace_of_the_time_stamps_does_not_drift(steps_ns: list[int], first_ns: int, now_ns: int) -> None:
    pacer, t_ns = Pacer(None), first_ns
    assert pacer.due_ns(0, first_ns, now_ns) == now_ns
    for frame_id, step_ns in enumerate(steps_ns, start=1):
        t_ns += step_ns
        late_ns = now_ns + 17 * frame_id * step_ns  # however late it is asked
        assert pacer.due_ns(frame_id, t_ns, late_ns) - now_ns == t_ns - first_ns


@given(st.floats(1.0, 1000.0), st.integers(0, 100_000))
def test_given_rate_does_not_drift(rate: float, frame_id: int) -> None:
    pacer = Pacer(rate)
    pacer.due_ns(0, 0, 5)
    assert pacer.due_ns(frame_id, 123, 456) - 5 == pytest.approx(frame_id * 1e9 / rate, abs=1.0)


def test_rate_max_is_always_due() -> None:
    assert [Pacer("max").due_ns(i, 10**12 * i, 7) for i in range(3)] == [7, 7, 7]


def test_recording_is_read_completely_with_any_reader() -> None:
    reader = ReadAhead(RecordedSource(Frames(9, TORN), SourceConfig()), capacity=2)
    seen = []
    for _ in range(9):
        item = reader.next(timeout_s=60.0)
        assert item is not None
        seen.append(item)
        assert reader.read <= len(seen) + 3  # two wait, one is in hand
    with pytest.raises(EndOfSource):
        reader.next(timeout_s=60.0)
    assert [frame_id for frame_id, _ in seen] == list(range(9))
    assert [frame.error for _, frame in seen] == [None, None, "torn", *[None] * 6]
    assert reader.dropped == 0
    reader.close()


def test_a_slow_reader_of_a_camera_gets_the_newest_frame_and_the_count() -> None:
    camera = Live()
    reader = ReadAhead(camera, capacity=1)
    assert reader.next(timeout_s=0.01) is None
    for _ in range(5):
        camera.tick.release()
    wait_for(lambda: reader.read == 5)
    item = reader.next(timeout_s=60.0)
    assert (item[0], item[1].t_source_ns) == (4, 5)
    assert reader.dropped == 4
    camera.tick.release()
    item = reader.next(timeout_s=60.0)
    assert item[0] == 5
    reader.close(timeout_s=0.01)
    camera.tick.release()


def test_source_exceptions_reach_the_reader() -> None:
    camera = Live(SourceError("camera: gone"))
    reader = ReadAhead(camera, capacity=1)
    camera.tick.release()
    with pytest.raises(SourceError, match="gone"):
        reader.next(timeout_s=60.0)


def test_closing_ends_a_reader_that_waits() -> None:
    reader = ReadAhead(RecordedSource(Frames(100, TORN), SourceConfig()), capacity=1)
    wait_for(lambda: reader.read == 2)
    reader.close(timeout_s=60.0)
    assert not any(thread.name == "read-ahead" and thread.is_alive() for thread in threading.enumerate())


def test_loop_continues_in_time_up_to_its_frame_limit() -> None:
    source = RecordedSource(Frames(4, TORN), SourceConfig(loop=True, frames=10))
    times = [frame.t_source_ns for frame in source.frames()]
    assert times == [PERIOD_NS * i for i in range(10)]
    assert len(list(RecordedSource(Frames(4, TORN), SourceConfig(frames=3)).frames())) == 3
    assert list(RecordedSource(Frames(0, TORN), SourceConfig(loop=True)).frames()) == []


def test_offline_frames_keep_the_unreadable_one() -> None:
    frames = list(offline_frames(RecordedSource(Frames(4, TORN), SourceConfig())))
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3]
    assert [frame.image is None for frame in frames] == [False, False, True, False]
    assert frames[2].status == (Status.FRAME_UNREADABLE,)
    assert all(frame.t_capture_ns == frame.t_source_ns for frame in frames)


def test_an_image_of_another_size_costs_one_frame(caplog: pytest.LogCaptureFixture) -> None:
    wrong = RecordedFrame(7, 0, np.zeros((30, 64), dtype=np.uint8))
    frame = to_frame(Undistorter(CAMERA), 7, wrong, t_capture_ns=1)
    assert (frame.image, frame.status) == (None, (Status.FRAME_UNREADABLE,))
    assert "frame 7 is unreadable: image of 64x30 does not fit the camera of 64x32" in caplog.text


def test_frames_are_undistorted() -> None:
    camera = msgspec.structs.replace(CAMERA, distortion=(-0.3, 0.1, 0.0, 0.0))
    pixels = np.random.default_rng(3).integers(0, 256, (32, 64), dtype=np.uint8)
    frame = to_frame(Undistorter(camera), 0, RecordedFrame(0, 0, pixels), t_capture_ns=0)
    expected = cv2.undistort(pixels, camera.K, np.array(camera.distortion))
    assert np.mean(np.abs(frame.image.astype(int) - expected) <= 2) > 0.99


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({}, "no source: give --source"),
        ({"source.uri": "lidar:x"}, r"unknown source 'lidar:'; choose from demo, .*, v4l2:"),
        ({"source.uri": "v4l2:/dev/none"}, "needs a camera file"),
    ],
)
def test_invalid_source_is_refused(overrides: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        open_source(load(None, overrides))


def live(uri: str, **source: object) -> Configuration:

    return Configuration(camera=CAMERA, source=SourceConfig(uri=uri, camera_timeout_s=1.0, **source))


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="nowhere"):
        open_source(live(f"kitti:{tmp_path / 'nowhere'}"))


def test_missing_camera_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"v4l2:/dev/no_such: no such device: /dev/no_such"):
        open_source(live("v4l2:/dev/no_such"))
    file = tmp_path / "video0"
    file.write_bytes(b"no camera")
    with pytest.raises(SourceError, match="video0: does not open as a camera"):
        open_source(live(f"v4l2:{file}"))
    with pytest.raises(SourceError, match=r"rtsp://127\.0\.0\.1:9/x: does not open"):
        open_source(live("rtsp://127.0.0.1:9/x"))
    with pytest.raises(ConfigurationError, match='rate "max" is for recordings'):
        open_source(live("v4l2:/dev/no_such", rate="max"))


class Unplugged:
    """cv2.VideoCapture of a camera that is gone at its 3rd frame, and opens on the second try."""

    grabs = opens = 0

    def __init__(self, *arguments: object) -> None:
        Unplugged.opens += 1
        self._open = Unplugged.opens != 2

    def isOpened(self) -> bool:
        return self._open

    def set(self, what: int, value: float) -> bool:
        return True

    def get(self, what: int) -> float:
        return {cv2.CAP_PROP_FRAME_WIDTH: 64.0, cv2.CAP_PROP_FRAME_HEIGHT: 32.0}.get(what, 30.0)

    def grab(self) -> bool:
        Unplugged.grabs += 1
        return Unplugged.grabs != 3

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, image(Unplugged.grabs)

    def release(self) -> None:
        self._open = False


def test_reconnected_camera_continues(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    device = tmp_path / "video0"
    device.touch()
    monkeypatch.setattr(cv2, "VideoCapture", Unplugged)
    source = open_source(live(f"v4l2:{device}", frames=6, reopen_ms=1.0))
    source.resume(7, 0)  # nothing to a camera
    frames = list(source.frames())
    assert [frame.image is not None for frame in frames] == [True, True, False, False, True, True]
    assert {frame.error for frame in frames} == {None, f"v4l2:{device}: delivers no frame"}
    stamps = [frame.t_source_ns for frame in frames]
    assert stamps == sorted(stamps)
    assert Unplugged.opens == 3

    gone = open_source(live(f"v4l2:{tmp_path / 'gone'}", frames=2, reopen_ms=1.0), must_open=False)
    assert [frame.image for frame in gone.frames()] == [None, None]


@given(st.integers(0, 40), st.booleans(), st.one_of(st.none(), st.integers(1, 40)))
def test_resumed_recording_continues(start: int, loop: bool, frames: int | None) -> None:
    if loop and frames is None:
        frames = 40

    def source() -> RecordedSource:
        return RecordedSource(Frames(9, TORN), SourceConfig(loop=loop, frames=frames))

    whole = list(source().frames())
    resumed = source()
    resumed.resume(start, start * PERIOD_NS)
    rest = list(resumed.frames())
    assert [frame.t_source_ns for frame in rest] == [frame.t_source_ns for frame in whole[start:]]
    assert [frame.index for frame in rest] == [frame.index for frame in whole[start:]]
