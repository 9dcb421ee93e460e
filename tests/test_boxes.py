"""`python -m perf boxes`: other libraries' objects of a file's boxes give what the file gives, to the bit."""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.perf.perception import boxes
from birdslam.types import VehicleEstimate

pytest.importorskip("supervision")


@dataclass
class Detection:
    """As norfair's: the package itself asks for numpy below 2."""

    points: np.ndarray
    scores: np.ndarray | None = None
    label: str = ""
    data: Any = None


def estimate(vehicle: int, x_m: float) -> VehicleEstimate:
    return VehicleEstimate(
        vehicle=vehicle, T_world_vehicle=SE2(x_m, 0.0, 0.0), cov=(0.1,) * 9, velocity_mps=(1.0, 0.0),
        velocity_cov=(0.1,) * 4, age_ns=0, frames=2, label="car",
    )  # fmt: skip


def test_every_difference_counts() -> None:
    found = {0: (estimate(1, 5.0),), 1: (estimate(1, 6.0), estimate(2, 9.0))}
    assert boxes.differences(found, found) == 0
    moved = found | {1: (msgspec.structs.replace(found[1][0], T_world_vehicle=SE2(6.0 + 1e-12, 0.0, 0.0)), found[1][1])}
    assert boxes.differences(moved, found) == 1
    assert boxes.differences(found, found | {1: found[1][:1]}) == 1
    assert boxes.differences({}, found) == 3


@pytest.mark.slow  # three drives
@pytest.mark.processes
def test_both_libraries_give_what_the_file_gives(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in = types.ModuleType("norfair")
    stand_in.Detection = Detection  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "norfair", stand_in)
    assert boxes.run(["--frames", "8"]) == 0
    said = capsys.readouterr().out
    vehicles = int(said.split(" estimates of vehicles")[0].split()[-1])
    assert vehicles > 10
    assert said.count(f": 0 of {vehicles} estimates differ, 0 of ") == 2
