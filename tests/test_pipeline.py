"""The whole system as a user starts it: real processes, real zenoh, real shared memory."""

from __future__ import annotations

import functools
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.cli.main import main
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import load
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.replay.replay import compare
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.wire import decode, encode
from birdslam.sources.opening import open_recording
from birdslam.sources.speed_file import read_speeds
from birdslam.types import INVALIDATING, Estimate, FrameRef, MapUpdate, Measurements, Status

pytestmark = pytest.mark.processes

FRAMES, WIDTH, HEIGHT, F_PX, HEIGHT_M = 12, 480, 160, 260.0, 1.65
TORN = 5  # image of a drive
LIMIT_S = 240.0
WITH_NETWORKS = ("--set", "models.shipped=true")  # of most runs it is not their figures that are looked at
# Nothing is left out or coasted over for want of time
UNHURRIED = ("--set", "budgets.end_to_end_ms=60000", "--set", "degradation.enabled=false")


@functools.cache
def _texture() -> np.ndarray:
    texture = cv2.GaussianBlur(np.random.default_rng(5).integers(0, 256, (2048, 2048), dtype=np.uint8), (0, 0), 2.0)
    return cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)


def road_image(x_m: float) -> np.ndarray:
    """A textured road under an empty sky, seen from `x_m` along the road; level camera."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    below = np.maximum(v - HEIGHT / 2, 0.5)
    depth = F_PX * HEIGHT_M / below
    side = (u - WIDTH / 2) * depth / F_PX
    scale = np.float32(24.0)  # texels a metre
    road = cv2.remap(
        _texture(), side * scale + 1024, (depth + x_m) * scale, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    return np.where(v > HEIGHT / 2 + 4, road, 200).astype(np.uint8)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small KITTI drive with its truth: straight on, 0.8 m a frame at 10 Hz."""
    sequence = tmp_path_factory.mktemp("kitti") / "sequences" / "77"
    (sequence / "image_0").mkdir(parents=True)
    for number in range(FRAMES):
        assert cv2.imwrite(str(sequence / "image_0" / f"{number:06d}.png"), road_image(0.8 * number))
    row = f"{F_PX} 0 {WIDTH / 2} 0 0 {F_PX} {HEIGHT / 2} 0 0 0 1 0"
    (sequence / "calib.txt").write_text(f"P0: {row}\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(FRAMES)))
    poses = sequence.parent.parent / "poses" / "77.txt"
    poses.parent.mkdir()
    poses.write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {0.8 * i}\n" for i in range(FRAMES)))
    return sequence


class Run:
    """`birdslam run` in a separate process."""

    def __init__(self, place: Path, *arguments: str, vehicle: str = "test") -> None:
        self.place, self.vehicle = place, vehicle
        self.runtime_dir, self.output = place / "rt", place / "out"
        self.process = subprocess.Popen(
            command(
                *("run", "--vehicle", vehicle, "--output", str(self.output)),
                *("--set", f"runtime.runtime_dir={self.runtime_dir}"),
                *("--set", f"runtime.watchdog_ms={1e3 * LIMIT_S}"),  # a busy machine is no stalled node
                *("--set", "runtime.spares=false", "--set", "models.shipped=false", *arguments),
            ),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def end(self) -> tuple[int, str, str]:
        """Exit status, standard output and standard error."""
        out, err = self.process.communicate(timeout=LIMIT_S)
        return self.process.returncode, out, err

    def stop(self) -> str:
        """Asks it to end, which it does without an error; what it printed."""
        self.process.send_signal(signal.SIGTERM)
        status, out, err = self.end()
        assert status == 0, err
        return out

    def summary(self) -> dict:
        return json.loads((self.output / "summary.json").read_text())

    def node_pid(self, name: str) -> int:
        """The process of a node, which is a child of the supervisor."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        for pid in children:
            if name.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                return int(pid)
        raise AssertionError(f"{name} does not run")

    def stall(self, name: str) -> None:
        """Stops a node's process, and sets its last sign of life to before all: no other node is near its limit."""
        pid = self.node_pid(name)
        os.kill(pid, signal.SIGSTOP)
        until_s = time.monotonic() + LIMIT_S
        while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
            assert time.monotonic() < until_s
        arguments = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
        vitals = Vitals(os.open(f"/proc/{pid}/fd/{arguments[arguments.index(name) + 1]}", os.O_RDWR))
        vitals.count(beat_ns=0)
        vitals.close()

    def left_behind(self) -> list[Path]:
        return left_behind(self.vehicle, self.runtime_dir)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *failure: object) -> None:
        self.kill()

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate(timeout=LIMIT_S)


def left_behind(vehicle: str, runtime_dir: Path) -> list[Path]:
    """Sockets and rings that still exist."""
    ring = ring_path(vehicle, runtime_dir)
    return [*(runtime_dir / vehicle).glob("*.sock*"), *ring.parent.glob(f"{ring.name}*")]


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-P", "-m", "birdslam.runtime.cli.main", *arguments]


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=LIMIT_S, check=False)


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose path is short enough for sockets in it."""
    return tmp_path_factory.mktemp("p")


def wait_gone(pids: list[int]) -> None:
    """Waits until all processes have ended."""
    for pid in pids:
        try:
            fd = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        try:
            assert select.select([fd], [], [], LIMIT_S)[0], f"process {pid} is still there"
        finally:
            os.close(fd)


def evaluate(sequence: Path, output: Path, *arguments: str) -> bytes:
    """What one process computes: this one, whose libraries have the nodes' environment (conftest.py)."""
    assert main(["evaluate", "odometry", str(sequence), "--output", str(output), *arguments]) == 0
    return (output / sequence.name / "ego.kitti.txt").read_bytes()


def run_all(place: Path, sequence: Path, *arguments: str) -> Run:
    run = Run(place, "--source", f"kitti:{sequence}", *arguments)
    status, out, err = run.end()
    assert (status, err) == (0, ""), out
    return run


Records = dict[str, list[bytes]]
TOPICS = {"v1/measurements": Measurements, "v1/estimate": Estimate, "v1/map": MapUpdate}


def untimed(record: Any) -> bytes:
    """A record's bytes without the times at which the vehicle's computer took it."""
    if not isinstance(record, MapUpdate):
        record = msgspec.structs.replace(record, t_capture_ns=0, t_utc_ns=0)
    return encode(record)


def records_of_one_process(sequence: Path, overrides: dict[str, Any], speeds: Path | None = None) -> Records:
    """What `evaluate` computes."""
    records: Records = {topic: [] for topic in TOPICS}
    topic_of = {kind: topic for topic, kind in TOPICS.items()}
    recording = open_recording(f"kitti:{sequence}", stride=overrides.get("source.stride", 1), speeds=speeds)
    with pipeline(load(None, overrides)) as measure:
        for record in measure(recording):
            records[topic_of[type(record)]].append(untimed(record))
    return records


def records_of_three(file: Path) -> Records:
    """What went over the bus, up to the records that end the run."""
    recording = Recording(file)
    found = [(m.channel, decode(m.data, TOPICS[m.channel])) for m in recording.messages(tuple(TOPICS))]
    assert recording.complete
    end = max(record.frame_id for _, record in found)
    return {
        topic: [untimed(record) for name, record in found if name == topic and record.frame_id < end]
        for topic in TOPICS
    }


def test_three_processes_give_the_bytes_of_one(drive: Path, place: Path) -> None:
    """The drive backwards after itself: an implausible motion, and a new world once the odometry is steady again; one
    image of it is torn, and a sensor of the car's speed fails.
    """
    sequence, speed, file = place / "sequences" / "back", place / "speed.csv", place / "back.mcap"
    (sequence / "image_0").mkdir(parents=True)
    shown = [*range(FRAMES), *range(FRAMES - 2, -1, -1)]
    for number, image in enumerate(drive / "image_0" / f"{k:06d}.png" for k in shown):
        data = image.read_bytes()
        (sequence / "image_0" / image.with_stem(f"{number:06d}").name).write_bytes(
            data[: len(data) // 3] if number == TORN else data
        )
    (sequence / "calib.txt").write_text((drive / "calib.txt").read_text())
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(len(shown))))
    speed.write_text("".join(f"{0.02 * n:.2f} {'nan' if n == 30 else 8.0}\n" for n in range(120)))

    run = Run(
        *(place, "--source", f"kitti:{sequence}", "--rate", "max", "--speed", str(speed)),
        *("--record", str(file), *WITH_NETWORKS),
    )
    status, out, err = run.end()
    assert (status, err) == (0, "")
    assert f"{TORN:06d}.png" in out
    assert "networks ran on" in out

    live = records_of_three(file)
    assert live == records_of_one_process(sequence, {}, speed)
    verdict = compare(Recording(file))
    assert verdict.same, verdict.difference
    assert verdict.equal == len(shown) + 1  # the end too
    estimates = [decode(data, Estimate) for data in live["v1/estimate"]]
    assert any(Status.MOTION_IMPLAUSIBLE in estimate.status for estimate in estimates)
    assert estimates[-1].epoch > estimates[FRAMES - 1].epoch
    refs = [decode(message.data, FrameRef) for message in Recording(file).messages(("v1/frame",))]
    log = read_speeds(speed)
    for ref in refs[: len(shown)]:
        wanted = msgspec.structs.replace(ref, speeds=log.until(ref.t_source_ns))
        assert encode(ref) == encode(wanted)  # bytes, since a reading that is no number equals nothing
        assert wanted.speeds

    summary = run.summary()
    assert (summary["frames_in"], summary["frames_processed"], summary["frames_dropped"]) == (len(shown), len(shown), 0)
    assert summary["statuses"]["frame_unreadable"] == 1
    assert summary["statuses"].get("not_initialised", 0) <= 6
    assert summary["ended"] == "end of source"
    assert set(summary["age_ms"]) == {"p50", "p99", "max"}
    assert summary["configuration"]["camera"]["width_px"] == WIDTH
    assert run.left_behind() == []


def test_evaluation_prints_the_path_of_the_drive(drive: Path, place: Path) -> None:
    assert len(evaluate(drive, place / "a", "--model", "none").splitlines()) == FRAMES
    report = json.loads((place / "a" / "report.json").read_text())
    assert [(row["sequence"], row["frames"]) for row in report] == [("77", FRAMES)]
    assert report[0]["path_m"] == pytest.approx(0.8 * (FRAMES - 1))


@pytest.mark.slow  # as the drive before it, which has networks too
def test_real_frames_and_networks_too(data_dir: Path, models_dir: Path, place: Path) -> None:
    networks = {"detector": "yolox_nano_416.onnx", "segmenter": "twinlitenet_640x360.onnx"}
    named = [f"--model={role}={models_dir / file}" for role, file in networks.items()]
    options = ["--stride", "6", "--model", "none", *named]
    sequence = data_dir / "kitti_odometry" / "sequences" / "06"
    offline = evaluate(sequence, place / "a", *options)
    run = run_all(place, sequence, "--rate", "max", "--record", str(place / "real.mcap"), *options)
    assert (run.output / "ego.kitti.txt").read_bytes() == offline
    paths = {f"models.{role}.path": str(models_dir / file) for role, file in networks.items()}
    overrides = {"source.stride": 6, "models.shipped": False, **paths}
    assert records_of_three(place / "real.mcap") == records_of_one_process(sequence, overrides)
    assert compare(Recording(place / "real.mcap")).same
    summary = run.summary()
    assert {role: model["file"] for role, model in summary["models"].items()} == networks
    assert all(len(model["sha256"]) == 64 for model in summary["models"].values())
    assert (run.output / "bev.png").stat().st_size > 1000


def test_a_slow_reader_costs_dropped_frames_that_are_counted(drive: Path, place: Path) -> None:
    count = 1500  # perceive sees several frames even if its first one takes long
    run = run_all(place, drive, "--rate", "1000", "--set", "source.loop=true", "--set", f"source.frames={count}")
    summary = run.summary()
    assert summary["frames_in"] == count
    assert summary["frames_processed"] < count
    assert summary["dropped_by"]["perceive"] > 0
    assert summary["frames_dropped"] == count - summary["frames_processed"]
    assert summary["statuses"]["frames_dropped"] > 0


def measured(planner: Planner) -> Estimate:
    """The next measured estimate. On a busy computer a frame has a prediction first, and then its measurement."""
    while True:
        estimate = planner.wait(LIMIT_S)
        if Status.PERCEPTION_LATE not in estimate.status:
            return estimate


def test_planner_second_instance_and_interrupt(drive: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begun_ns = time.monotonic_ns()
    with Run(place, "--source", f"kitti:{drive}", "--set", "source.loop=true") as run:
        with Planner(run.vehicle, run.runtime_dir) as planner:
            first, second = measured(planner), measured(planner)
            assert second.frame_id > first.frame_id
            reading = planner.latest(max_age_ms=1e3 * LIMIT_S)
            assert reading.alive
            assert reading.on_time
            assert reading.estimate is not None

            rival = ("run", "--source", f"kitti:{drive}", "--vehicle", run.vehicle, "--output", str(place / "rival"))
            assert main([*rival, "--set", f"runtime.runtime_dir={run.runtime_dir}"]) == 2
            said = capsys.readouterr().err
            assert said.startswith(f"birdslam: vehicle '{run.vehicle}' already runs")
            assert said.count("\n") == 1
            assert not (place / "rival").exists()

            heard = call(
                *("listen", "--vehicle", run.vehicle, "--runtime-dir", str(run.runtime_dir)),
                *("--json", "--count", "2", "--timeout", f"{LIMIT_S:g}"),
            )
            assert heard.returncode == 0, heard.stderr
            epochs = [json.loads(line)["epoch"] for line in heard.stdout.splitlines()]
            last = planner.latest(max_age_ms=1e3 * LIMIT_S).estimate
            assert len(epochs) == 2
            assert [first.epoch, *epochs, last.epoch] == sorted([first.epoch, *epochs, last.epoch])
            assert last.t_capture_ns - begun_ns >= 100_000_000 * last.frame_id  # a recording keeps its own time

            nodes = [run.node_pid(name) for name in ("capture", "perceive", "optimize")]
            run.process.send_signal(signal.SIGINT)
            status, out, err = run.end()
            for estimate in iter(lambda: planner.wait(LIMIT_S), None):
                if Status.END_OF_SOURCE in estimate.status:
                    break
            else:
                raise AssertionError("the planner was not told of the end")
        assert (status, err) == (130, ""), out
        wait_gone(nodes)
        assert run.left_behind() == []
        summary = run.summary()
        assert summary["ended"] == "SIGINT"
        assert set(summary["stages_ms"]) == {
            *("capture", "capture -> perceive", "perceive queue", "perceive"),
            *("perceive -> optimize", "optimize queue", "optimize", "optimize -> planner"),
        }
        assert len((run.output / "ego.kitti.txt").read_text().splitlines()) == summary["frames_in"]


def wait_measured(planner: Planner) -> None:
    """Until an estimate rests on measurements of its frame."""
    until_s = time.monotonic() + LIMIT_S
    while (estimate := planner.wait(LIMIT_S)) is None or Status.PERCEPTION_LATE in estimate.status:
        assert time.monotonic() < until_s


def test_without_restarts_a_stalled_node_ends_the_run_with_its_name(drive: Path, place: Path) -> None:
    with Run(place, "--source", f"kitti:{drive}", "--set", "source.loop=true", "--set", "runtime.restart=never") as run:
        with Planner(run.vehicle, run.runtime_dir) as planner:
            wait_measured(planner)
        run.stall("optimize")
        status, _, err = run.end()
        assert status == 1
        assert err.startswith(f"birdslam: optimize is stalled: no heartbeat for {1e3 * LIMIT_S:g} ms")
        assert err.count("\n") == 1
        assert run.summary()["frames_processed"] > 0
        assert run.left_behind() == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--model", "detector={place}/no.onnx"], "no.onnx: the network can't be read"),
        (["--camera", "{place}/camera.toml"], "camera.toml"),
        (["--output", "{place}/file/out"], "file/out"),
    ],
)
def test_user_errors_are_named_before_start(
    drive: Path, place: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "file").touch()
    (place / "camera.toml").write_text("width_px = 480\nheight_px = 161\nfx_px = -1.0\n")
    status, out, err = refused(drive, place, capsys, *(text.format(place=place) for text in arguments))
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert said in err


def refused(drive: Path, place: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit status and output of a run that cannot start and leaves nothing behind."""
    status = main(
        [
            *("run", "--vehicle", "test", "--source", f"kitti:{drive}", "--output", str(place / "out")),
            *("--set", f"runtime.runtime_dir={place / 'rt'}", "--set", "models.shipped=false", *arguments),
        ]
    )
    assert left_behind("test", place / "rt") == []
    return status, *capsys.readouterr()


def test_a_manifest_that_does_not_fit_its_network(
    drive: Path, models_dir: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = place / "wrong.toml"
    shipped = Path(__file__).parent.parent / "birdslam" / "perception" / "manifests" / "twinlitenet_640x360.toml"
    manifest.write_text(shipped.read_text().replace("640", "320"))
    path = models_dir / "twinlitenet_640x360.onnx"
    chosen = ("--model", f"segmenter={path}", "--set", f"models.segmenter.manifest={manifest}")
    status, out, err = refused(drive, place, capsys, *chosen)
    assert (status, out) == (2, "")
    assert str(path) in err
    assert "input.width_px" in err
    assert err.count("\n") == 1


def test_killed_capture_resumes_until_it_fails_too_often(drive: Path, place: Path) -> None:
    with Run(
        *(place, "--source", f"kitti:{drive}", "--set", "source.loop=true", *UNHURRIED),
        *("--set", "runtime.spares=true", "--set", "runtime.restarts_max=1"),
    ) as run:
        with Planner(run.vehicle, run.runtime_dir) as planner:
            before = planner.wait(LIMIT_S)
            while before is None or before.frame_id < 5:
                before = planner.wait(LIMIT_S)
            os.kill(run.node_pid("capture"), signal.SIGKILL)
            t_killed_ns = time.monotonic_ns()
            after = planner.wait(LIMIT_S)
            while after is None or after.t_capture_ns < t_killed_ns:
                after = planner.wait(LIMIT_S)
            frames, time_ns = after.frame_id - before.frame_id, after.t_source_ns - before.t_source_ns
            assert frames >= 2  # the missing number reveals the gap to perceive
            assert time_ns == pytest.approx(frames * 100_000_000, abs=1000)
        os.kill(run.node_pid("capture"), signal.SIGKILL)
        status, out, err = run.end()
        assert status == 1
        assert "capture was killed by SIGKILL" in out
        assert err.startswith("birdslam: capture was killed by SIGKILL")
        assert err.endswith("2 times in 60 s: it is not restarted\n")
        assert err.count("\n") == 1
        assert run.summary()["restarts"] == {"optimize": 0, "perceive": 0, "capture": 1}
        assert run.left_behind() == []


def grows_too_old(estimates: list[Estimate]) -> bool:
    """Whether the second of two predicts the frame after the first one's, with no image used in between."""
    kinds = [{Status.COASTING, Status.COASTED_TOO_LONG} & set(estimate.status) for estimate in estimates]
    consecutive = len({estimate.frame_id - k for k, estimate in enumerate(estimates)}) == 1
    return consecutive and kinds == [{Status.COASTING}, {Status.COASTING, Status.COASTED_TOO_LONG}]


def test_degraded_modes_are_reported_and_no_wrong_pose_is_valid(drive: Path, place: Path) -> None:
    """With a budget that nothing can keep, perceive goes down to coasting, and that grows old."""
    budgets = ("capture_ms", "capture_to_perceive_ms", "perceive_ms")
    with (
        Run(
            *(place, "--source", f"kitti:{drive}", "--set", "source.loop=true", *WITH_NETWORKS),
            *(part for name in budgets for part in ("--set", f"budgets.{name}=0.001")),
            *("--set", "degradation.window_frames=2", "--set", "degradation.coast_divisor=6"),
            *("--set", "degradation.coast_max_ms=250", "--set", "budgets.end_to_end_ms=60000"),  # optimize has time
        ) as run,
        Planner(run.vehicle, run.runtime_dir) as planner,
        Bus(run.vehicle, "reader", runtime_dir=run.runtime_dir) as bus,
    ):
        health = bus.subscriber("health/perceive")
        seen: list[Estimate] = []
        while not grows_too_old(seen[-2:]):
            message = planner.wait_message(LIMIT_S)
            assert message.trace.left_ns is not None
            assert [stage.node for stage in message.trace.stages] == ["capture", "perceive", "optimize"]
            seen.append(message.record)
        assert not seen[-1].valid
        before, after = (np.linalg.det(np.reshape(e.cov, (3, 3))) for e in seen[-2:])
        assert after > before  # the axes turn with the car: no single variance has to grow
        assert all(e.valid == INVALIDATING.isdisjoint(e.status) for e in seen)
        reading = planner.latest(max_age_ms=1e9)
        assert reading.left_ms is not None
        assert not reading.usable or reading.estimate != seen[-1]
        said = health.recv(LIMIT_S)
        while said is None or said.record.mode != "coasting":
            said = health.recv(LIMIT_S)
        assert said.record.overruns > 0
        assert said.record.step.p50_ms > 0.0
        assert said.record.rss_bytes > 0
