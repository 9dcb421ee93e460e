"""The interface page matches the code, and its examples run on a real drive."""

from __future__ import annotations

import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from birdslam.perf.robustness.faulty_vehicle import WITHOUT_SPARES, Vehicle
from birdslam.runtime.cli.main import main
from birdslam.runtime.pages.interface import page
from birdslam.runtime.topology import QUERIES, TOPICS
from birdslam.runtime.transport.presence import socket_path
from birdslam.types import INVALIDATING, Status

pytestmark = pytest.mark.processes

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "docs" / "examples"
LIMIT_S = 120.0


def test_the_page_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["interface"]) == 0
    reference = capsys.readouterr().out
    assert (ROOT / "docs" / "planner.md").read_text().endswith(f"\n{reference}"), (
        "its end is the output of `birdslam interface`"
    )


def test_the_page_has_everything() -> None:
    text = page()
    rows = re.findall(r"^\| `([^`]+)` \|(.*)$", text, re.MULTILINE)
    for name in (*TOPICS, *QUERIES, *(status.value for status in Status)):
        assert name in dict(rows), name
    invalid = {name for name, rest in rows if rest.endswith("**yes** |")}
    assert invalid == {status.value for status in INVALIDATING}
    told = {name: rest for name, rest in rows if name in {status.value for status in Status}}
    assert all(len(rest.split("|")[0].strip()) > 10 for rest in told.values())
    records = set(re.findall(r"^### (\w+)$", text, re.MULTILINE))
    linked = set(re.findall(r"\[(\w+)\]\(#\w+\)", text)) - {"status"}
    assert records == linked
    estimate = text.partition("### Estimate\n")[2].partition("###")[0]
    assert all(row.split("|")[-2].strip() for row in estimate.splitlines() if row.startswith("| `"))
    assert max(map(len, (line for line in text.splitlines() if not line.startswith("|")))) <= 150


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until_said(process: subprocess.Popen[str], *wanted: str) -> None:
    """Until each of these was the beginning of a line, in this order."""
    lines: list[str] = []
    left, end_s = list(wanted), time.monotonic() + LIMIT_S
    while left:
        assert time.monotonic() < end_s, (left, lines[-20:])
        if select.select([process.stdout], [], [], 0.5)[0]:
            line = process.stdout.readline()
            assert line, f"it ended: {lines[-20:]}"
            lines.append(line)
            if re.match(left[0], line):
                left.pop(0)


def test_the_examples_against_a_drive(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Alive, then without a vehicle: neither falls silent."""
    place = tmp_path_factory.mktemp("i")
    with Vehicle(place, "--set", "runtime.watchdog_ms=20000", *WITHOUT_SPARES) as vehicle:
        hub = socket_path(vehicle.runtime_dir / vehicle.vehicle, "hub")
        name, folder = vehicle.vehicle, str(vehicle.runtime_dir)
        with (
            running(str(EXAMPLES / "planner.py"), name, folder) as planner,
            running("-I", str(EXAMPLES / "plain.py"), str(hub), name) as plain,
        ):
            until_said(planner, r"epoch \d+: \d+ lane points", r"frame \d+: \d+ ms old, \d+ ms to spare")
            until_said(plain, r"frame \d+ at .* good", r"epoch \d+: [1-9]\d* poses so far", r"frame \d+ at .* good")
            assert vehicle.stop() == 0
            until_said(planner, r"slow down: alive False, on time False")
            until_said(plain, r"stale: no estimate")


def test_examples_are_short_and_the_plain_one_needs_no_birdslam() -> None:
    code = (EXAMPLES / "planner.py").read_text()
    assert len(code.splitlines()) <= 30
    plain = (EXAMPLES / "plain.py").read_text()
    assert "birdslam" not in re.findall(r"^(?:import|from) (\w+)", plain, re.MULTILINE)
    assert set(re.findall(r"^(?:import|from) (\w+)", plain, re.MULTILINE)) - set(sys.stdlib_module_names) == {
        "msgpack",
        "zenoh",
    }
    assert "runtime" not in plain
