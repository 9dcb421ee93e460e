"""`python -m perf batch`: what it computes of its rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from birdslam.perf.latency import batch
from birdslam.runtime.batch.drives import find_drives, tasks
from tests.test_batch import PLAIN, kitti


def row(engine: str, workers: int, number: int, wall_s: float) -> dict:
    more = {"cpu_s": 36.0, "peak_mb": 300.0, "bytes": 80_000} if engine == "plain" else {}
    return {"engine": engine, "workers": workers, "round": number, "wall_s": wall_s, "drives": 4, **more}


ROWS = [
    row(engine, workers, number, wall_s)
    for number, workers, engine, wall_s in (
        (0, 1, "plain", 40.0), (0, 1, "ray", 44.0), (0, 2, "plain", 20.0), (0, 2, "ray", 30.0),
        (1, 1, "plain", 80.0), (1, 1, "ray", 80.0), (2, 1, "plain", 10.0), (2, 1, "ray", 12.0),
    )
]  # fmt: skip


def test_rays_cost_is_the_median_of_each_rounds_ratio() -> None:
    assert batch.ratios(ROWS) == {1: pytest.approx(1.1), 2: pytest.approx(1.5)}
    assert batch.ratios([one for one in ROWS if one["engine"] == "plain"]) == {}


def test_what_hours_need() -> None:
    """36 s of processor over four drives of 30 frames, of which 3.4 s a drive go to starting: 0.2 s a frame."""
    start = {"drives": 4, "cpu_s": 13.6, "bytes": 24_000}
    needed = batch.need(ROWS, start, 30, 10.0)
    assert needed["frame_cpu_s"] == pytest.approx(0.2)
    frames, drives = 10_000 * 3600 * 10, 10_000 * 6
    assert needed["core_hours"] == pytest.approx((0.2 * frames + 3.4 * drives) / 3600, rel=1e-3)
    assert needed["results_gb"] == pytest.approx(500 * frames / 1e9, rel=1e-3)
    assert needed["peak_mb"] == 300.0


@pytest.mark.processes
def test_a_cell_is_measured(tmp_path: Path) -> None:
    todo = tasks(find_drives([str(kitti(tmp_path / "00"))]), [{}], None, PLAIN, [], {})
    measured = batch.measure("plain", 1, todo)
    assert measured["drives"] == 1
    assert measured["cpu_s"] > 0.0
    assert measured["peak_mb"] > 20.0
    assert measured["bytes"] > 1000
