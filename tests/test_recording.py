"""A recorded drive: complete, truncated, damaged, on a full disk, and with a killed recorder."""

from __future__ import annotations

import errno
import os
import resource
import signal
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from msgspec.structs import replace

from birdslam.runtime.cli.main import main
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import Configuration, ConfigurationError, RecordingConfig, SourceConfig
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.nodes.recorder import Recorder, about
from birdslam.runtime.nodes.sources import open_source
from birdslam.runtime.process.restarts import FIRST, Assignment, Resume
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.recording import append_only as appendonly
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.append_only import AppendOnlyFile
from birdslam.runtime.recording.foxglove import CompressedImage, schema
from birdslam.runtime.recording.recording import (
    JSON_CHANNELS,
    Alive,
    Recorded,
    Recording,
    RecordingError,
    RecordingWriter,
)
from birdslam.runtime.replay.replay import compare
from birdslam.runtime.supervision.recording_files import choose_file
from birdslam.runtime.wire import Health, Trace, decode, encode
from birdslam.sources.camera_file import load_camera
from birdslam.sources.recording import DatasetError
from birdslam.types import Estimate, Frame, FrameRef, MapUpdate, Measurements, Status
from tests.fake_bus import FakeBus, Inbox
from tests.records import new_estimate
from tests.taped_drive import CAMERA, Tape, measured
from tests.test_bus import until
from tests.test_pipeline import HEIGHT, LIMIT_S, UNHURRIED, WIDTH, Run, drive, wait_gone

__all__ = ["drive"]  # a fixture


@pytest.fixture
def tape(tmp_path: Path) -> Tape:
    """A drive of 40 frames with its images, on disk in some ten chunks."""
    tape = Tape(tmp_path, recording=RecordingConfig(file="drive.mcap", images=True))
    for number, measurements in enumerate(measured(40)):
        ref = tape.frame(measurements)
        if number != 7:  # the ring had gone on
            image = np.full((192, 640), number, dtype=np.uint8)
            tape.writer.draw(*scene.from_image(image, 90, ref.t_utc_ns), number)
        tape.take(tape.send(measurements))
        for drawn in (scene.from_measurements(measurements, 0), scene.from_estimate(tape.estimates[-1], 0)):
            for channel, message in drawn:
                tape.writer.draw(channel, message, number)
    tape.writer.draw("/estimate", tape.estimates[-1], 40)
    tape.close()
    return tape


def test_boxes_are_kept_between_detector_runs() -> None:
    seen = next(m for m in measured(40) if m.cv)
    later = replace(seen, cv=(), status=(Status.DETECTIONS_CARRIED,), ages={"detector": 1})
    long_after = replace(later, ages={"detector": 60})
    nothing_there = replace(seen, cv=())
    drawn = [
        {channel for channel, _ in scene.from_measurements(m, 0)} for m in (seen, later, long_after, nothing_there)
    ]
    assert ["/camera/boxes" in channels for channels in drawn] == [True, False, True, True]


def messages(path: Path) -> list[Recorded]:
    return list(Recording(path).messages())


def test_records_come_back_byte_for_byte(tape: Tape) -> None:
    recording = Recording(tape.path)
    told = [message.data for message in recording.messages(("v1/estimate",))]
    assert told == [encode(estimate) for estimate in tape.estimates]
    assert [decode(data, Estimate) for data in told] == tape.estimates
    given = [decode(message.data, Measurements) for message in recording.messages(("v1/measurements",))]
    assert given == measured(40)
    assert recording.complete
    assert recording.damaged == 0


def test_recording_has_everything_for_a_replay(tape: Tape, tmp_path: Path) -> None:
    recording = Recording(tape.path)
    assert msgspec.convert(recording.about.configuration, Configuration) == tape.configuration
    assert recording.camera == CAMERA
    assert recording.about.versions["birdslam"]
    with tape.path.open("rb") as file:
        attachments = {a.name: a.data for a in make_reader(file).iter_attachments()}
    (tmp_path / "camera.toml").write_bytes(attachments["camera.toml"])
    assert load_camera(tmp_path / "camera.toml") == CAMERA


def test_a_password_in_the_cameras_address_is_not_recorded() -> None:
    source = SourceConfig(uri="rtsp://user:secret@camera/stream")
    assert b"secret" not in msgspec.json.encode(about(Configuration(source=source), {}))


def test_other_readers_of_mcap_find_everything_by_its_index(tape: Tape) -> None:
    with tape.path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary.statistics.message_count == len(messages(tape.path))
        assert len(summary.chunk_indexes) > 5
        schemas = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        assert schemas["/camera/image"] == "foxglove.CompressedImage"
        assert schemas["/scene"] == "foxglove.SceneUpdate"
        assert schemas["v1/estimate"] == schemas["/estimate"] == "birdslam.Estimate"
        last = [m.data for _, channel, m in reader.iter_messages(topics=["/estimate"]) if channel.topic == "/estimate"]
        assert msgspec.json.decode(last[-1], type=Estimate) == tape.estimates[-1]


def check_simple(part: dict[str, Any]) -> None:
    """The JSON schema of Foxglove's open forks: no references, no unions, no arrays of arrays, every field typed."""
    assert part["type"] in ("object", "array", "number", "integer", "string", "boolean")
    if part["type"] == "object":
        for field in part["properties"].values():
            check_simple(field)
    if part["type"] == "array":
        assert part["items"]["type"] != "array"
        check_simple(part["items"])


def fits(value: Any, part: dict[str, Any]) -> bool:
    """Whether a message fits its schema."""
    if part["type"] == "object":
        fields = part["properties"]
        if not fields:
            return isinstance(value, dict)
        return set(part["required"]) <= set(value) <= set(fields) and all(
            value[name] is None or fits(value[name], fields[name]) for name in value
        )
    if part["type"] == "array":
        return isinstance(value, list) and all(fits(v, part["items"]) for v in value)
    kinds = {"number": (int, float), "integer": int, "string": str, "boolean": bool}
    return isinstance(value, kinds[part["type"]])


def test_every_message_for_people_fits_its_schema(tape: Tape) -> None:
    schemas = {name: msgspec.json.decode(schema(record)) for name, record in JSON_CHANNELS.items()}
    for top in schemas.values():
        assert top["type"] == "object"
        check_simple(top)
    seen = set()
    for message in messages(tape.path):
        if message.channel in schemas:
            assert fits(msgspec.json.decode(message.data), schemas[message.channel]), message.channel
            seen.add(message.channel)
    assert {"/tf", "/ego", "/scene", "/road", "/camera/boxes", "/camera/image", "/estimate", "/alive"} <= seen


def test_truncated_recording_is_read_up_to_the_end(tape: Tape) -> None:
    whole = tape.path.read_bytes()
    with tape.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    first_chunk = summary.chunk_indexes[0].chunk_start_offset  # preceded by the header
    all_of_it = messages(tape.path)
    lengths = []
    for size in [*range(0, len(whole), len(whole) // 60), len(whole) - 1]:
        tape.path.write_bytes(whole[:size])
        try:
            recording = Recording(tape.path)
        except RecordingError:
            assert size < first_chunk
            continue
        found = list(recording.messages())
        assert found == all_of_it[: len(found)]
        assert not recording.complete or size >= len(whole) - 8  # the magic at its end
        lengths.append(len(found))
    assert lengths == sorted(lengths)
    assert lengths[-1] == len(all_of_it)
    assert len(set(lengths)) > 5


def test_a_damaged_chunk_is_left_out_and_counted(tape: Tape) -> None:
    data = bytearray(tape.path.read_bytes())
    with tape.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    middle = summary.chunk_indexes[4]
    data[middle.chunk_start_offset + middle.chunk_length // 2] ^= 0x10
    tape.path.write_bytes(data)
    recording = Recording(tape.path)
    found = list(recording.messages(("v1/estimate",)))
    assert recording.damaged == 1
    assert recording.complete
    assert 0 < len(found) < 40


@pytest.mark.parametrize("data", [b"", b"no recording", bytes(100), b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(50)])
def test_non_recording_file_is_named(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"x\.mcap"):
        Recording(path)
    with pytest.raises(RecordingError, match="No such file"):
        Recording(tmp_path / "none.mcap")


def test_a_full_disk_ends_the_recording_with_its_last_whole_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = [30_000]

    def write(fd: int, data: Any) -> int:
        size = min(len(data), room[0])
        room[0] -= size
        if size == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return os_write(fd, data[:size])

    os_write = os.write
    monkeypatch.setattr(appendonly.os, "write", write)
    tape = Tape(tmp_path)
    tape.step(*measured(80))
    tape.close()
    assert tape.writer.error.errno == errno.ENOSPC
    assert tape.path.stat().st_size == tape.writer.written_bytes <= 30_000
    verdict = compare(recording := Recording(tape.path))
    assert verdict.same
    assert 0 < verdict.equal < 80
    assert recording.damaged == 0


def test_writer_does_not_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that hangs holds up nothing until the memory for what waits is full."""
    read, wrote = os.pipe()
    monkeypatch.setattr(appendonly.os, "fdatasync", lambda fd: os.read(read, 1))
    file = AppendOnlyFile(tmp_path / "file")
    for _ in range(50):
        file.write(bytes(1000))
    os.write(wrote, bytes(100))
    file.close()
    assert (tmp_path / "file").stat().st_size == 50_000


def test_unwritten_data_is_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, wrote = os.pipe()
    monkeypatch.setattr(appendonly.os, "fdatasync", lambda fd: os.read(read, 1))
    writer = RecordingWriter(tmp_path / "a.mcap", about(Configuration(), {}), None, 100.0)
    writer.draw("/alive", Alive(node="optimize", alive=True), 1)
    assert writer.flush_if_due(1)
    assert writer.handed_bytes > writer.written_bytes
    os.write(wrote, bytes(100))
    writer.close({})
    assert writer.handed_bytes == writer.written_bytes == (tmp_path / "a.mcap").stat().st_size


def test_recordings_are_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    for file, reason in (("a.mcap", "exists"), ("a.bag", "expected"), ("no/a.mcap", "no such directory")):
        with pytest.raises(ConfigurationError, match=reason):
            choose_file(RecordingConfig(file=str(tmp_path / file)), "car")
    chosen = Path(choose_file(RecordingConfig(file=str(tmp_path)), "car"))
    assert chosen.parent == tmp_path
    assert chosen.name.startswith("car-")
    with pytest.raises(FileExistsError):
        RecordingWriter(tmp_path / "a.mcap", about(Configuration(), {}), None, 100.0)


def test_its_images_are_a_source_of_frames(tape: Tape, tmp_path: Path) -> None:
    source = open_source(Configuration(source=SourceConfig(uri=f"mcap:{tape.path}")))
    frames = list(source.frames())
    assert [frame.index for frame in frames] == list(range(40))
    assert [frame.t_source_ns for frame in frames] == [m.t_source_ns for m in measured(40)]
    assert source.rate_hz == pytest.approx(33.0)
    assert source.camera == CAMERA
    for frame in frames:
        assert (frame.image is None) == (frame.index == 7)
        assert frame.image is None or abs(int(frame.image.mean()) - frame.index) <= 1
    assert "was not recorded" in (frames[7].error or "")
    strided = list(open_source(Configuration(source=SourceConfig(uri=f"mcap:{tape.path}", stride=3))).frames())
    assert [frame.t_source_ns for frame in strided] == [frame.t_source_ns for frame in frames[::3]]
    other = Tape(tmp_path / "other")
    other.step(measured(1)[0])
    other.close()
    with pytest.raises(DatasetError, match="without images"):
        open_source(Configuration(source=SourceConfig(uri=f"mcap:{other.path}")))


# --- beside a vehicle: real processes ---


def estimated(recording: Recording) -> list[int]:
    """The frames whose estimates are in it."""
    return [decode(message.data, Estimate).frame_id for message in recording.messages(("v1/estimate",))]


def lost(recording: Recording, topic: str) -> int:
    """The number of messages that are missing between two of one sender."""
    numbers = [decode(message.data, Trace).number for message in recording.messages((f"v1/{topic}/trace",))]
    return sum(max(0, later - earlier - 1) for earlier, later in pairwise(numbers))


def drive_on(planner: Planner, frames: int) -> set[int]:
    """The next so many frames that the planner hears of."""
    heard: set[int] = set()
    until_s = time.monotonic() + LIMIT_S
    while len(heard) < frames:
        assert time.monotonic() < until_s
        estimate = planner.wait(1.0)
        if estimate is not None:
            heard.add(estimate.frame_id)
    return heard


@pytest.mark.processes
def test_kills_and_restarts_lose_no_data(tmp_path_factory: pytest.TempPathFactory, drive: Path) -> None:
    place = tmp_path_factory.mktemp("k")
    file = place / "k.mcap"
    with (
        Run(
            *(place, "--source", f"kitti:{drive}", "--rate", "25", "--set", "source.loop=true"),
            *("--record", str(file), "--record-images"),
            *("--set", "runtime.catch_up_ms=60000"),  # a busy perceive may take its time
        ) as run,
        Planner(run.vehicle, run.runtime_dir) as planner,
    ):
        drive_on(planner, 25)
        os.kill(run.node_pid("optimize"), signal.SIGKILL)
        heard = drive_on(planner, 60)
        until(lambda: max(heard) in estimated(Recording(file)), "the disk has what was heard")
        nodes = [run.node_pid(name) for name in ("capture", "perceive", "optimize")]
        for pid in (run.node_pid("record"), run.process.pid):
            os.kill(pid, signal.SIGKILL)
        wait_gone(nodes)  # they end with their supervisor
    recording = Recording(file)
    verdict = compare(recording)
    assert verdict.same, verdict.difference
    assert not recording.complete
    assert verdict.restarts == 1
    # A process without a core for a second loses its link, and the messages of that time; their numbers show it
    assert verdict.unknown == 0 or lost(recording, "measurements") > 0
    # SIGKILL can fall between the sends to the planner and to the recorder: the last estimate before it may be missing
    assert heard - set(estimated(recording)) <= {min(heard)} or lost(recording, "estimate") > 0
    images = [msgspec.json.decode(m.data, type=CompressedImage) for m in recording.messages(("/camera/image",))]
    assert len(images) > 50
    assert cv2.imdecode(np.frombuffer(images[-1].data, np.uint8), cv2.IMREAD_UNCHANGED).shape == (HEIGHT, WIDTH)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        pytest.param(lambda run: os.kill(run.node_pid("record"), signal.SIGKILL), "was killed by SIGKILL", id="dies"),
        pytest.param(
            lambda run: run.stall("record"),
            f"is stalled: no heartbeat for {1e3 * LIMIT_S:g} ms",
            id="stalls",
            marks=pytest.mark.slow,  # test_pipeline.py stalls a node
        ),
    ],
)
def test_recorder_restarts_with_a_new_file_until_the_disk_is_full(
    fault: Callable[[Run], None],
    cause: str,
    tmp_path_factory: pytest.TempPathFactory,
    drive: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    place = tmp_path_factory.mktemp("r")
    files = [place / "r.mcap", place / "r-2.mcap"]
    with (
        Run(
            *(place, "--source", f"kitti:{drive}", "--rate", "25", "--set", "source.loop=true"),
            *("--record", str(files[0]), *UNHURRIED),
        ) as run,
        Planner(run.vehicle, run.runtime_dir) as planner,
    ):
        drive_on(planner, 12)
        fault(run)
        drive_on(planner, 12)  # it goes on meanwhile
        until(lambda: files[1].is_file() and files[1].stat().st_size > 0, "its successor writes")
        until(lambda: any(Recording(files[1]).messages(("/health/record",))), "it has said how it is, once a second")
        limit = files[1].stat().st_size + 10_000  # no file of its process may grow past it: the write fails
        resource.prlimit(run.node_pid("record"), resource.RLIMIT_FSIZE, (limit, limit))
        drive_on(planner, 40)
        out = run.stop()
    assert f"record {cause}; it is being restarted" in out
    assert "the recording has ended: File too large" in out
    assert "restarted 1 times, CUT OFF" in out
    assert set(run.summary()["restarts"].values()) == {0}
    summary = run.summary()["recording"]
    assert summary["files"] == [str(file) for file in files]
    assert (summary["restarts"], summary["complete"]) == (1, False)
    first, second = (Recording(file) for file in files)
    verdicts = [compare(first), compare(second)]
    assert [verdict.difference for verdict in verdicts] == [None, None]
    assert min(verdict.equal for verdict in verdicts) > 0
    assert not first.complete
    assert not second.complete
    assert (first.about.restarts, second.about.restarts) == (0, 1)
    frames = [estimated(recording) for recording in (first, second)]
    assert summary["dropped"] >= frames[1][0] - frames[0][-1] - 1 > 0
    said = [msgspec.json.decode(m.data, type=Health) for m in second.messages(("/health/record",))]
    assert {(health.restarts, health.cause) for health in said} == {(1, cause)}
    assert files[1].stat().st_size <= limit
    assert run.summary()["frames_processed"] > sum(verdict.equal for verdict in verdicts)
    assert main(["replay", str(files[1])]) == 0
    assert "cut off" in capsys.readouterr().out
    assert main(["run", "--source", f"kitti:{drive}", "--record", str(files[0])]) == 2
    assert "exists" in capsys.readouterr().err


def recorder_of(
    path: Path, bus: FakeBus, vitals: Vitals | None = None, assignment: Assignment = FIRST
) -> tuple[Recorder, RecordingWriter]:
    configuration = Configuration(vehicle="late", camera=CAMERA)
    writer = RecordingWriter(path, about(configuration, {}), CAMERA, flush_ms=1e-6, sync=False)
    return Recorder(configuration, bus, writer, vitals or Vitals(), assignment), writer


def test_recorder_sends_a_heartbeat_per_message(tmp_path: Path) -> None:
    """Its watchdog leaves out the time without a core, not what it takes to write all that waited meanwhile."""
    frames = Inbox(FrameRef(**stamps(m)) for m in measured(200))
    written: list[int] = []
    unpacked: list[int] = []

    class Watched(Vitals):
        def beat(self) -> None:
            super().beat()
            written.append(writer.messages)
            unpacked.append(200 - len(frames) - writer.messages + begun)

    recorder, writer = recorder_of(tmp_path / "late.mcap", FakeBus(frame=frames), Watched())
    begun = writer.messages  # the camera's drawing
    assert recorder.record_received(0.0)
    assert writer.messages >= 200
    assert max(np.diff(written)) <= 5
    assert writer.handed_bytes > 0
    assert max(unpacked) <= 2  # a message, and the next of its topic
    writer.close(recorder.end())
    assert len([*Recording(tmp_path / "late.mcap").messages(("v1/frame",))]) == 200


@pytest.mark.parametrize("last", [3, 9])
def test_measurements_that_are_missing_at_the_end_are_counted(last: int, tmp_path: Path) -> None:
    end = new_estimate(**stamps(Frame(9, 9, 9, 9, None)), valid=False, status=(Status.END_OF_SOURCE,))
    sent = [
        Measurements(**stamps(Frame(k, k, k, k, None)), status=(Status.END_OF_SOURCE,) if k == 9 else ())
        for k in range(last + 1)
    ]
    gained = Inbox([MapUpdate(epoch=0, frame_id=9)])
    bus = FakeBus(measurements=Inbox(sent), estimate=Inbox([end]), map=gained)
    recorder, writer = recorder_of(tmp_path / "tail.mcap", bus)
    while recorder.record_received(0.0):
        pass
    assert recorder.ending
    assert recorder.over == (last == 9)
    assert recorder.dropped() == ({} if last == 9 else {"measurements": 9 - last})
    writer.close(recorder.end())


@pytest.mark.parametrize(
    ("assignment", "missed"),
    [(FIRST, 0), (Assignment(restarts=1, resume=Resume(5, 0, 0)), 7), (Assignment(restarts=1), 12)],
    ids=["first", "after a confirmed frame", "without a confirmed frame"],
)
def test_a_restarted_recorder_counts_the_frames_before_it(tmp_path: Path, assignment: Assignment, missed: int) -> None:
    bus = FakeBus(estimate=Inbox([new_estimate(frame_id=12)]))
    recorder, writer = recorder_of(tmp_path / "late.mcap", bus, assignment=assignment)
    assert recorder.record_received(0.0)
    counts = recorder.end()
    assert counts["missed"] == counts["dropped"] == str(missed)
    writer.close(counts)
