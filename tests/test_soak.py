"""The verdicts of the soak test; the drive itself is `python -m perf soak`."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from birdslam.perf.robustness import soak
from birdslam.perf.robustness.soak import Ages, Series, Systemd, ages, drift, faults, sample, table
from tests.test_bus import until

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
