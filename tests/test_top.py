"""`birdslam top`: nodes that run, that are silent, that are gone; on a terminal and in a pipe."""

from __future__ import annotations

import io
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from birdslam.runtime.cli.vehicle.top import CLEAR, VehicleTable, top
from birdslam.runtime.configuration import BudgetsConfig, Configuration
from birdslam.runtime.topology import NODES
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.wire import Health, Spread, Stage, Trace
from birdslam.types import Estimate, SpeedSource, Status
from tests.records import new_estimate

pytestmark = pytest.mark.processes

LIMIT_S = 60.0


@pytest.fixture
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A bus with three nodes that have published their health, and a supervisor that answers queries."""
    place = tmp_path_factory.mktemp("t")
    with ExitStack() as stack:
        hub = stack.enter_context(Bus("car", "supervisor", hub=True, runtime_dir=place))
        hub.answer_queries(
            {"configuration": lambda parameters: (Configuration(budgets=BudgetsConfig(perceive_ms=77.0)),)}
        )
        for number, name in enumerate(NODES):
            bus = stack.enter_context(Bus("car", name, runtime_dir=place))
            health = Health(
                node=name,
                t_ns=time.monotonic_ns(),
                rate_hz=33.0 + number,
                step=Spread(1.5, 2.0, 2.5, 3.0),
                overruns=41,
                dropped=42,
                restarts=2 * (name == "perceive"),
                cause="was killed by SIGKILL" if name == "perceive" else "",
                speeds=4_900 * (name == "capture"),
                speeds_dropped=7 * (name == "capture"),
                malformed=2 * (name == "capture"),
                status=(Status.INPUT_STALE,) if name == "capture" else (),
            )
            bus.publisher(f"health/{name}").put(health)
            if name == "optimize":
                stages = (Stage("capture", 0, 1, 2), Stage("perceive", 3, 4, 5), Stage("optimize", 6, 7, 8))
                bus.publisher("estimate").put(estimate(), Trace(stages, left_ns=25_000_000))
            bus.declare_alive()
        yield place


def estimate() -> Estimate:
    return new_estimate(
        epoch=3,
        frame_id=123,
        t_capture_ns=time.monotonic_ns(),
        valid=False,
        status=(Status.CAMERA_DARK,),
        speed_sources=(SpeedSource.ROAD, SpeedSource.CAR),
    )


def row(text: str, name: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(f"{name} "))


def test_table_has_the_state_of_every_node(vehicle: Path) -> None:
    with Bus("car", f"top-{os.getpid()}", runtime_dir=vehicle) as bus:
        watch = VehicleTable(bus)
        watch.wait(LIMIT_S)
        now_ns = time.monotonic_ns()
        text = watch.table(now_ns)
        later = watch.table(now_ns + 60_000_000_000)
    assert "frame 123  epoch 3  NOT VALID" in text
    assert "25 ms of its budget left" in text
    assert "camera_dark" in text
    assert "scale from road and car" in text
    assert "vehicle speed: 4900 readings, 7 lost, 2 malformed" in text
    assert "stale" in row(text, "capture")
    perceive = row(text, "perceive")
    for cell in ("alive", "34.0", "1.5 / 2.5", "77", "41", "42"):
        assert cell in perceive.split() or cell in perceive, cell
    assert "perceive was restarted 2 times, the last time because it was killed by SIGKILL" in text
    assert "SILENT" in row(later, "optimize")
    assert "record" not in text  # nothing is recorded


def test_once_prints_one_table_without_control_characters(vehicle: Path) -> None:
    out = io.StringIO()
    assert top("car", vehicle, once=True, out=out) == 0
    assert "\x1b" not in out.getvalue()
    assert len(out.getvalue().splitlines()) == 7


def test_missing_vehicle_is_reported(tmp_path_factory: pytest.TempPathFactory) -> None:
    out = io.StringIO()
    assert top("car", tmp_path_factory.mktemp("n"), once=True, out=out) == 1
    assert "car: no estimate" in out.getvalue()
    assert all("GONE" in row(out.getvalue(), name) for name in NODES)


class Terminal(io.StringIO):
    """A terminal whose reader goes away after two tables."""

    def isatty(self) -> bool:
        return True

    def flush(self) -> None:
        if self.getvalue().count("optimize ") >= 2:
            raise KeyboardInterrupt


@pytest.mark.parametrize(("terminal", "in_place"), [("xterm", True), ("dumb", False)])
def test_a_terminal_is_refreshed_in_place_and_a_dumb_one_gets_lines(
    vehicle: Path, monkeypatch: pytest.MonkeyPatch, terminal: str, in_place: bool
) -> None:
    monkeypatch.setenv("TERM", terminal)
    out = Terminal()
    with pytest.raises(KeyboardInterrupt):
        top("car", vehicle, once=False, out=out)
    assert out.getvalue().count(CLEAR) == (2 if in_place else 0)
