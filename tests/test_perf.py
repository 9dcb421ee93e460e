"""The perf suite: its statistics on known data, its reports, films, and long runs."""

from __future__ import annotations

import json
import socket
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.perf.__main__ import main
from birdslam.perf.accuracy.films import CAMERAS, FILMS, camera_of
from birdslam.perf.latency import system, transport
from birdslam.perf.latency.live import Run, Sample
from birdslam.perf.reporting import all as everything
from birdslam.perf.reporting import check
from birdslam.perf.robustness import soak
from birdslam.perf.robustness.film_figures import Step, over, summary
from birdslam.perf.robustness.film_variants import PARTS, Timed, Variant, variants
from birdslam.perf.robustness.soak import Ages, Series, Systemd, ages, drift, faults, sample, table
from birdslam.runtime.cli import main as birdslam
from birdslam.runtime.transport.bus import Message
from birdslam.runtime.wire import Stage, Trace
from birdslam.types import Estimate
from tests.test_bus import until

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


CAMERA = Camera(640, 360, 500.0, 500.0, 318.0, 181.0, height_m=1.4)
EVERY = list({variant.name: variant for part in PARTS for variant in variants(CAMERA, part)}.values())


def film(images: int = 6) -> list[Timed]:
    """Colour images of a slope of brightness, each brighter than the one before, 0.1 s apart."""
    slope = np.linspace(0, 150, 640)[None, :, None] + np.zeros((360, 1, 3))
    return [(k * 100_000_000, np.asarray(slope + 10 * k, np.uint8)) for k in range(images)]


def test_every_video_has_its_camera_file() -> None:
    videos = {name for name, film in FILMS.items() if film.uri.startswith("video:")}
    assert {path.stem for path in CAMERAS.iterdir()} == {FILMS[name].camera or name for name in videos}
    assert {name for name in FILMS if camera_of(name) is not None} == videos


@given(st.floats(0.5, 3.0), st.floats(0.0, 639.0), st.floats(0.0, 359.0))
def test_pixel_at_another_size_is_the_same_ray(size: float, u: float, v: float) -> None:
    camera = Variant("", size=size).camera(CAMERA)
    x, y = camera.width_px / CAMERA.width_px, camera.height_px / CAMERA.height_px
    there = (np.array([[u, v]]) + 0.5) * [x, y] - 0.5
    np.testing.assert_allclose(camera.to_xy(there), CAMERA.to_xy(np.array([[u, v]])), atol=1e-9)


@pytest.mark.parametrize("variant", EVERY, ids=lambda variant: variant.name)
def test_variant_shows_every_nth_image_at_its_size(variant: Variant) -> None:
    camera, shown = variant.camera(CAMERA), list(variant.images(iter(film())))
    assert 320 <= camera.width_px <= 3840
    assert [t_ns for t_ns, _ in shown] == [t_ns for t_ns, _ in film()[:: variant.every]]
    for (_, image), (_, given_image) in zip(shown, film()[:: variant.every], strict=True):
        assert image.shape == (camera.height_px, camera.width_px, 3)
        assert image.mean() == pytest.approx(given_image.mean(), abs=1.0)


def test_uneven_true_steps_do_not_affect_the_ratio_at_any_rate() -> None:
    """As in KITTI: distances per second are compared, not frames."""
    courses = []
    for every in (1, 2):
        steps = []
        for k in range(every, 61, every):
            true = sum(1.2 if step % 3 == 0 else 0.9 for step in range(k - every, k))
            steps.append(Step(0.1 * k, 0.1 * every, 10.0, 10.0 * true / every, valid=k > 5, sigma_rel=0.02))
        courses.append(summary(steps))
    ratio = over(courses[1], courses[0])
    assert abs(ratio - 1.0) < 0.015
    assert abs(courses[0]["speed_over_truth"] - courses[1]["speed_over_truth"]) > 0.03  # of frames it would be
    assert courses[0]["first_valid_s"] == pytest.approx(0.6)


WELL: dict[str, Any] = {
    "restarts": {"capture": 0, "perceive": 0},
    "dropped_by": {"capture": 0, "perceive": 3},
    "recording": {"restarts": 0, "dropped": 1},
}


@pytest.fixture
def systemd(tmp_path: Path) -> Any:
    with Systemd(tmp_path) as systemd:
        yield systemd


def series(mib: list[float], descriptors: list[int]) -> Series:
    return Series([5.0 * k for k in range(len(mib))], mib, descriptors, {1})


def test_constant_series_pass(systemd: Systemd) -> None:
    flat = series([100.0, 130.0, 100.2, 100.1, 100.3, 100.4] * 4, [30, 31, 30, 30, 29, 30] * 4)  # it swings
    assert list(faults({"perceive": flat}, WELL, systemd)) == []
    (row,) = [line for line in table({"perceive": flat}, WELL, systemd).splitlines() if line.startswith("| perceive")]
    assert row.endswith("| 0 | 3 |")


def test_sigma_of_drift_is_consistent() -> None:
    t_s, rng = np.arange(0.0, 3600.0, 5.0), np.random.default_rng(7)
    found = []
    for _ in range(300):
        steps = rng.exponential(0.4, t_s.size) * (rng.random(t_s.size) < 0.05)  # what is held is kept
        found.append(drift(t_s, 100.0 + np.cumsum(steps)))
    gains, sigmas = np.transpose(found)
    expected = 0.4 * 0.05 * 720
    assert gains.mean() == pytest.approx(expected, rel=0.02)
    assert np.sqrt(np.mean(sigmas**2)) == pytest.approx(gains.std(), rel=0.2)
    assert np.isnan(drift([1.0], [2.0])).all()


@pytest.mark.parametrize(
    ("one", "said"),
    [
        (series([100.0 + 0.1 * number for number in range(30)], [30] * 30), "perceive grew by 2.4%"),
        (series([100.0] * 24, [30] * 12 + [32, 33] * 6), "perceive holds 2 more descriptors"),
        (
            Series([5.0 * k for k in range(24)], [100.0] * 24, [30] * 24, {1, 2}),
            "perceive ran as 2 successive processes",
        ),
    ],
)
def test_growth_is_named(one: Series, said: str, systemd: Systemd) -> None:
    assert list(faults({"perceive": one}, WELL, systemd)) == [said]


def test_growing_age_is_named() -> None:
    t_s = [0.03 * k for k in range(400)]
    said, bad = ages(Ages(t_s, [20.0, 22.0, 21.0, 40.0] * 100))
    assert said.startswith("age at the planner, first quarter p50 21.5, p99 40.0 ms; last 21.5, 40.0 ms; p50 +0.0 +-")
    assert bad == []
    said, bad = ages(Ages(t_s, [20.0 + 0.05 * k for k in range(400)]))
    assert bad == ["the median age grew from 22.5 to 37.5 ms"]
    assert "p50 +6000.0 +- 0.0 ms an hour" in said  # 0.05 ms in 0.03 s


def test_restarted_nodes_are_named(systemd: Systemd) -> None:
    restarted = {**WELL, "restarts": {"capture": 2, "perceive": 0}, "recording": {"restarts": 1, "dropped": 0}}
    assert list(faults({}, restarted, systemd)) == ["capture was restarted 2 times", "record was restarted 1 times"]


def test_a_supervisor_that_is_silent_for_too_long_misses_its_watchdog(
    systemd: Systemd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "WATCHDOG_S", 0.0)  # whatever comes second is late
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        for said in (b"READY=1", b"WATCHDOG=1\nSTATUS=x", b"STATUS=y", b"STOPPING=1", b"WATCHDOG=1"):
            supervisor.sendto(said, systemd.environment["NOTIFY_SOCKET"])
        until(lambda: systemd.missed == 1, "it is counted")
    assert systemd.longest_s > 0.0
    assert list(faults({}, WELL, systemd)) == ["the supervisor missed its watchdog 1 times"]


def test_a_sample_is_of_the_process_itself() -> None:
    into = {"this": Series()}
    sample({"this": psutil.Process()}, into)
    assert into["this"].mib[0] > 10.0
    assert into["this"].descriptors[0] > 0
    assert into["this"].pids == {psutil.Process().pid}
