"""Maps of lines of two passes against each other."""

import json
from pathlib import Path

import pytest

from birdslam.perf.accuracy.line_maps import compare, painted_lines, run
from birdslam.perf.errors import PerfError


def geojson(path: Path, *ys: float, kind: str = "solid") -> Path:
    def feature(y: float) -> dict[str, object]:
        line = [[5.0 * k, y] for k in range(10)]
        geometry = {"type": "LineString", "coordinates": line}
        return {"geometry": geometry, "properties": {"kind": kind, "sigma_m": [0.05] * len(line)}}

    path.write_text(json.dumps({"features": [feature(y) for y in ys]}))
    return path


def test_a_pass_in_another_lane_has_the_same_lines(tmp_path: Path) -> None:
    a = painted_lines(geojson(tmp_path / "a", 1.8, -1.7))
    b = painted_lines(geojson(tmp_path / "b", 2.4, -1.2))  # 0.5 m to the right; the first line is 0.1 m off
    long = compare(a, b, -0.5)["longer"]
    assert long["in both"] == pytest.approx(1.0)
    assert long["median m"] == pytest.approx(0.05)
    assert long["within 2 sigma"] == pytest.approx(1.0)
    assert compare(a, b, 0.0)["longer"]["within 0.3 m"] == pytest.approx(0.0)


def test_a_line_that_the_other_pass_has_not_is_counted(tmp_path: Path) -> None:
    a, b = painted_lines(geojson(tmp_path / "a", 1.8)), painted_lines(geojson(tmp_path / "b", 1.8, -6.0))
    assert compare(a, b, 0.0)["longer"]["in both"] == pytest.approx(0.5)


def test_edges_are_no_paint_and_other_files_no_map(tmp_path: Path) -> None:
    edges, other = geojson(tmp_path / "a", 1.8, kind="edge"), tmp_path / "b"
    other.write_text("{}")
    with pytest.raises(PerfError, match="no painted lines"):
        run([str(edges), str(geojson(tmp_path / "c", 1.8))])
    with pytest.raises(PerfError, match=r"no map\.geojson"):
        painted_lines(other)
