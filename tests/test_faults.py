"""A short form of the fault suite (perf/robustness/faults.py); `make faults` runs the whole."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from birdslam.perf.robustness.faults import markdown, measure, survived
from birdslam.perf.robustness.faulty_vehicle import Vehicle, model_options, record_options
from birdslam.perf.robustness.injection import FAULTS
from birdslam.runtime.topology import NODES
from birdslam.runtime.transport.presence import ring_path
from tests.test_pipeline import left_behind

pytestmark = pytest.mark.processes

SHORT = (*("kill -9 perceive", "camera gone 1.5 s capture", "malformed measurements messages optimize"),)
BUSY_MACHINE = 10.0  # so many times its promise may a restart take here; `make faults` holds it to 3
SEVERE = 3.0
PATIENT = ("--set", "runtime.watchdog_ms=20000")  # no fault of the short form is a node that stalls


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose path is short enough for sockets in it."""
    return tmp_path_factory.mktemp("f")


@pytest.fixture
def models_dir_if_any() -> Path | None:
    folder = Path(os.environ.get("BIRDSLAM_MODELS") or Path(__file__).resolve().parents[2] / "shared" / "models")
    return folder if folder.is_dir() else None


@pytest.mark.slow  # each node's death is in test_pipeline.py, test_recording.py and test_live_map.py
def test_faults_in_short(place: Path) -> None:
    with Vehicle(place, *PATIENT) as vehicle:
        for fault in FAULTS:
            if f"{fault.name} {fault.node}" not in SHORT:
                continue
            vehicle.wait_until_valid(0.5)
            row = measure(vehicle, fault)
            assert survived(row, BUSY_MACHINE), row
        vehicle.wait_until_valid(0.5)
        assert vehicle.stop() == 0
    assert left_behind(vehicle.vehicle, vehicle.runtime_dir) == []


@pytest.mark.slow
@pytest.mark.faults
@pytest.mark.timeout(900)
def test_every_fault(place: Path, models_dir_if_any: Path | None, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    with Vehicle(place, *model_options(models_dir_if_any), *record_options(place)) as vehicle:
        for fault in FAULTS:
            vehicle.wait_until_valid()
            rows.append(measure(vehicle, fault))
            with capsys.disabled():
                print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    assert [row for row in rows if not survived(row, SEVERE)] == []


def held(vehicle: Vehicle) -> dict[str, int]:
    """What a leak would add to."""
    supervisor = psutil.Process(vehicle.process.pid)
    ring = ring_path(vehicle.vehicle, vehicle.runtime_dir)
    return {
        "descriptors of the supervisor": supervisor.num_fds(),
        "threads of the supervisor": supervisor.num_threads(),
        "processes": len(supervisor.children()),
        "files in the runtime directory": sum(1 for _ in vehicle.runtime_dir.rglob("*")),
        "rings": len(list(ring.parent.glob(f"{ring.name}*"))),
        "descriptors of the planner": psutil.Process().num_fds(),
    }


def restarted(vehicle: Vehicle, times: int) -> Iterator[str]:
    """Kills the nodes in turn, so many times in all."""
    for number in range(times):
        name = tuple(NODES)[number % len(NODES)]
        vehicle.node(name).kill()
        vehicle.wait_until_valid(0.3)
        yield name


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_nothing_leaks_over_a_hundred_restarts(place: Path) -> None:
    with Vehicle(place, *PATIENT) as vehicle:
        for _ in restarted(vehicle, len(NODES)):  # once round, so that all is there that ever will be
            continue
        before = held(vehicle)
        epochs = [vehicle.planner.latest().estimate.epoch for _ in restarted(vehicle, 100)]
        until_s = time.monotonic() + 60.0
        while any(after > before[what] for what, after in held(vehicle).items()) and time.monotonic() < until_s:
            vehicle.planner.wait(0.1)  # a dead peer's link is given up after its lease
        after = held(vehicle)
        assert {what: n for what, n in after.items() if n > before[what]} == {}
        assert epochs == sorted(epochs)
        assert vehicle.stop() == 0
    assert left_behind(vehicle.vehicle, vehicle.runtime_dir) == []
