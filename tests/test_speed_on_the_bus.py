"""The car's own speed on the bus: which frames carry it, what a flood costs, and which statuses report faults."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.runtime.configuration import Configuration, RecordingConfig, RuntimeConfig, SourceConfig
from birdslam.runtime.nodes import capture
from birdslam.runtime.nodes.capture import CaptureNode
from birdslam.runtime.nodes.car_speeds import CarSpeeds
from birdslam.runtime.nodes.meter import Meter
from birdslam.runtime.nodes.recorder import Recorder, about
from birdslam.runtime.nodes.sources import open_source
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.recording import Recording, RecordingWriter
from birdslam.runtime.topology import key_of
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.wire import decode, encode
from birdslam.sources.recording import RecordedFrame
from birdslam.sources.speed_log import MAX_READINGS, added
from birdslam.types import FrameRef, SpeedReading, SpeedSource, Status
from tests.fake_bus import FakeBus, Inbox
from tests.foreign_sender import foreign_session, matched
from tests.recordings import SMALL as CAMERA
from tests.records import step_at
from tests.test_bus import until

MS = 1_000_000
LIMIT_S = 60.0


def reading(t_ns: int, speed_mps: float = 5.0) -> SpeedReading:
    return SpeedReading(t_ns=t_ns, speed_mps=speed_mps, sigma_mps=0.1)


def test_a_frame_carries_the_last_second_in_order_of_arrival() -> None:
    inbox = Inbox(depth=MAX_READINGS)
    speeds = CarSpeeds(inbox)
    said = [reading(1), reading(2_000 * MS), reading(3, math.nan), reading(3)]  # any times of the car
    for number, one in enumerate(said):
        inbox.come(one, number * 500 * MS)
    for t_ns, wanted in ((1_400 * MS, said[1:]), (1_700 * MS, said[2:]), (2_499 * MS, said[3:]), (9_000 * MS, [])):
        assert speeds.at(t_ns, t_ns) == tuple(wanted)  # a second before it, and what came meanwhile
    assert speeds.counters() == {"speeds": 4, "speeds_dropped": 0, "malformed": 0}


def test_a_reading_without_a_time_gets_its_time_of_arrival() -> None:
    """In the source's clock: CLOCK_MONOTONIC for a camera, a separate clock for a paced recording."""
    said = (reading(0), reading(6_990 * MS), reading(-(1 << 63)), reading((1 << 64) - 1))
    inbox = Inbox(depth=MAX_READINGS)
    for one in said:
        inbox.come(one, 7_000 * MS)
    assert CarSpeeds(inbox).at(7_030 * MS, 7_030 * MS) == (reading(7_000 * MS), *said[1:])
    for one in said:
        inbox.come(one, 7_000 * MS)
    borne = CarSpeeds(inbox).at(130 * MS, 7_030 * MS)
    assert [one.t_ns for one in borne[:2]] == [100 * MS, 90 * MS]
    assert encode(FrameRef(frame_id=0, t_source_ns=0, t_capture_ns=0, t_utc_ns=0, speeds=borne))  # of whatever clock


def test_a_flood_leaves_the_newest_and_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    inbox = Inbox(depth=MAX_READINGS)
    speeds = CarSpeeds(inbox)
    for frame in range(1, 4):
        for number in range(5_000):
            inbox.come(reading(5_000 * frame + number), frame * 30 * MS)
        borne = speeds.at(frame * 30 * MS, frame * 30 * MS)
        assert [one.t_ns for one in borne] == list(range(5_000 * frame + 4_800, 5_000 * (frame + 1)))
    assert speeds.counters()["speeds"] == 3 * MAX_READINGS
    assert speeds.counters()["speeds_dropped"] == 3 * (5_000 - MAX_READINGS)
    assert len([record for record in caplog.records if "the car's speed" in record.message]) == 1
    stamps = {"frame_id": 1 << 40, "t_source_ns": 1 << 62, "t_capture_ns": 1 << 62, "t_utc_ns": 1 << 62}
    full = SpeedReading(t_ns=1 << 62, speed_mps=1.5, sigma_mps=0.5, yaw_rate_radps=0.5, yaw_rate_sigma_radps=0.5)
    assert len(encode(FrameRef(**stamps, speeds=(full,) * MAX_READINGS))) < 32_000  # half of a message


class Source:
    """A camera whose frames a test lets go, by CLOCK_MONOTONIC; or a recording."""

    name, camera, rate_hz = "source", CAMERA, 10.0

    def __init__(self, live: bool, speeds: tuple[SpeedReading, ...] = ()) -> None:
        self.live, self._speeds = live, speeds
        self.tick = threading.Semaphore(0)

    def frames(self) -> Iterator[RecordedFrame]:
        for index in range(1_000_000):
            self.tick.acquire()
            t_ns = time.monotonic_ns() if self.live else index
            pixels = None if index == 1 else np.zeros((32, 64), dtype=np.uint8)
            yield RecordedFrame(index, t_ns, pixels, None if pixels is not None else "torn", self._speeds)


@dataclass
class Capture:
    """The node at work, frame by frame."""

    node: CaptureNode
    source: Source
    configuration: Configuration

    def frame(self) -> FrameRef:
        self.source.tick.release()
        while (message := self.node.receive(LIMIT_S)) is None:
            pass
        (ref,) = self.node.step(message.record)
        return decode(encode(ref), FrameRef)

    def close(self) -> None:
        self.source.tick.release(10)  # who reads ahead ends too
        self.node.close()


def capturing(monkeypatch: pytest.MonkeyPatch, place: Path, bus: Bus, source: Source, **settings: object) -> Capture:
    monkeypatch.setattr(capture, "open_source", lambda configuration, must_open: source)
    configuration = Configuration(
        vehicle="car",
        camera=CAMERA,
        source=SourceConfig(uri="kitti:none", **settings),
        runtime=RuntimeConfig(runtime_dir=str(place)),
    )
    return Capture(CaptureNode(configuration, bus, lambda timeout_s: None, FIRST), source, configuration)


@pytest.mark.processes
def test_frames_carry_readings_at_50_hz_despite_malformed_messages(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = tmp_path_factory.mktemp("s")
    with ExitStack() as stack:
        stack.enter_context(Bus("car", "supervisor", hub=True, runtime_dir=place))
        bus = stack.enter_context(Bus("car", "capture", runtime_dir=place))
        node = capturing(monkeypatch, place, bus, Source(live=True))
        stack.callback(node.close)
        car = stack.enter_context(Bus("car", "car", runtime_dir=place))
        speed = car.publisher("speed")
        assert speed.wait_matched(LIMIT_S)
        block = zenoh.CongestionControl.BLOCK  # each one arrives, however busy the machine is
        foreign = stack.enter_context(foreign_session(place))
        plain = foreign.declare_publisher(key_of("car", "speed"), congestion_control=block)
        until(lambda: matched(plain), "capture, which subscribes")

        def until_taken(count: int) -> FrameRef:
            """The frame that carries the readings."""
            until_s = time.monotonic() + LIMIT_S
            while time.monotonic() < until_s:
                ref = node.frame()
                if node.node.counters()["speeds"] >= count:
                    return ref
            raise AssertionError("nothing came")

        assert node.frame().speeds == ()
        t_ns = time.monotonic_ns()
        said = [reading(t_ns + number * 20 * MS, 5.0 + number) for number in range(10)]
        for one in said:
            speed.put(one)
        assert until_taken(10).speeds == tuple(said)
        assert node.frame().speeds == tuple(said)  # a dropped frame loses none

        for wrong in (b"", b"\xc1", msgpack.packb({"t_ns": 1}), msgpack.packb([1, 2.0]), bytes(5_000)):
            plain.put(wrong)
        plain.put(msgpack.packb({"t_ns": 0, "speed_mps": math.nan, "sigma_mps": 0.1}))  # are a sensor's readings
        last = until_taken(11).speeds[-1]
        assert math.isnan(last.speed_mps)
        assert t_ns < last.t_ns <= time.monotonic_ns()
        assert node.node.counters()["malformed"] == 5

        for number in range(5_000):
            plain.put(encode(reading(t_ns, float(number))))
        most, counters, until_s = 0, node.node.counters(), time.monotonic() + LIMIT_S
        while counters["speeds"] + counters["speeds_dropped"] < 11 + 5_000:
            ref = node.frame()
            most, counters = max(most, len(ref.speeds)), node.node.counters()
            assert time.monotonic() < until_s, counters
        assert most == MAX_READINGS
        assert counters["dropped"] == ref.dropped == 0  # no frame is
        health = Meter("capture", node.configuration, FIRST).health(time.monotonic_ns(), "full", counters)
        assert (health.malformed, health.speeds_dropped) == (5, counters["speeds_dropped"])


def test_readings_of_a_recording_override_the_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own, bus = (reading(0, 7.0),), FakeBus()
    for name, speeds in (("own", own), ("none", ())):
        node = capturing(monkeypatch, tmp_path / name, bus, Source(False, speeds), rate=1e4)
        for frame in range(2):  # the second is torn, and bears them too
            bus.inboxes["speed"].come(reading(3, 3.0), time.monotonic_ns())
            assert node.frame().speeds[-1].speed_mps == (7.0 if own == speeds else 3.0), frame
        node.close()


@pytest.mark.parametrize("settings", [{"rate": "max"}, {"speed": "speed.csv"}])
def test_a_repeatable_run_ignores_the_bus(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, settings: dict[str, object]
) -> None:
    bus = FakeBus()
    node = capturing(monkeypatch, tmp_path, bus, Source(False, (reading(4),)), **settings)
    assert node.frame().speeds == (reading(4),)
    assert "speed" not in bus.inboxes
    node.close()


@given(st.lists(st.integers(0, 3), max_size=12), st.data())
def test_frame_adds_readings_since_the_previous_one(said: list[int], data: st.DataObject) -> None:
    """From a car with varying readings; equal ones may be merged."""
    readings = [reading(number, math.nan if kind == 0 else float(kind)) for number, kind in enumerate(said)]
    begin = data.draw(st.integers(0, len(said)))
    end = data.draw(st.integers(begin, len(said)))
    later = data.draw(st.integers(begin, end))
    before, after = tuple(readings[begin:end]), tuple(readings[later:])
    before, after = (tuple(decode(encode(one), SpeedReading) for one in span) for span in (before, after))
    assert added(before, after) == after[end - later :]


def test_recording_restores_the_readings_of_frames(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    recorded = Configuration(recording=RecordingConfig(file=str(path), images=True), camera=CAMERA)
    writer = RecordingWriter(path, about(recorded, {}), CAMERA, flush_ms=1e-3, sync=False)
    bus = FakeBus()
    recorder = Recorder(Configuration(), bus, writer, Vitals())
    refs = []
    said = tuple(reading(n * 10 * MS, math.nan if n % 7 == 3 else float(n)) for n in range(30))
    for number in range(6):
        t_ns, bore = number * 30 * MS, said[3 * number : 3 * number + 5]
        ref = FrameRef(frame_id=number, t_source_ns=t_ns, t_capture_ns=t_ns, t_utc_ns=t_ns, speeds=bore)
        refs.append(ref)
        if number == 3:
            continue  # it never came to the recorder
        bus.inboxes["frame"].come(ref, t_ns)
        recorder.record_received(0.0)
        writer.draw(*scene.from_image(np.zeros((32, 64), dtype=np.uint8), 90, t_ns), t_ns)
    writer.close({})

    def borne(**settings: object) -> list[bytes]:

        source = open_source(Configuration(source=SourceConfig(uri=f"mcap:{path}", **settings)))
        times = {"t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
        return [encode(FrameRef(frame_id=f.index, speeds=f.speeds, **times)) for f in source.frames()]

    def wanted(number: int, speeds: tuple[SpeedReading, ...]) -> bytes:
        return encode(FrameRef(frame_id=number, speeds=speeds, t_source_ns=0, t_capture_ns=0, t_utc_ns=0))

    assert borne() == [wanted(n, ref.speeds if n != 3 else ()) for n, ref in enumerate(refs)]
    assert borne(stride=2) == [wanted(n, refs[2 * n].speeds) for n in range(3)]
    (tmp_path / "speed.csv").write_text("0.01 7\n")
    own = SpeedReading(t_ns=10 * MS, speed_mps=7.0, sigma_mps=0.1)
    assert borne(speed=str(tmp_path / "speed.csv")) == [wanted(n, (own,) if n else ()) for n in range(6)]

    drawn = [msgspec.json.decode(message.data) for message in Recording(path).messages(("/speed",))]
    once = (*said[:11], *said[12:20])  # one that only the lost frame bore is not there
    assert [one["t_ns"] for one in drawn] == [r.t_ns for r in once]
    assert [one["speed_mps"] for one in drawn] == [None if math.isnan(r.speed_mps) else r.speed_mps for r in once]


def test_estimate_reports_its_scale_source() -> None:
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    said = []
    for frame in range(4):
        if frame == 3:
            made = step_at(frame, None, status=(Status.COASTING, Status.PERCEPTION_LATE))
        else:
            made = step_at(frame, SE2(0.3), 1e-4, speed_sources=(SpeedSource.ROAD, SpeedSource.CAR)[: frame + 1])
        said.append(graph.optimise(made).speed_sources)
    assert said == [("road",), ("road", "car"), ("road", "car"), ("carried",)]
