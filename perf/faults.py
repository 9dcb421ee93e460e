"""The fault suite: a running vehicle, one fault after the other, and what its planner sees of each.

    python -m perf.faults [--models DIR] [--markdown FILE] [NAME ...]

Each row: how long until the planner has a valid estimate again (from the fault's beginning where a process is hit, from
its end where the world is), what it was told meanwhile, and whether anything invalid was marked valid.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
import psutil
from numpy.typing import NDArray

from birdslam.types import INVALIDATING, Estimate, Status
from runtime.client import Planner
from runtime.topology import NODES, key_of

ROOT = Path(__file__).resolve().parent.parent
WIDTH_PX, HEIGHT_PX, F_PX, HEIGHT_M = 480, 160, 260.0, 1.65
LOOP_FRAMES, TEXELS, TEXELS_PER_M = 128, 2048, 24.0
RATE_HZ = 15.0
SETTLE_S, PATIENCE_S = 2.5, 20.0
PROMISE_S = {"capture": 1.0, "perceive": 2.0, "optimize": 1.0}  # to a valid estimate after kill -9 (issue 6)


def road_loop() -> NDArray[np.uint8]:
    """(frames, height, width): a drive at constant speed over a textured road, whose end meets its beginning."""
    u, v = np.meshgrid(np.arange(WIDTH_PX, dtype=np.float32), np.arange(HEIGHT_PX, dtype=np.float32))
    depth = F_PX * HEIGHT_M / np.maximum(v - HEIGHT_PX / 2, 0.5)
    side = ((u - WIDTH_PX / 2) * depth / F_PX * TEXELS_PER_M + TEXELS / 2).astype(np.float32)
    noise = np.random.default_rng(5).integers(0, 256, (TEXELS, TEXELS), dtype=np.uint8)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0, borderType=cv2.BORDER_REFLECT)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    frames = []
    for number in range(LOOP_FRAMES):
        ahead = (depth * TEXELS_PER_M + number * TEXELS / LOOP_FRAMES).astype(np.float32)
        road = cv2.remap(texture, side, ahead, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        frames.append(np.where(v > HEIGHT_PX / 2 + 4, road, 200).astype(np.uint8))
    return np.stack(frames)


@dataclass
class Seen:
    """What the planner saw while a fault went on, and until it was over."""

    estimates: list[tuple[int, Estimate]] = field(default_factory=list)  # received (CLOCK_MONOTONIC ns)
    stale_ms: float = 0.0  # longest silence

    def wrongly_valid(self, blind: tuple[int, int] | None) -> int:
        """Estimates marked valid that can't be: by their own status, or captured while the camera showed nothing."""
        wrong = 0
        for _, estimate in self.estimates:
            contradicts = not INVALIDATING.isdisjoint(estimate.status)
            blinded = blind is not None and blind[0] <= estimate.t_capture_ns <= blind[1]
            wrong += estimate.valid and (contradicts or blinded or not np.isfinite(estimate.cov).all())
        return wrong

    def story(self) -> str:
        """For the table."""
        invalid = sum(not estimate.valid for _, estimate in self.estimates)
        statuses = Counter(status.value for _, estimate in self.estimates for status in estimate.status)
        epochs = {estimate.epoch for _, estimate in self.estimates}
        carried = (Status.DETECTIONS_CARRIED, Status.SEGMENTATION_CARRIED)
        told = [f"{name} {n}" for name, n in statuses.most_common(6) if name not in carried]
        new = f", {len(epochs) - 1} new epochs" if len(epochs) > 1 else ""
        silence = f"silent for {self.stale_ms:.0f} ms at the most"
        return f"{len(self.estimates)} estimates, {invalid} invalid, {silence}{new}; {', '.join(told) or 'no status'}"


@dataclass
class Row:
    """One line of the table."""

    fault: str
    node: str
    valid_after_ms: float | None
    seen: str
    wrongly_valid: int
    promise_s: float | None = None


class Vehicle:
    """`birdslam run` with the faulty camera, and a planner; a context manager."""

    vehicle = "faults"

    def __init__(self, place: Path, *options: str, rate_hz: float = RATE_HZ) -> None:
        self.place, self.runtime_dir, self.output = place, place / "rt", place / "out"
        self.camera = place / "camera"
        self.camera.mkdir(exist_ok=True)
        np.save(self.camera / "frames.npy", road_loop())
        (self.camera / "rate_hz").write_text(f"{rate_hz}")
        self.period_ns = round(1e9 / rate_hz)
        self.fault("")
        (place / "camera.toml").write_text(
            f"width_px = {WIDTH_PX}\nheight_px = {HEIGHT_PX}\nfx_px = {F_PX}\nfy_px = {F_PX}\n"
            f"cx_px = {WIDTH_PX / 2}\ncy_px = {HEIGHT_PX / 2}\nheight_m = {HEIGHT_M}\n"
        )
        self._options = options
        self.start()

    def start(self) -> None:
        """Starts the system; again, where it was killed."""
        path = os.pathsep.join([str(ROOT / "perf" / "faulty_camera"), str(ROOT), os.environ.get("PYTHONPATH", "")])
        settings = {
            "runtime.runtime_dir": self.runtime_dir,
            "runtime.restarts_max": 1000,
            "runtime.watchdog_ms": 1000,
            "camera": self.place / "camera.toml",
        }
        with (self.place / "run.log").open("ab") as log:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "runtime.cli", "run", "--source", f"v4l2:{self.camera}"),
                    *("--vehicle", self.vehicle, "--output", str(self.output)),
                    *(part for key, value in settings.items() for part in ("--set", f"{key}={value}")),
                    *self._options,
                ],
                stdout=log,
                stderr=log,
                env={**os.environ, "PYTHONPATH": path, "FAULTY_CAMERA": str(self.camera)},
                start_new_session=True,
            )

    def fault(self, name: str) -> None:
        """The camera does this from its next frame on."""
        draft = self.camera / "draft"
        draft.write_text(name)
        draft.rename(self.camera / "fault")

    def node(self, name: str) -> psutil.Process:
        """The process of a node that is at work: the spare beside it is younger."""
        found = [child for child in psutil.Process(self.process.pid).children() if _is_node(child, name)]
        return min(found, key=lambda child: (child.create_time(), child.pid))

    def spares(self) -> int:
        """Processes that stand by."""
        return len(psutil.Process(self.process.pid).children()) - len(NODES)

    def __enter__(self) -> Self:
        self.planner = Planner(self.vehicle, self.runtime_dir)
        self.settle()
        return self

    def settle(self, settle_s: float = SETTLE_S) -> None:
        """Until estimates are valid and have been for a while, and spares stand by."""
        until_s, calm_s = time.monotonic() + 3 * PATIENCE_S, 0.0
        while calm_s < settle_s or self.spares() < len(NODES):
            if time.monotonic() > until_s or self.process.poll() is not None:
                raise TimeoutError(f"no valid estimates: {(self.place / 'run.log').read_text()[-2000:]}")
            begun_s = time.monotonic()
            estimate = self.planner.wait(1.0)
            calm_s = calm_s + time.monotonic() - begun_s if estimate is not None and estimate.valid else 0.0

    def watch(self, seen: Seen, until: Callable[[Estimate | None], bool], limit_s: float) -> bool:
        """Takes what the planner gets, until a condition holds; whether it did in time."""
        end_s = time.monotonic() + limit_s
        last_ns = seen.estimates[-1][0] if seen.estimates else time.monotonic_ns()
        while time.monotonic() < end_s:
            estimate = self.planner.wait(0.05)
            now_ns = time.monotonic_ns()
            seen.stale_ms = max(seen.stale_ms, (now_ns - last_ns) / 1e6)
            if estimate is not None:
                last_ns = now_ns
                seen.estimates.append((now_ns, estimate))
            if until(estimate):
                return True
        return False

    def stop(self) -> int:
        """An ordered end; gives the exit status."""
        self.process.terminate()
        return self.process.wait(30.0)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.planner.close()
        if self.process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.stop()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _is_node(process: psutil.Process, name: str) -> bool:
    try:
        return name in process.cmdline()
    except psutil.Error:  # it has just ended
        return False


@dataclass(frozen=True)
class Fault:
    """`strike` is a context: the fault goes on inside it, for `lasts_s`."""

    name: str
    node: str
    strike: Callable[[Vehicle], contextlib.AbstractContextManager[None]]
    lasts_s: float = 0.0
    blind: bool = False  # nothing captured meanwhile may be valid
    promise_s: float | None = None


def inflict(vehicle: Vehicle, fault: Fault) -> Row:
    """One fault, from its beginning until the planner drives on."""
    seen = Seen()
    begun_ns = time.monotonic_ns()
    with fault.strike(vehicle):
        if fault.lasts_s:
            vehicle.watch(seen, lambda estimate: False, fault.lasts_s)
        ended_ns = time.monotonic_ns()
    blind = (begun_ns + 3 * vehicle.period_ns, ended_ns - vehicle.period_ns) if fault.blind else None

    def well(estimate: Estimate | None) -> bool:
        return estimate is not None and estimate.valid and estimate.t_capture_ns >= ended_ns

    # A fault of a process is over when it strikes: it counts from there; one of the world counts from its end
    back = vehicle.watch(seen, well, PATIENCE_S)
    after_ms = (seen.estimates[-1][0] - ended_ns) / 1e6 if back else None
    return Row(fault.name, fault.node, after_ms, seen.story(), seen.wrongly_valid(blind), fault.promise_s)


def _signal(node: str, number: signal.Signals, then: signal.Signals | None = None) -> Callable[[Vehicle], object]:
    @contextlib.contextmanager
    def strike(vehicle: Vehicle) -> Iterator[None]:
        process = vehicle.node(node)
        process.send_signal(number)
        yield
        if then is not None:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(then)

    return strike


def _camera(name: str) -> Callable[[Vehicle], object]:
    @contextlib.contextmanager
    def strike(vehicle: Vehicle) -> Iterator[None]:
        vehicle.fault(name)
        yield
        vehicle.fault("")

    return strike


@contextlib.contextmanager
def _cpu_hog(vehicle: Vehicle) -> Iterator[None]:
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def _no_memory(node: str) -> Callable[[Vehicle], object]:
    """No further page: the process has what it has."""

    @contextlib.contextmanager
    def strike(vehicle: Vehicle) -> Iterator[None]:
        process = vehicle.node(node)
        limit = process.memory_info().vms
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit, limit))
        yield

    return strike


@contextlib.contextmanager
def _full_disk(vehicle: Vehicle) -> Iterator[None]:
    resource.prlimit(vehicle.process.pid, resource.RLIMIT_FSIZE, (1, resource.RLIM_INFINITY))
    yield
    resource.prlimit(vehicle.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


_SENDER = """
import sys, time
from pathlib import Path
import numpy as np
from runtime.bus import Bus
keys, size, count = sys.argv[2].split(","), int(sys.argv[3]), int(sys.argv[4])
random = np.random.default_rng(7)
with Bus("faults", "intruder", runtime_dir=Path(sys.argv[1])) as bus:
    assert not bus.wait_alive(("capture", "perceive", "optimize"), 10.0)
    out = [bus._session.declare_publisher(key) for key in keys]
    print("at work", flush=True)
    for number in range(count):
        for publisher in out:
            publisher.put(random.bytes(size))
        if size < 10_000:
            time.sleep(0.001)
"""


def _intruder(topics: tuple[str, ...], size: int, count: int) -> Callable[[Vehicle], object]:
    """Random bytes on topics of the bus, as a program of the vehicle's own user could send them."""

    @contextlib.contextmanager
    def strike(vehicle: Vehicle) -> Iterator[None]:
        keys = ",".join(key_of(vehicle.vehicle, topic) for topic in topics)
        sender = subprocess.Popen(
            [sys.executable, "-c", _SENDER, str(vehicle.runtime_dir), keys, str(size), str(count)],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert sender.stdout is not None
        try:
            assert sender.stdout.readline().strip() == b"at work"
            yield
        finally:
            sender.kill()
            sender.communicate()

    return strike


_SLOW = """
import sys
from pathlib import Path
from runtime.client import Planner
with Planner("faults", Path(sys.argv[1])) as planner:
    planner.wait(10.0)
    print("at work", flush=True)
    while True:
        planner.wait()
"""


@contextlib.contextmanager
def _slow_planner(vehicle: Vehicle) -> Iterator[None]:
    """Another planner that stops reading altogether."""
    slow = subprocess.Popen(
        [sys.executable, "-c", _SLOW, str(vehicle.runtime_dir)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert slow.stdout is not None
    try:
        assert slow.stdout.readline().strip() == b"at work"
        slow.send_signal(signal.SIGSTOP)
        yield
    finally:
        slow.kill()
        slow.communicate()


@contextlib.contextmanager
def _kill_everything(vehicle: Vehicle) -> Iterator[None]:
    """And a second start over what is left."""
    everybody = [psutil.Process(vehicle.process.pid), *psutil.Process(vehicle.process.pid).children()]
    for process in everybody:
        process.kill()
    vehicle.process.wait()
    psutil.wait_procs(everybody, timeout=10.0)
    vehicle.start()
    yield


def _faults() -> Iterator[Fault]:
    for node in NODES:
        kill = _signal(node, signal.SIGKILL)
        yield Fault("kill -9", node, kill, promise_s=PROMISE_S[node])  # type: ignore[arg-type]
    for node in NODES:
        stop = _signal(node, signal.SIGSTOP, then=signal.SIGCONT)
        yield Fault("SIGSTOP 2 s", node, stop, lasts_s=2.0)  # type: ignore[arg-type]
    for node in NODES:
        yield Fault("out of memory", node, _no_memory(node), lasts_s=2.0)  # type: ignore[arg-type]
    yield Fault("CPU hog, 2 a core, 3 s", "all", _cpu_hog, lasts_s=3.0)
    for name, blind in (("gone", True), ("frozen", True), ("black", True), ("torn", True)):
        yield Fault(f"camera {name} 1.5 s", "capture", _camera(name), lasts_s=1.5, blind=blind)  # type: ignore[arg-type]
    yield Fault("frames 400 ms late, 2 s", "capture", _camera("late"), lasts_s=2.0)  # type: ignore[arg-type]
    yield Fault("frames out of order, 2 s", "capture", _camera("disorder"), lasts_s=2.0)  # type: ignore[arg-type]
    yield Fault("UTC steps by 1 h and back", "all", _camera("clock_step"), lasts_s=1.5)  # type: ignore[arg-type]
    hot = ("frame", "measurements", "estimate")
    yield Fault("malformed messages", "all", _intruder(hot, 300, 1000), lasts_s=1.5)  # type: ignore[arg-type]
    yield Fault("flooded bus (60 kB messages)", "all", _intruder(hot, 60_000, 100_000), lasts_s=2.0)  # type: ignore[arg-type]
    yield Fault("a planner that stands still", "planner", _slow_planner, lasts_s=3.0)
    yield Fault("kill -9 of everything, second start", "all", _kill_everything)
    yield Fault("full disk", "supervisor", _full_disk, lasts_s=2.0)  # the last one: the run's results stay incomplete


FAULTS = tuple(_faults())


def markdown(rows: list[Row]) -> str:
    """The table of the README."""
    lines = [
        "| fault | hits | valid again after | what the planner saw meanwhile | invalid marked valid |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        after = "not within its patience" if row.valid_after_ms is None else f"{row.valid_after_ms:.0f} ms"
        promise = f" (promise {row.promise_s:g} s)" if row.promise_s else ""
        lines.append(f"| {row.fault} | {row.node} | {after}{promise} | {row.seen} | {row.wrongly_valid} |")
    return "\n".join(lines)


def model_options(folder: Path | None) -> list[str]:
    """Both networks, where the folder has them."""
    networks = {"detector": "yolox_nano_416.onnx", "segmenter": "twinlitenet_640x360.onnx"}
    if folder is None or not all((folder / file).is_file() for file in networks.values()):
        return []
    return [f"--model={role}={(folder / file).resolve()}" for role, file in networks.items()]


def main(arguments: list[str]) -> int:
    """0 where every fault was survived, within its promise, and nothing invalid was marked valid."""
    parser = argparse.ArgumentParser(prog="python -m perf.faults", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="only faults whose name contains one of these")
    parser.add_argument("--models", type=Path, help="folder of networks, for perceive to carry their weight")
    parser.add_argument("--markdown", type=Path, help="the table goes there too")
    options = parser.parse_args(arguments)
    chosen = [f for f in FAULTS if not options.names or any(name in f"{f.name} {f.node}" for name in options.names)]
    rows: list[Row] = []
    with (
        tempfile.TemporaryDirectory(prefix="faults") as place,
        Vehicle(Path(place), *model_options(options.models)) as vehicle,
    ):
        for number, fault in enumerate(chosen):
            if number:
                vehicle.settle()
            rows.append(inflict(vehicle, fault))
            print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    print(f"\n{markdown(rows)}")
    if options.markdown:
        options.markdown.write_text(markdown(rows) + "\n")
    return int(not all(survived(row) for row in rows))


def survived(row: Row, slack: float = 1.0) -> bool:
    """Valid again, within its promise (times `slack`), and nothing invalid marked valid."""
    limit_ms = None if row.promise_s is None else row.promise_s * slack * 1e3
    in_time = row.valid_after_ms is not None and (limit_ms is None or row.valid_after_ms <= limit_ms)
    return in_time and row.wrongly_valid == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
