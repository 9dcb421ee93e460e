"""The table of what each edge is worth, the variant that the other logs choose for each, and docs/edges.md of both."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence

import numpy as np

from birdslam.bench.figures import markdown

WHAT = ("ego", "cars, live", "cars, final", "NEES of the ego", "beside the truth's axes", "NEES of cars")
ABOUT = (
    "[ablations.md](ablations.md) says what follows from it. Logs of images are those of the whole front end with its "
    "lane head; simulated drives take true poses and recorded boxes, three draws each."
)
ABOUT_TABLE = (
    "ATE in m of the ego and of the mean car, nothing aligned; NEES over its degrees of freedom (1: honest), the ego's "
    "of its pose in the world, a car's of its place in the ego's frame. *Beside the truth's axes*: the ego's with 6 "
    "mrad (1-sigma, for a whole drive) by which KITTI's axes are turned against the way. Of simulated drives the mean "
    "and the spread over draws."
)


def left_out(grades: Mapping[str, Mapping[str, Mapping[str, float]]], what: str) -> list[str]:
    """For each case: the variant that is best on all others by the mean logarithm, and what it is worth on this one."""
    names = [case for case, by in next(iter(grades.values())).items() if math.isfinite(by.get(what, math.nan))]
    lines = []
    for case in names:
        others = [each for each in names if each != case]
        score = {v: float(np.mean([math.log(by[each][what]) for each in others])) for v, by in grades.items()}
        best = min(score, key=lambda v: score[v])
        lines.append(f"{case}: {best}, {grades[best][case][what]:.2f} (default {grades['default'][case][what]:.2f})")
    return lines


def table(grades: Mapping[str, Mapping[str, Mapping[str, float]]], drawn: Mapping[str, Sequence[str]]) -> str:
    """A row for each variant; `drawn` are the cases whose mean and spread over draws are one column."""
    cases = [*next(iter(grades.values()))]
    single = [case for case in cases if case not in {each for names in drawn.values() for each in names}]
    columns: list[tuple[str, list[str], str]] = [(f"{case} {what}", [case], what) for case in single for what in WHAT]
    columns += [(f"{name} {what}", [*names], what) for name, names in drawn.items() for what in WHAT]
    columns = [c for c in columns if any(c[2] in grades["default"][case] for case in c[1])]
    lines = []
    for variant, by in grades.items():
        cells = []
        for _, names, what in columns:
            values = np.array([by[case][what] for case in names])
            cells.append(f"{values.mean():.2f}" + (f" ± {values.std():.2f}" if len(values) > 1 else ""))
        lines.append([variant, *cells])
    return markdown(["edges", *(title for title, _, _ in columns)], lines)


def nees_spread(found: Sequence[float]) -> str:
    """What the NEES of one drive may be, where the errors are those of the simulation, in a sentence."""
    low, median, high = np.percentile(found, [2.5, 50.0, 97.5])
    return (
        f"One drive is one sample of its NEES, since its errors last: over {len(found)} simulated drives the ego's is "
        f"{np.mean(found):.2f} in the mean and {median:.2f} in the median, and 95 % of drives lie between {low:.2f} "
        f"and {high:.2f}."
    )


def page(text: str) -> str:
    """docs/edges.md of what `--output` wrote."""
    kept = json.loads(text)
    lines = [
        "# What each edge of the graph is worth",
        "",
        "Written by `python -m perf pages --write edges`.",
        ABOUT,
        "",
    ]
    lines += ["## Statistics of real and of simulated edges", "", kept["statistics"]]
    lines += ["## ATE and NEES by variant", "", ABOUT_TABLE, "", kept["table"], kept["nees"], ""]
    for what, found in kept["left"].items():
        lines += [f"## The best variant on all other logs: {what}", "", *(f"- {line}" for line in found), ""]
    return "\n".join(lines)
