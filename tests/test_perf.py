"""The perf suite: its statistics on known data, and its reports."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.perf.__main__ import main
from birdslam.perf.latency import system, transport
from birdslam.perf.latency.live import Run, Sample
from birdslam.perf.reporting import all as everything
from birdslam.perf.reporting import check
from birdslam.runtime.cli import main as birdslam
from birdslam.runtime.transport.bus import Message
from birdslam.runtime.wire import Stage, Trace
from birdslam.types import Estimate

MS = 1_000_000


def test_ratio_of_two_versions_is_the_median_over_the_rounds() -> None:
    """One disturbed round of five changes nothing."""
    times = [(np.full(50, 2.0), np.full(50, 3.0))] * 4 + [(np.full(50, 2.0), np.full(50, 90.0))]
    assert check.ratio(times, 50) == {"base_ms": 2.0, "ms": 3.0, "ratio": 1.5}


def test_check_of_an_unknown_commit_is_a_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--base", "no-such-commit"]) == 2
    assert "no-such-commit" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.processes
def test_check_fails_for_a_slower_version(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["check", "--base", "HEAD", "--rounds", "3", "--frames", "30"]
    monkeypatch.setattr(check, "LIMIT", 5.0)
    assert main(arguments) == 0
    monkeypatch.setattr(check, "LIMIT", 0.2)
    assert main(arguments) == 1


def _message(frame: int, slow_ms: int = 0) -> Message:
    due = frame * 30 * MS
    stages = (
        Stage("capture", due + 1 * MS, due + 2 * MS, due + 2 * MS),
        Stage("perceive", due + 3 * MS, due + (13 + slow_ms) * MS, due + (13 + slow_ms) * MS),
        Stage("optimize", due + (14 + slow_ms) * MS, due + (15 + slow_ms) * MS, due + (15 + slow_ms) * MS),
    )
    estimate = Estimate(frame_id=frame, t_source_ns=due, t_capture_ns=due, t_utc_ns=0, epoch=0, **_pose())
    return Message(estimate, Trace(stages), due + (17 + slow_ms) * MS)


def _pose() -> dict[str, Any]:
    return {"T_world_ego": SE2(), "cov": (0.0,) * 9, "valid": True}


def _run(budget_ms: float) -> Run:
    messages = [_message(frame, slow_ms=30 if frame % 100 == 50 else frame % 3) for frame in range(300)]
    samples = [
        Sample(float(second), {"perceive": 0.5 * second}, {"perceive": 100.0 + second, "optimize": 50.0})
        for second in range(9)
    ]
    summary = {
        "frames_in": 305,
        "frames_dropped": 5,
        "dropped_by": {"perceive": 5},
        "frames_processed": 300,
        "statuses": {},
        "restarts": {},
        "models": {},
        "configuration": {"budgets": {"perceive_ms": budget_ms}},
    }
    return Run(messages=messages, samples=samples, summary=summary, complete=True)


def test_the_parts_of_an_age_add_up_to_it() -> None:
    for message in (_message(1), _message(2, slow_ms=9)):
        assert sum(ms for _, ms in system.parts(message)) == pytest.approx(system.age_of(message))
    found = system.figures(_run(100.0))
    assert sum(stage["mean"] for stage in found["stages"].values()) == pytest.approx(found["age_ms"]["mean"], abs=1e-2)
    assert found["stages"]["perceive"]["mean_in_tail"] > 2 * found["stages"]["perceive"]["mean"]
    assert found["cpu_cores"] == pytest.approx(0.5)
    assert found["rss_mb"] == pytest.approx(158.0)
    assert found["dropped"] == 5
    assert found["rate_hz"] == pytest.approx(1e3 / 30.0, rel=0.01)


def test_budgets_are_those_of_the_configuration() -> None:
    held = {row["budget"]: row for row in system.figures(_run(100.0))["budgets"]}
    assert all(row["met"] for row in held.values())
    assert len(held) == 7
    broken = {row["budget"] for row in system.figures(_run(11.0))["budgets"] if not row["met"]}
    assert broken == {"perceive_ms"}


@pytest.mark.slow
@pytest.mark.processes
def test_the_shipped_drive_is_the_source_of_everything(tmp_path: Path) -> None:
    """One short run of the real processes: its keys are those that a report and a CI read."""
    path = tmp_path / "system.json"
    assert main(["system", "--source", "demo", "--seconds", "1", "--rate", "10", "--output", str(path)]) in (0, 1)
    found = json.loads(path.read_text())
    assert {"rate_hz", "dropped", "cpu_cores", "rss_mb", "age_ms", "stages", "start_late_ms"} <= found.keys()
    assert {"p50", "p99", "p999", "max"} <= found["age_ms"].keys()
    total = sum(stage["mean"] for stage in found["stages"].values())
    assert total == pytest.approx(found["age_ms"]["mean"], abs=1e-2)
    assert "multitask" in found["networks"]


def test_every_benchmark_has_a_label(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert {step.benchmark for step in everything.STEPS} | {"all", "check"} <= listed
    assert main(["nothing"]) == 2


@pytest.mark.processes
def test_carriers_deliver_every_message_of_a_slow_stream() -> None:
    rows = [transport.measure(transport.Case(carrier, 4_000, 20, 0), 0.5) for carrier in ("ring", "zenoh")]
    for row in rows:
        assert row["sent"] == 10
        assert row["latency_ms"]["n"] + row["dropped"] == 10
        assert row["latency_ms"]["n"] > 0


def test_interrupted_suite_keeps_its_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(step: everything.Step, options: SimpleNamespace) -> tuple[str, str]:
        return "interrupted" if step.file == "optimizer" else "complete", f"printed by {step.file}\n"

    monkeypatch.setattr(everything, "run_step", interrupted)
    assert everything.run(["--output", str(tmp_path), "--model", "detector=none.onnx"]) == 130
    text = (tmp_path / "report.md").read_text()
    assert "## system: complete" in text
    assert "printed by system" in text
    assert "## optimizer: interrupted" in text
    assert "transport" not in text


def test_missing_renderer_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """As from a wheel, which has neither `birdslam.world` nor `birdslam.runtime.world`."""
    for name in [name for name in sys.modules if name.startswith(("birdslam.world", "birdslam.runtime.world"))]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("birdslam.perf.accuracy.roads", "birdslam.runtime.world.demo_drive"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "birdslam.world", None)
    monkeypatch.setitem(sys.modules, "birdslam.runtime.world", None)
    assert main(["roads"]) == 2
    assert birdslam.main(["demo-drive", "make", "--output", str(tmp_path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all("needs a checkout" in line and "world" in line for line in lines)
