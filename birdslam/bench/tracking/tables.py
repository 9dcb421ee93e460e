"""The paper's Tables 1-5 as Markdown: published, re-implemented and ours in columns of their own.

A row is a body here and a method a column, so that the three sources stand side by side; numbers are ATE (RMS, metres),
with `*` where a solver ended short of its minimum.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

from birdslam.bench.figures import markdown, mean, number
from birdslam.bench.tracking.benchmark import EGO, Row, mean_ate_m
from birdslam.sources.recording import DatasetError

ODOMETRIES = {  # as it is called in a row, and at length
    "simulate": (
        "simulated odometry",
        "SIMULATED (true poses with the errors that our image odometry has on real clips, landmarks drawn beside the "
        "true path)",
    ),
    "images": ("images", "from the images where a row says so"),
}
OURS = {
    "birdslam_live": "ours, live",
    "birdslam": "**ours, final**",
}
Cells = dict[str, dict[str, float]]  # sequence -> body -> metres

METHOD_TITLES = {
    "nair": "Nair",
    "namdev": "Namdev",
    "batch_se3": "batch SE(3)",
    "cubeslam": "CubeSLAM",
    "paper": "BirdSLAM",
}
REDONE_TITLES = {  # of the re-implemented; a batch knows the whole log, as what is final does
    "nair": "Nair, batch",
    "namdev": "Namdev, batch",
    "batch_se3": "batch SE(3)",
    "cubeslam": "CubeSLAM, batch",
    "paper": "BirdSLAM, live",
    "paper_final": "BirdSLAM, final",
    "paper_eq1": "BirdSLAM by Eq. 1, live",
    "paper_eq1_final": "BirdSLAM by Eq. 1, final",
}
UNCONVERGED = " \\*"  # of a batch that ended short of its minimum
VARIANT_TITLES = {
    "without_cc": "without CC",
    "without_cv": "without CV",
    "without_vv": "without VV",
    "without_cp": "without CP",
    "all": "with all",
    "cp_low": "CP low",
    "cp_medium": "CP medium",
    "cp_high": "CP high",
    "depth_12": "T = 12 m",
    "depth_15": "T = 15 m",
    "depth_18": "T = 18 m",
    "depth_20": "T = 20 m",
    "depth_none": "no T",
    "before_lanes": "before lanes",
    "after_lanes": "after lanes",
}
CONSTRAINTS, LANDMARKS, LANES = tuple(VARIANT_TITLES)[:5], tuple(VARIANT_TITLES)[5:13], tuple(VARIANT_TITLES)[13:]


class PaperSequence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the paper takes of a sequence: how many frames, and which cars it reports."""

    frames: int
    cars: tuple[int, ...]

    @property
    def bodies(self) -> tuple[str, ...]:
        """The cars' ids as they stand in rows."""
        return tuple(str(car) for car in self.cars)


class PublishedTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table: `ate_m[column][sequence][body]`."""

    where: str
    what: str
    ate_m: dict[str, Cells]
    frames: dict[str, dict[str, int]] = {}
    average_m: dict[str, float] = {}


class Published(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """birdslam/bench/tracking/published.toml."""

    sequences: dict[str, PaperSequence]
    table1: PublishedTable
    table2: PublishedTable
    table3: PublishedTable
    table4: PublishedTable
    table5: PublishedTable


def read_published(path: Path) -> Published:
    """The paper's numbers. Raises DatasetError naming the file and the key."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Published)
    except OSError as error:
        raise DatasetError(f"{path}: can't be read: {error.strerror}") from None
    except (ValueError, msgspec.ValidationError) as error:
        raise DatasetError(f"{path}: {error}") from None


def methods_table(rows: Sequence[Row], published: Published, ego: bool) -> str:
    """Table 1 (vehicles) or 2 (ego)."""
    table = published.table2 if ego else published.table1
    chosen = _chosen(rows)
    redone = [name for name in REDONE_TITLES if name in chosen]
    own = [name for name in OURS if name in chosen]
    head = ["Seq", "Car", "odometry", "frames"]
    head += [f"published: {title}" for title in METHOD_TITLES.values()]
    head += [f"re-implemented: {REDONE_TITLES[name]}" for name in redone]
    head += [OURS[name] for name in own]
    bodies = {s: (EGO,) if ego else paper.bodies for s, paper in published.sequences.items()}
    lines = []
    for sequence, names in bodies.items():
        for body in names:
            here = [row for row in rows if (row.sequence, row.body) == (sequence, body)]
            for odometry in dict.fromkeys(row.odometry for row in here) or ("",):
                of = {row.method: row for row in here if row.odometry == odometry}
                any_row = next(iter(of.values()), None)
                line = [sequence, body, odometry_title(odometry)]
                line.append("" if any_row is None else f"{any_row.frames:g} of {any_row.frames_labelled}")
                line += [number(table.ate_m.get(name, {}).get(sequence, {}).get(body)) for name in METHOD_TITLES]
                line += [_row_number(of.get(name)) for name in (*redone, *own)]
                lines.append(line)
    for odometry in dict.fromkeys(row.odometry for row in rows) or ("",):
        alike = [row for row in rows if row.odometry == odometry]
        present = _present(alike, bodies)
        means: list[str] = ["mean", "of those at hand", odometry_title(odometry), ""]
        means += [number(_published_mean(table.ate_m.get(name, {}), present)) for name in METHOD_TITLES]
        for name in (*redone, *own):
            cut = any(
                row.unconverged for row in alike if row.method == name and row.body in present.get(row.sequence, ())
            )
            means.append(number(mean_ate_m(alike, name, present)) + UNCONVERGED * cut)
        lines.append(means)
    return markdown(head, lines)


def odometry_title(odometry: str) -> str:
    """What a row says of where its ego motion comes from."""
    return ODOMETRIES.get(odometry, (odometry,))[0]


def variants_table(rows: Sequence[Row], published: Published, table: PublishedTable, columns: Sequence[str]) -> str:
    """Table 3 or 4: `rows` have "paper/VARIANT" and "birdslam/VARIANT" for methods."""
    chosen = _chosen(rows)
    sources = [("re-implemented", "paper/"), ("ours", "birdslam/")]
    sources = [(title, prefix) for title, prefix in sources if any(name.startswith(prefix) for name in chosen)]
    head = ["Seq", "Car"]
    for column in columns:
        head += [f"{VARIANT_TITLES[column]}: published", *(title for title, _ in sources)]
    bodies = {s: (*paper.bodies, EGO) for s, paper in published.sequences.items()}
    lines = []
    for sequence, names in bodies.items():
        for body in names:
            of = {row.method: row for row in rows if (row.sequence, row.body) == (sequence, body)}
            line = [sequence, body]
            for column in columns:
                line.append(number(table.ate_m[column].get(sequence, {}).get(body)))
                line += [_row_number(of.get(prefix + column), spread=False) for _, prefix in sources]
            lines.append(line)
    present = _present(rows, bodies)
    means = ["mean", "of those at hand"]
    for column in columns:
        means.append(number(_published_mean(table.ate_m[column], present)))
        means += [number(mean_ate_m(rows, prefix + column, present)) for _, prefix in sources]
    return markdown(head, [*lines, means])


def ideas_table(rows: Sequence[Row], published: Published) -> str:
    """A row for each idea ("ideas/NAME"), the paper's bodies that are at hand in columns."""
    paper = {s: (*one.bodies, EGO) for s, one in published.sequences.items()}
    bodies = list(dict.fromkeys((row.sequence, row.body) for row in rows if row.body in paper.get(row.sequence, ())))
    egos, cars = ([at for at in bodies if (at[1] == EGO) is ego] for ego in (True, False))
    lines = []
    for name in _chosen(rows):
        of = {(row.sequence, row.body): row for row in rows if row.method == name}
        means = [mean(of[at].ate_m for at in some if at in of) for some in (cars, egos)]
        cells = [_row_number(of.get(at)) for at in (*cars, *egos)]
        lines.append([name.removeprefix("ideas/"), *cells, *map(number, means)])
    titles = [f"{sequence}/{body}" for sequence, body in (*cars, *egos)]
    return markdown(["ours over the paper", *titles, "mean, cars", "mean, ego"], lines)


def lanes_table(rows: Sequence[Row], published: Published) -> str:
    """Table 5, over the paper's bodies, by odometry."""
    head = ["Seq", "Car", "odometry", "frames: published", "at hand"]
    for column in LANES:
        head += [f"{VARIANT_TITLES[column]}: published", "re-implemented"]
    rows = [row for row in rows if row.method in LANES]
    table, lines = published.table5, []
    for sequence, paper in published.sequences.items():
        for body in (*paper.bodies, EGO):
            here = [row for row in rows if (row.sequence, row.body) == (sequence, body)]
            frames = table.frames.get(sequence, {}).get(body)
            if frames is None and not here:
                continue
            for odometry in dict.fromkeys(row.odometry for row in here) or ("",):
                of = {row.method: row for row in here if row.odometry == odometry}
                any_row = next(iter(of.values()), None)
                line = [sequence, body, odometry_title(odometry), number(frames, 0)]
                line.append("" if any_row is None else f"{any_row.frames:g}")
                for column in LANES:
                    line.append(number(table.ate_m[column].get(sequence, {}).get(body)))
                    line.append(_row_number(of.get(column), spread=False))
                lines.append(line)
    return markdown(head, lines)


def _chosen(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row.method for row in rows))


def _present(rows: Iterable[Row], bodies: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
    at_hand = {row.sequence for row in rows}
    return {sequence: names for sequence, names in bodies.items() if sequence in at_hand}


def _published_mean(cells: Cells, bodies: Mapping[str, Sequence[str]]) -> float | None:
    numbers = [cells.get(sequence, {}).get(body) for sequence, names in bodies.items() for body in names]
    return mean(numbers) if None not in numbers else None


def _row_number(row: Row | None, spread: bool = True) -> str:
    if row is None or row.ate_m is None:
        return "-"
    spread_m = row.ate_m_spread if spread and row.seeds > 1 else None
    return f"{row.ate_m:.2f}" + ("" if spread_m is None else f" ± {spread_m:.2f}") + UNCONVERGED * (row.unconverged > 0)
