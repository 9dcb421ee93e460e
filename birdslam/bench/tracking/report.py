"""The report of the benchmark, report.md: the setting, the paper's tables, tracks and times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from birdslam.bench.tracking import tables
from birdslam.bench.tracking.benchmark import Row
from birdslam.bench.tracking.movers import MoversRow
from birdslam.bench.tracking.relative_nees import NeesRow
from birdslam.bench.tracking.reported import MotionRow, RangeRow
from birdslam.bench.tracking.tables import ODOMETRIES, Published
from birdslam.geometry.arrays import Floats

ABOUT_REPORTED = (
    "Live, in the ego's frame: cars labelled 25 px or more high, hardly occluded and not truncated; found is an "
    "estimate within 20 % of the distance ahead and 1.5 m across. A car stands under 0.5 m/s and drives over 2 m/s by "
    "its labels; it is reported as driving over 1.5 m/s, surely where it is over or under that by twice its own sigma."
)

ABOUT_LANES = (
    "The batch in SE(3) of unknown scale. *Before* it has no landmark, *after* all of the log's: of simulated odometry "
    "corners drawn beside the true path and no lane, of images corners and the lanes' stations that single frames saw. "
    "*Completed lanes* are the amodal lanes of many frames, the paper's own choice, in place of all other landmarks. "
    "All stand in the log in metres, by our scale, and by the paper's weights count along a lane as they do across it: "
    "what they bring is the scale that this batch is without, first of all."
)

ABOUT_NEES = (
    "Squared errors over what was stated, a degree of freedom: 1 is honest, more is too sure. *Median* is the median "
    "over that of an honest error, which a few wild errors do not move. The ego's are those of each frame's motion and "
    "of 10 m of motions, the scale's the part of these along the way. Truth's own noise is added, but not to simulated "
    "odometry, which errs from the true poses themselves. Its rows say how well the simulation knows itself, over all "
    "seeds: over 10 m its scale errs less than the graph takes for granted, whose memory of it is that of our own "
    "odometry and longer than the simulation's. Rows of images alone are of our odometry. "
    "A vehicle's are of its place in the ego's frame as the live graph has it, in the frames that see it, and in the "
    "frame that the ego had 10 m before. Vehicles' errors last: a few vehicles are few samples, however many frames."
)


@dataclass(frozen=True)
class Setting:
    """How all sequences were evaluated; without `methods` only the ablations were."""

    frames: str
    methods: tuple[str, ...]
    seeds: int


@dataclass(frozen=True)
class BatchTiming:
    """One solve of a batch; `converged`: the answer is the minimum."""

    seconds: float
    iterations: int
    converged: bool


ABOUT_MOVERS = (
    "A track is one id on one labelled vehicle, of five sights or more. It is reported to drive where the live estimate"
    " says so with over 1.5 m/s. Standing: its label is slower than 0.5 m/s at every sight. Driving: for a second "
    "or longer over 2 m/s; soon: reported within a second of that."
)


@dataclass(frozen=True)
class Timing:
    """The live graph over `frames` frames, and the batches of odometry of unknown scale and of metric odometry."""

    frames: int
    incremental_s: float
    unscaled: BatchTiming
    metric: BatchTiming


@dataclass(frozen=True)
class Outcome:
    """What one sequence's process found."""

    sequence: str
    odometry: str
    frames: range
    rows: list[Row]
    ablation: list[Row]
    ideas: list[Row]  # what each of ours is worth over the paper's
    ranges: list[RangeRow]  # of the networks' own boxes alone, as `motion`
    motion: list[MotionRow]
    timings: list[Timing]  # by the number of frames
    nees: list[NeesRow]
    updates_ms: dict[str, Floats]
    movers: MoversRow | None = None


def render_report(setting: Setting, published: Published, outcomes: Sequence[Outcome]) -> str:
    """The whole of report.md."""
    rows = [row for outcome in outcomes for row in outcome.rows]
    variants = [row for outcome in outcomes for row in outcome.ablation]
    detections = ", ".join(dict.fromkeys(row.detections for row in [*rows, *variants]))
    note = f"Odometry: {_odometry_note(outcomes)}. Detections: {detections}."
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
        table = f"{ABOUT_LANES}\n\n{tables.lanes_table(variants, published)}"
        add("Table 5: lane constraints", published.table5.where, table)
    ideas = [row for outcome in outcomes for row in outcome.ideas]
    if ideas:
        parts.append(
            "## What each idea is worth\n\nEach of ours alone over the paper's method with the paper's placing of "
            f"vehicles, and all together. ATE in m, live but where a row says otherwise. {note}\n\n"
            f"{tables.ideas_table(ideas, published)}"
        )
    if setting.methods:
        name = setting.methods[0]
        parts.append(
            f"## Tracks and relative errors of {name}\n\nHOTA and IDF1 of cars in the image by KITTI's rules; the rest "
            f"are means over vehicles seen in 5 frames or more. {note}\n\n{tables.tracks_table(rows, name)}"
        )
    movers = [outcome.movers for outcome in outcomes if outcome.movers is not None]
    if movers:
        parts.append(
            f"## Standing tracks that are reported to drive\n\n{ABOUT_MOVERS}\n\n{tables.movers_table(movers)}"
        )
    ranges = [row for outcome in outcomes for row in outcome.ranges]
    if ranges:
        parts.append(
            f"## Cars that our own networks saw, as reported to a planner\n\n{ABOUT_REPORTED}\n\n"
            f"{tables.ranges_table(ranges)}\n"
            f"{tables.motion_table([row for outcome in outcomes for row in outcome.motion])}"
        )
    nees = [row for outcome in outcomes for row in outcome.nees]
    if nees:
        parts.append(f"## Whether stated sigmas are honest\n\n{ABOUT_NEES}\n\n{tables.nees_table(nees)}")
    if any(outcome.timings for outcome in outcomes):
        parts.append(_runtime(outcomes, published))
    return "\n".join(parts)


def _preface(setting: Setting, outcomes: Sequence[Outcome]) -> str:
    lines = [
        "ATE is the root mean square of a body's position errors over its frames in the global SE(2) frame (the ego's "
        "first pose), with no alignment and no scale; a vehicle's frames are those in which it is labelled and one of "
        "our tracks overlaps its label's box by half or more. "
        f"{'Medians over' if setting.seeds > 1 else 'From'} {setting.seeds} seed{'s' * (setting.seeds > 1)}"
        f"{', ± their standard deviation' if setting.seeds > 1 else ''}.",
        '"Re-implemented" methods are ours after the papers\' descriptions (birdslam/bench/baselines/ says what each '
        "keeps and what it can't), run on the same measurements as ours.",
        "All rows of a sequence have the same log: the same boxes, tracker, placing of vehicles and odometry, those of "
        "our front end; methods differ in their back ends alone. *Live* is what a planner gets in each frame, which "
        "knows nothing of later ones. *Final* is the vehicles' ways once the sequence is over, from the live ones by "
        "one smoother for both (birdslam/vehicles/rts_smoother.py); the egos' are the live ones. A batch knows the "
        "whole sequence without that smoother; one with \\* ended short of its minimum in a seed or more. Tables 3 and "
        "4 compare live estimates. *The ego's part* is what is left of ours, live, had the ego seen every vehicle "
        "exactly: no placing of vehicles makes them better than that. What is placed *by Eq. 1* alone "
        "departs from that: its log is of the paper's own placing of vehicles (Eq. 1 under the box on level ground), "
        "and on images of its whole front end: metres by a moving median, and within 20 m the places that "
        "Frustum-PointNet reads from the depth network's points.",
        "The placing's constants were tuned on 0000-0006 and 0008, the simulated odometry is fitted to other clips; "
        "with these, 0010 and 0018 chose four of them and `confirm_hits`, 0020 what tells standing from creeping too "
        "(docs/constants.md). The true poses of 0018 and 0020 are of a stereo SLAM, whose scale is within 3 %; those "
        "of the others are of GPS and IMU.",
    ]
    if setting.frames == "paper":
        lines.append(
            "Frames: of each sequence as many as the paper takes. It does not say where they start: here where the "
            "cars that it reports have the most labels together (the first such stretch)."
        )
    taken = ", ".join(dict.fromkeys(f"{o.sequence} [{o.frames.start}:{o.frames.stop}]" for o in outcomes))
    return "\n\n".join([*lines, f"Sequences and frames: {taken}."]) + "\n"


def _odometry_note(outcomes: Sequence[Outcome]) -> str:
    used = dict.fromkeys(outcome.odometry for outcome in outcomes)
    return "; ".join(ODOMETRIES.get(name, ("", f"from {name}"))[1] for name in used)


def _runtime(outcomes: Sequence[Outcome], published: Published) -> str:
    theirs = published.runtime
    lines = [
        "## Runtime of the optimisation",
        "",
        "Seconds for so many first frames of a sequence on this computer, other processes beside it: all updates of "
        "our live graph, and one solve of the batch in SE(3), of odometry of unknown scale (as the paper's) and of "
        "metric odometry, each the median of three runs. A batch has its iterations in brackets; one that has not "
        "converged ran once and has no ratio. The factors of the unknown scale are Python in gtsam's solver, the "
        "others are its own. `runtime.png` shows each update.",
        "",
        "| Seq | frames | incremental | batch, unscaled | ratio | batch, metric | ratio |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        f"| published, {theirs.sequence} | {theirs.frames} | {theirs.incremental_s} | {theirs.batch_s} | "
        f"{theirs.batch_s / theirs.incremental_s:.0f} | - | - |",
    ]
    for o in outcomes:
        name = f"{o.sequence}, images" if o.odometry == "images" else o.sequence
        for t in o.timings:
            cells = [f"{b.seconds:.2f} ({b.iterations}) | {_ratio(b, t.incremental_s)}" for b in (t.unscaled, t.metric)]
            lines.append(f"| {name} | {t.frames} | {t.incremental_s:.3f} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines) + "\n"


def _ratio(batch: BatchTiming, incremental_s: float) -> str:
    return f"{batch.seconds / max(incremental_s, 1e-9):.1f}" if batch.converged else "not converged"
