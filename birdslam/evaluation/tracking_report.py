"""The report of the benchmark, report.md: the setting, the paper's tables, tracks and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.evaluation import tables
from birdslam.evaluation.tables import Published
from birdslam.evaluation.tracking import Row


@dataclass(frozen=True)
class Setting:
    """How all sequences were evaluated; without `methods` only the ablations were."""

    frames: str
    methods: tuple[str, ...]
    odometry: str
    detections: str
    seeds: int


@dataclass(frozen=True)
class Outcome:
    """What one sequence's process found."""

    sequence: str
    frames: range
    rows: list[Row]
    ablation: list[Row]
    incremental_s: float
    batch_s: float
    updates_ms: dict[str, NDArray[np.float64]]


def render_report(setting: Setting, published: Published, outcomes: Sequence[Outcome]) -> str:
    """The whole of report.md."""
    rows = [row for outcome in outcomes for row in outcome.rows]
    variants = [row for outcome in outcomes for row in outcome.ablation]
    note = f"Odometry: {_odometry_note(setting)}. Detections: {setting.detections}."
    parts = ["# BirdSLAM on KITTI tracking\n", _preface(setting, outcomes)]

    def add(title: str, where: str, table: str) -> None:
        parts.append(f"## {title}\n\nPublished: {where}. {note}\n\n{table}")

    if setting.methods:
        t1, t2 = published.table1, published.table2
        add("Table 1: vehicles, ATE in m", t1.where, tables.methods_table(rows, published, ego=False))
        add("Table 2: ego, ATE in m", t2.where, tables.methods_table(rows, published, ego=True))
    if any("/" in row.method for row in variants):
        t3, t4 = published.table3, published.table4
        add(
            "Table 3: without one constraint",
            t3.where,
            tables.variants_table(variants, published, t3, tables.CONSTRAINTS),
        )
        add("Table 4: landmarks", t4.where, tables.variants_table(variants, published, t4, tables.LANDMARKS))
    if any(row.method in tables.LANES for row in variants):
        add("Table 5: lane constraints", published.table5.where, tables.lanes_table(variants, published))
    if setting.methods:
        name = setting.methods[0]
        parts.append(
            f"## Tracks and relative errors of {name}\n\nHOTA and IDF1 of cars in the image by KITTI's rules; the rest "
            f"are means over vehicles seen in 5 frames or more. {note}\n\n{tables.tracks_table(rows, name)}"
        )
    parts.append(_runtime(outcomes, published))
    return "\n".join(parts)


def _preface(setting: Setting, outcomes: Sequence[Outcome]) -> str:
    lines = [
        "ATE is the root mean square of a body's position errors over its frames in the global SE(2) frame (the ego's "
        "first pose), with no alignment and no scale; a vehicle's frames are those in which it is labelled and one of "
        "our tracks overlaps its label's box by half or more. "
        f"{'Medians over' if setting.seeds > 1 else 'From'} {setting.seeds} seed{'s' * (setting.seeds > 1)}"
        f"{', ± their standard deviation' if setting.seeds > 1 else ''}.",
        '"Re-implemented" methods are ours after the papers\' descriptions (birdslam/baselines/ says what each keeps '
        "and what it can't), run on the same measurements as ours.",
        '"Ours" are the vehicles\' ways as our system knows them once the sequence is over '
        "(birdslam/vehicles/rts_smoother.py), as the paper's graph and every batch do. 'Ours, live' is what a planner "
        "gets in each frame, which knows nothing of later ones, and so is 're-implemented: BirdSLAM'. "
        "The ego's are the same. Tables 3 and 4 compare live estimates.",
    ]
    if setting.frames == "paper":
        lines.append("Frames: the first so many of each sequence; the paper gives their number, not where they start.")
    taken = ", ".join(f"{o.sequence} [{o.frames.start}:{o.frames.stop}]" for o in outcomes)
    return "\n\n".join([*lines, f"Sequences and frames: {taken}."]) + "\n"


def _odometry_note(setting: Setting) -> str:
    notes: Mapping[str, str] = {
        "simulate": "SIMULATED (true poses with the errors that our image odometry has on real clips, landmarks drawn "
        "beside the true path)",
        "truth": "TRUTH (no error)",
        "images": "from the images",
    }
    return notes.get(setting.odometry, f"from {setting.odometry}")


def _runtime(outcomes: Sequence[Outcome], published: Published) -> str:
    theirs = published.runtime
    lines = [
        "## Runtime of the optimisation",
        "",
        "Seconds for a whole sequence on this computer, other processes beside it; `runtime.png` shows each update.",
        "",
        "| Seq | frames | incremental (ours) s | batch SE(3) s | ratio |",
        "| --- | --- | --- | --- | --- |",
        f"| published, {theirs.sequence} | {theirs.frames} | {theirs.incremental_s} | {theirs.batch_s} | "
        f"{theirs.batch_s / theirs.incremental_s:.0f} |",
    ]
    for o in outcomes:
        ratio = o.batch_s / max(o.incremental_s, 1e-9)
        lines.append(f"| {o.sequence} | {len(o.frames)} | {o.incremental_s:.3f} | {o.batch_s:.2f} | {ratio:.1f} |")
    return "\n".join(lines) + "\n"
