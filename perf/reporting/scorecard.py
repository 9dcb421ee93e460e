"""The figures of a report that a release is held to, and those of the last release, kept by version in perf/results/.

`python -m perf compare REPORT.json` prints them side by side; `--keep` writes them down as those of this version,
which is part of a release. Times of another machine say little: the card names both.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.figures import write_json

RESULTS = Path(__file__).parent.parent / "results"
Better = Literal["less", "more", "nearer to 0"]


class Card(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The figures of one version on one machine."""

    version: str
    cpu: str
    cores: int
    utc: str
    figures: dict[str, float]


def card(report: Mapping[str, Any]) -> Card:
    """Of the report of `python -m perf all`, or of some of its steps. Raises PerfError where it has none of them."""
    found = dict(_figures(report.get("benchmarks", {})))
    if not found:
        raise PerfError("the report has no figure of the scorecard: it is what `python -m perf all` writes")
    machine = report["machine"]
    return Card(machine["versions"]["birdslam"], machine["cpu"], machine["cores"], machine["utc"], found)


def _figures(benchmarks: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name in ("system", "system-loaded"):
        if (run := benchmarks.get(name, {})).get("age_ms"):
            yield from _of_run(name, run)
    for row in benchmarks.get("cores", {}).get("rows", []):
        if "missing" not in row:
            yield from _of_run(row["name"], row)
            yield from ((f"{row['name']}: {key}", row[key]) for key in ("found", "ate_m") if key in row)
    for row in benchmarks.get("vehicles", {}).get("rows", []):
        step = row["step_ms"]
        for level in ("p50", "p99", "max"):
            yield f"optimize, {row['vehicles']} vehicles: step {level} ms", step[level]
    for row in benchmarks.get("optimizer", {}).get("rows", []):
        if row["contender"].startswith("ours"):
            for level in ("p50", "p99", "max"):
                yield f"{row['contender']}, {row['vehicles']} vehicles: {level} us", row[f"{level}_us"]
    for name in ("accuracy", "accuracy-data"):
        for row in benchmarks.get(name, {}).get("rows", []):
            keys = ("ate_m", "scale_error", "vehicle_centre_rel", "found", "reported")
            yield from ((f"{row['name']}: {key}", row[key]) for key in keys if row.get(key) is not None)
    for row in benchmarks.get("inference", {}).get("rows", []):
        yield f"{row['name']}: p50 ms", row["total_ms"]["p50"]


def _of_run(name: str, run: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    yield f"{name}: rate Hz", run["rate_hz"]
    yield f"{name}: dropped %", 100.0 * run["dropped"] / run["frames"]
    if run.get("predicted") is not None:
        yield f"{name}: predicted %", 100.0 * run["predicted"] / run["frames"]
    yield f"{name}: age p50 ms", run["age_ms"]["p50"]
    yield f"{name}: age p99 ms", run["age_ms"]["p99"]
    yield f"{name}: cores", run["cpu_cores"]
    yield f"{name}: MB", run["rss_mb"]
    if run.get("pss_mb"):
        yield f"{name}: MB, shared pages once", run["pss_mb"]


def better_when(figure: str) -> Better:
    """Which way a figure improves."""
    what = figure.rpartition(": ")[2]
    if what == "scale_error":
        return "nearer to 0"
    return "more" if what in ("found", "reported", "rate Hz") else "less"


def keep(new: Card, folder: Path = RESULTS) -> Path:
    """Writes the card down as its version's."""
    path = folder / f"{new.version}.json"
    write_json(path, msgspec.to_builtins(new))
    return path


def last(version: str, folder: Path = RESULTS) -> Card:
    """The card of the newest version kept, up to `version`. Raises PerfError where there is none."""
    kept = (path for path in folder.glob("*.json") if _number(path.stem) <= _number(version))
    paths = sorted(kept, key=lambda path: _number(path.stem))
    if not paths:
        raise PerfError(f"{folder}: keeps no results of version {version} or before")
    return msgspec.convert(json.loads(paths[-1].read_text(encoding="utf-8")), Card)


def _number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".") if part.isdigit())


def lines(old: Card, new: Card) -> Iterator[str]:
    """The scorecard for a person: every figure that both have, and how many only one has."""
    yield f"last release {old.version}: {old.cpu}, {old.cores} cores, {old.utc}"
    yield f"now {new.version}: {new.cpu}, {new.cores} cores, {new.utc}"
    if (old.cpu, old.cores) != (new.cpu, new.cores):
        yield "not the same machine: times, rates and cores differ by that too"
    yield f"{'':52} {'release':>10} {'now':>10} {'change':>8}"
    for name in (name for name in old.figures if name in new.figures):
        a, b = old.figures[name], new.figures[name]
        change = f"{100.0 * (b - a) / abs(a):+.0f} %" if a else "-"
        yield f"{name:52} {a:10.4g} {b:10.4g} {change:>8}  {_verdict(name, a, b)}"
    alone = len(old.figures.keys() ^ new.figures.keys())
    if alone:
        yield f"{alone} figures are in one of the two alone"


def _verdict(name: str, old: float, new: float) -> str:
    way = better_when(name)
    a, b = (abs(old), abs(new)) if way == "nearer to 0" else (old, new)
    if abs(b - a) <= 0.05 * abs(a):
        return "as before"
    return "better" if (b > a) == (way == "more") else "worse"
