"""A running vehicle with a faulty software camera, and a planner that observes it, for faults.py and soak.py.

The camera (faulty_camera/) shows an endless street (perf/accuracy/street.py) at constant speed, so that time determines
the true position.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
import psutil

from birdslam.perf.accuracy.street import F_PX, FRAME_M, HEIGHT_M, HEIGHT_PX, WIDTH_PX, street_loop
from birdslam.perf.processes import birdslam_command, processes_of
from birdslam.runtime.client import Planner
from birdslam.runtime.process import realtime
from birdslam.runtime.process.vitals import COUNTERS
from birdslam.runtime.topology import NODES, PROCESSES
from birdslam.types import Estimate

ROOT = Path(__file__).resolve().parent.parent.parent
RATE_HZ = 15.0
SETTLE_S, PATIENCE_S = 2.5, 20.0
WITHOUT_SPARES = ("--set", "runtime.spares=false")
VITALS = "memfd:birdslam-vitals"


def exit_on_sigterm() -> None:
    """Makes SIGTERM end the suite and its vehicle, as Ctrl-C does."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))


class Vehicle:
    """`birdslam run` with the faulty camera, and a planner; a context manager.

    `source`: a recording, played in a loop, that replaces the camera.
    """

    vehicle = "faults"

    def __init__(self, place: Path, *options: str, rate_hz: float = RATE_HZ, source: str = "") -> None:
        self.place, self.runtime_dir, self.output = place, place / "rt", place / "out"
        self.rate_hz, self.period_ns = rate_hz, round(1e9 / rate_hz)
        self.camera = place / "camera"
        self._options = options
        self._spares = 0 if WITHOUT_SPARES[1] in options else len(NODES)
        self._input = ("--source", source, "--rate", f"{rate_hz:g}", "--set", "source.loop=true")
        self._environment = {**os.environ}
        if not source:
            self._make_camera()
            camera_file = f"camera={place / 'camera.toml'}"
            self._input = ("--source", f"v4l2:{self.camera}", "--model", "none", "--set", camera_file)
        self.start()

    def _make_camera(self) -> None:
        """Writes the software camera, which replaces OpenCV's in all processes of the vehicle."""
        path = os.pathsep.join(
            [str(ROOT / "perf" / "robustness" / "faulty_camera"), str(ROOT), os.environ.get("PYTHONPATH", "")]
        )
        self._environment |= {"PYTHONPATH": path, "FAULTY_CAMERA": str(self.camera)}
        self.camera.mkdir(exist_ok=True)
        np.save(self.camera / "frames.npy", street_loop())
        (self.camera / "rate_hz").write_text(f"{self.rate_hz}")
        self.fault("")
        (self.place / "camera.toml").write_text(
            f"width_px = {WIDTH_PX}\nheight_px = {HEIGHT_PX}\nfx_px = {F_PX}\nfy_px = {F_PX}\n"
            f"cx_px = {WIDTH_PX / 2}\ncy_px = {HEIGHT_PX / 2}\nheight_m = {HEIGHT_M}\n"
        )

    def start(self) -> None:
        """Starts the system, also after it was killed."""
        settings = {"runtime.runtime_dir": self.runtime_dir, "runtime.restarts_max": 1000, "runtime.watchdog_ms": 1000}
        with (self.place / "run.log").open("ab") as log:
            self.process = subprocess.Popen(
                [
                    *birdslam_command("run", *self._input),
                    *("--vehicle", self.vehicle, "--output", str(self.output)),
                    *(part for key, value in settings.items() for part in ("--set", f"{key}={value}")),
                    *self._options,
                ],
                stdout=log,
                stderr=log,
                env=self._environment,
                start_new_session=True,
            )

    def fault(self, name: str) -> None:
        """Sets the camera's fault from the next frame on."""
        draft = self.camera / "draft"
        draft.write_text(name)
        draft.rename(self.camera / "fault")

    def truth_m(self, t_capture_ns: int) -> float:
        """True position along the road, to within one frame."""
        return math.floor(t_capture_ns * 1e-9 * self.rate_hz) * FRAME_M

    def node(self, name: str) -> psutil.Process:
        """The active process of a node."""
        return self.processes()[name]

    def spares(self) -> int:
        """The number of prepared spare processes."""
        return sum(map(_is_prepared, psutil.Process(self.process.pid).children())) - len(NODES)

    def processes(self) -> dict[str, psutil.Process]:
        """All processes by name: supervisor, nodes, spares, and the recorder if there is one."""
        return processes_of(self.process.pid, PROCESSES)

    def __enter__(self) -> Self:
        self.planner = Planner(self.vehicle, self.runtime_dir)
        self.wait_until_valid()
        return self

    def wait_until_valid(self, settle_s: float = SETTLE_S) -> None:
        """Waits until estimates have been valid for `settle_s` and all spares are prepared.

        Spares load at idle priority, which may take forever on a busy machine; their priority is raised here.
        """
        until_s, calm_s = time.monotonic() + 12 * PATIENCE_S, 0.0
        while calm_s < settle_s or self.spares() < self._spares:
            self._let_spares_load()
            if time.monotonic() > until_s or self.process.poll() is not None:
                raise TimeoutError(f"no valid estimates: {(self.place / 'run.log').read_text()[-2000:]}")
            begun_s = time.monotonic()
            estimate = self.planner.wait(1.0)
            calm_s = calm_s + time.monotonic() - begun_s if estimate is not None and estimate.valid else 0.0

    def _let_spares_load(self) -> None:
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            for process in psutil.Process(self.process.pid).children():
                if os.sched_getscheduler(process.pid) == os.SCHED_IDLE and not _is_prepared(process):
                    realtime.raise_from_idle(process.pid)

    def watch(self, see: Callable[[Estimate | None], bool], limit_s: float) -> bool:
        """Passes each estimate (None: none for a moment) to `see` until it returns true; False after `limit_s`."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s:
            if see(self.planner.wait(0.05)):
                return True
        return False

    def stop(self) -> int:
        """Shuts down in order; returns the exit status."""
        self.process.terminate()
        return self.process.wait(6 * PATIENCE_S)

    def __exit__(self, *failure: object) -> None:
        self.planner.close()
        if self.process.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.stop()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def _is_prepared(process: psutil.Process) -> bool:
    """Whether a spare is prepared, by its counters (runtime/process/vitals.py); false for a recorder."""
    try:
        for descriptor in Path(f"/proc/{process.pid}/fd").iterdir():
            if VITALS in os.readlink(descriptor):
                counters = np.frombuffer(descriptor.read_bytes(), dtype=np.int64)
                return bool(counters[COUNTERS.index("prepared")])
    except OSError:  # the process has ended
        return False
    return False


def record_options(place: Path) -> list[str]:
    """The options for a recording of each start."""
    folder = place / "recordings"
    folder.mkdir(exist_ok=True)
    return ["--record", str(folder)]


def model_options(folder: Path | None) -> list[str]:
    """The options for both networks, if the folder has them."""
    networks = {"detector": "yolox_nano_416.onnx", "segmenter": "twinlitenet_640x360.onnx"}
    if folder is None or not all((folder / file).is_file() for file in networks.values()):
        return []
    return [f"--model={role}={(folder / file).resolve()}" for role, file in networks.items()]
