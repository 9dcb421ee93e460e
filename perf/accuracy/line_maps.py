"""Lines of two passes of one street, one pass's map.geojson against the other's.

    python -m perf line_maps A/map.geojson B/map.geojson [--left M] [--output FILE]

Both worlds begin at their first pose; B's begins `--left` metres to the left of A's (the cameras of KITTI: two_passes
`left` against `right` has -0.537). Each vertex of a painted line of B against the nearest of A's painted lines where
that runs beside it: the distance across, also over the sum of both stated variances; by the length of B's line.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from birdslam.bench.figures import markdown
from birdslam.geometry.arrays import Floats
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import write_json
from birdslam.types import LineKind

label = "lines of two passes of one street against each other"

SAME_M, NEAR_M = 1.5, 0.3  # farther apart are two lines; of those nearer, a share is within NEAR_M
LENGTHS_M = ((0.0, 30.0), (30.0, 1e9))


@dataclass(frozen=True)
class Line:
    """A polyline (N, 2) with its stated sigma across (N,)."""

    points_m: Floats
    sigma_m: Floats

    @property
    def length_m(self) -> float:
        """Along its vertices."""
        return float(np.hypot(*np.diff(self.points_m, axis=0).T).sum())


def painted_lines(path: Path) -> list[Line]:
    """The painted lines of a map.geojson. Raises PerfError."""
    try:
        features = json.loads(path.read_text(encoding="ascii"))["features"]
        return [
            Line(np.array(f["geometry"]["coordinates"]), np.array(f["properties"]["sigma_m"]))
            for f in features
            if f["properties"]["kind"] != LineKind.EDGE.value
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PerfError(f"{path}: is no map.geojson of a drive: {error}") from None


def across(points_m: Floats, line: Line) -> tuple[Floats, Floats]:
    """(N,) distances of points to a line, NaN where it does not run beside them, and its sigma there."""
    a, step = line.points_m[:-1], np.diff(line.points_m, axis=0)
    length = np.hypot(*step.T)
    along, aside = step / length[:, None], np.column_stack([-step[:, 1], step[:, 0]]) / length[:, None]
    off = points_m[:, None] - a
    at, distance = (off * along).sum(axis=2), np.abs((off * aside).sum(axis=2))
    distance = np.where((at >= 0.0) & (at <= length), distance, np.inf)
    k = distance.argmin(axis=1)
    nearest = distance[np.arange(len(points_m)), k]
    return np.where(np.isfinite(nearest), nearest, np.nan), line.sigma_m[k]


def compare(a: list[Line], b: list[Line], left_m: float) -> dict[str, dict[str, float]]:
    """By the length of the line of `b`: vertices, of them beside a line of `a`, distances of these."""
    out = {}
    for least, most in LENGTHS_M:
        lines = [line for line in b if least <= line.length_m < most]
        gaps: list[float] = []
        inside: list[bool] = []
        for line in lines:
            found = [across(line.points_m + np.array([0.0, left_m]), other) for other in a]
            distance = np.array([d for d, _ in found])
            k = np.where(np.isnan(distance), np.inf, distance).argmin(axis=0)
            rows = np.arange(len(k))
            gap, sigma = distance[k, rows], np.array([s for _, s in found])[k, rows]
            same = gap < SAME_M
            gaps += gap[same].tolist()
            inside += (gap < 2.0 * np.hypot(sigma, line.sigma_m))[same].tolist()
        vertices = sum(len(line.points_m) for line in lines)
        out["under 30 m" if least == 0.0 else "longer"] = {
            "lines": len(lines),
            "vertices": vertices,
            "in both": len(gaps) / max(vertices, 1),
            "median m": float(np.median(gaps)) if gaps else float("nan"),
            "p95 m": float(np.quantile(gaps, 0.95)) if gaps else float("nan"),
            "within 0.3 m": float(np.mean(np.array(gaps) < NEAR_M)) if gaps else float("nan"),
            "within 2 sigma": float(np.mean(inside)) if inside else float("nan"),
        }
    return out


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("line_maps", label)
    parser.add_argument("a", type=Path, metavar="A", help="map.geojson of `birdslam run`")
    parser.add_argument("b", type=Path, metavar="B")
    parser.add_argument("--left", type=float, default=0.0, metavar="M", help="of A's first pose, where B's is")
    options = parser.parse_args(arguments)
    a, b = painted_lines(options.a), painted_lines(options.b)
    if not a or not b:
        raise PerfError(f"{options.b if a else options.a}: has no painted lines")
    found = compare(a, b, options.left)
    heads = [*next(iter(found.values()))]
    print(
        markdown(["lines of B", *heads], [[name, *(f"{v:.3g}" for v in row.values())] for name, row in found.items()])
    )
    if options.output is not None:
        write_json(options.output, found)
