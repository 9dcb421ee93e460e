"""Compares two reports, result by result, with the noise of both: better, worse or not distinguishable.

    python -m perf compare A.json B.json          # A is the old one; A1.json,A2.json: several runs of one side

Mann-Whitney U on the blocks of each series, two-sided, with a false discovery rate below 1 %; only shifts over 5 %
count. Exit status: 1 if a result is worse, 2 if the reports can't be compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import binomtest, false_discovery_control, mannwhitneyu

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser

label = "two reports: better, worse or not distinguishable"

FALSE_DISCOVERIES = 0.01
MIN_SHIFT = 0.05  # of the old value
Verdict = Literal["better", "worse", "not distinguishable"]


@dataclass(frozen=True)
class Verdicts:
    """One line: medians of the old and the new blocks (or counts, or exact values), and the verdict."""

    name: str
    old: float
    new: float
    p: float
    verdict: Verdict


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("compare", label, output="")
    parser.add_argument("old", metavar="A.json", help="report or benchmark's JSON; several runs as A1,A2")
    parser.add_argument("new", metavar="B.json")
    parser.add_argument("--all", action="store_true", help="also show results that are not distinguishable")
    options = parser.parse_args(arguments)
    old, new = _read(options.old), _read(options.new)
    machines = {report["machine"]["cpu"] for report in (*old, *new) if isinstance(report, dict) and "machine" in report}
    if len(machines) > 1:
        print(f"not the same machine ({', '.join(sorted(machines))}): only ratios can be compared")
    found = compare(old, new)
    for line in found:
        if options.all or line.verdict != "not distinguishable":
            print(f"{line.name:64} {line.old:10.4g} {line.new:10.4g}  p {line.p:.1e}  {line.verdict}")
    counts = {verdict: sum(line.verdict == verdict for line in found) for verdict in ("better", "worse")}
    print(f"{len(found)} figures: {counts['better']} better, {counts['worse']} worse, the rest not distinguishable")
    return int(counts["worse"] > 0)


def _read(paths: str) -> list[Any]:
    reports = []
    for path in paths.split(","):
        try:
            reports.append(json.loads(Path(path).read_text(encoding="utf-8")))
        except OSError as error:
            raise PerfError(f"{path}: {error.strerror}") from error
        except ValueError as error:
            raise PerfError(f"{path}: not JSON: {error}") from error
    return reports


def compare(old: list[Any], new: list[Any]) -> list[Verdicts]:
    """Compares all results that both sides have, in order. Raises PerfError if there are none."""
    sides = []
    for reports in (old, new):
        pooled: dict[str, list[float]] = {}
        for report in reports:
            for name, blocks in figures(report):
                pooled.setdefault(name, []).extend(blocks)
        sides.append(pooled)
    names = [name for name in sides[0] if name in sides[1]]
    if not names:
        raise PerfError("the reports have no result in common")
    tests = [(name, sides[0][name], sides[1][name], _p(name, sides[0][name], sides[1][name])) for name in names]
    adjusted = false_discovery_control([p for *_, p in tests])
    return [_judge(name, a, b, float(p)) for (name, a, b, _), p in zip(tests, adjusted, strict=True)]


def figures(content: Any, path: str = "") -> Iterator[tuple[str, list[float]]]:
    """(name, blocks) of all results with noise in a report; [dropped, of] for counts, [value] for exact results."""
    if isinstance(content, list):
        for number, item in enumerate(content):
            name = item.get("name", number) if isinstance(item, dict) else number
            yield from figures(item, f"{path}{name} / ")
    elif isinstance(content, dict):
        for name, blocks in content.get("noise", {}).items():
            yield f"{path}{name}", [float(value) for value in blocks]
        for name, value in content.get("exact", {}).items():
            yield f"{path}{name} (exact)", [float(value)]
        if "dropped" in content and (content.get("sent") or content.get("frames")):
            yield f"{path}dropped", [float(content["dropped"]), float(content.get("sent") or content["frames"])]
        for name, item in content.items():
            if isinstance(item, dict | list) and name not in ("noise", "exact"):
                yield from figures(item, path if name in ("benchmarks", "rows") else f"{path}{name} / ")


def _p(name: str, old: list[float], new: list[float]) -> float:
    """The p-value of the difference."""
    if name.endswith("(exact)"):
        return float(old[0] == new[0])
    if name.endswith("dropped"):
        (lost, of), (lost_new, of_new) = ((sum(side[::2]), sum(side[1::2])) for side in (old, new))
        if not lost + lost_new:
            return 1.0
        # Drops are correlated: ten count as one independent drop, rounded up
        few, few_new = -(-lost // 10), -(-lost_new // 10)
        return float(binomtest(int(few_new), int(few + few_new), of_new / (of + of_new)).pvalue)
    return float(mannwhitneyu(old, new).pvalue) if old != new else 1.0


def _judge(name: str, old: list[float], new: list[float], p: float) -> Verdicts:
    if name.endswith("dropped"):
        a, b = (sum(side[::2]) / sum(side[1::2]) for side in (old, new))
    else:
        a, b = float(np.median(old)), float(np.median(new))
    shifted = abs(b - a) > MIN_SHIFT * abs(a)
    verdict: Verdict = "not distinguishable"
    if p < FALSE_DISCOVERIES and shifted:
        verdict = "worse" if abs(b) > abs(a) else "better"  # smaller is better for all results
    return Verdicts(name, a, b, p, verdict)
