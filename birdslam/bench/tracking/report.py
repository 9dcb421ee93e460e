"""The report of `birdslam evaluate tracking`, report.md: the setting and the paper's tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from birdslam.bench.tracking import tables
from birdslam.bench.tracking.benchmark import Row
from birdslam.bench.tracking.tables import ODOMETRIES, Published

ABOUT_LANES = (
    "The batch in SE(3) of unknown scale, *before* without landmarks, *after* with all landmarks of the log. With "
    "simulated odometry these are corners drawn beside the true path, with images corners and lane stations. Landmarks "
    "are in metres by our scale, so they mainly add the scale that this batch lacks."
)

ABOUT_IDEAS = (
    "Each idea of ours alone, added to the paper's method with the paper's placing of vehicles, and all together. ATE "
    "in m, live unless stated."
)


@dataclass(frozen=True)
class Outcome:
    """The result of one job: a sequence with simulated odometry, or with its images."""

    sequence: str
    odometry: str
    frames: range
    rows: list[Row]
    ablation: list[Row]
    ideas: list[Row]


def render_report(frames: str, seeds: int, published: Published, outcomes: Sequence[Outcome]) -> str:
    """Renders report.md; `frames` is the value of `--frames`."""
    rows = [row for outcome in outcomes for row in outcome.rows]
    variants = [row for outcome in outcomes for row in outcome.ablation]
    ideas = [row for outcome in outcomes for row in outcome.ideas]
    detections = ", ".join(dict.fromkeys(row.detections for row in [*rows, *variants]))
    odometries = "; ".join(dict.fromkeys(ODOMETRIES[outcome.odometry][1] for outcome in outcomes))
    note = f"Odometry: {odometries}. Detections: {detections}."
    parts = ["# BirdSLAM on KITTI tracking\n", _preface(frames, seeds, outcomes)]

    def add(title: str, where: str, table: str) -> None:
        parts.append(f"## {title}\n\nPublished: {where}. {note}\n\n{table}")

    add("Table 1: vehicles, ATE in m", published.table1.where, tables.methods_table(rows, published, ego=False))
    add("Table 2: ego, ATE in m", published.table2.where, tables.methods_table(rows, published, ego=True))
    if any("/" in row.method for row in variants):
        t3, t4 = published.table3, published.table4
        constraints = tables.variants_table(variants, published, t3, tables.CONSTRAINTS)
        add("Table 3: without one constraint", t3.where, constraints)
        add("Table 4: landmarks", t4.where, tables.variants_table(variants, published, t4, tables.LANDMARKS))
    if any(row.method in tables.LANES for row in variants):
        table = f"{ABOUT_LANES}\n\n{tables.lanes_table(variants, published)}"
        add("Table 5: lane constraints", published.table5.where, table)
    if ideas:
        table = tables.ideas_table(ideas, published)
        parts.append(f"## What each idea is worth\n\n{ABOUT_IDEAS} {note}\n\n{table}")
    return "\n".join(parts)


def _preface(frames: str, seeds: int, outcomes: Sequence[Outcome]) -> str:
    lines = [
        "ATE is the RMS position error of a body in the global SE(2) frame (the first pose of the ego), without "
        "alignment. A vehicle's frames are those in which it is labelled and one of our tracks overlaps the box of its "
        f"label by half or more. {f'Medians over {seeds} seeds, ± standard deviation' if seeds > 1 else 'One seed'}.",
        '"Re-implemented" methods follow the descriptions in their papers (birdslam/bench/baselines/ lists the '
        "departures). All rows of a sequence use the same log, from our front end; the methods differ in their back "
        "ends. *Live* is the estimate at each frame. *Final* is the path of a vehicle after the drive, by the same "
        "smoother for all; the path of the ego is the live one. A batch uses the whole log; \\* marks one that ended "
        "before its minimum in at least one seed. Tables 3 and 4 compare live estimates. *By Eq. 1* uses a log with "
        "the paper's own placing of vehicles, and on images its whole front end.",
        "The constants of placing were tuned on 0000-0006 and 0008, and a few on 0010, 0018 and 0020 "
        "(docs/constants.md). The simulated odometry is fitted to other clips. The true poses of 0018 and 0020 come "
        "from stereo SLAM, with a scale within 3 %, the others from GPS and IMU.",
    ]
    if frames == "paper":
        lines.append(
            "Frames: as many of each sequence as the paper takes, from where the cars that it reports have the most "
            "labels. The paper does not state where they start."
        )
    taken = ", ".join(dict.fromkeys(f"{o.sequence} [{o.frames.start}:{o.frames.stop}]" for o in outcomes))
    return "\n\n".join([*lines, f"Sequences and frames: {taken}."]) + "\n"
