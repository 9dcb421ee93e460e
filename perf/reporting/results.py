"""docs/results.md and README.md's table, made of what is kept of the evaluations' reports in docs/results/NAME.json.

    python -m perf results                          # both anew
    python -m perf pages --write [NAME ...]         # runs the evaluations that are old (or these) before that

The page's words are in docs/results/page.md.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from birdslam.bench.tracking.benchmark import EGO, SEEN_EXACTLY, Row, mean_ate_m
from birdslam.bench.tracking.tables import METHOD_TITLES, read_published
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting import measured
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.machine import ROOT
from birdslam.runtime.pages.tables import table

label = "docs/results.md and the README's table, from the reports of the evaluations"

KEPT = ROOT / "docs" / "results"
TEXT = KEPT / "page.md"  # the page without its figures
README = ROOT / "README.md"
REAL = "--model detector={models}/yolox_nano_416.onnx --model segmenter={models}/twinlitenet_640x360.onnx"
SEQUENCES = "{data}/kitti_odometry/sequences"
TRACKING = "{data}/kitti_tracking/training"
PLACES = f"localisation {TRACKING} --sequences 0000,0001,0002,0003,0004,0005,0006,0008 --detections rrc"
DRAWS = 5  # of the simulated tilt: one moves the medians by a tenth of them
ODOMETRY_FIELDS = (
    *("sequence", "frames", "path_m", "ate_m", "ate_pct", "ate_se3_m", "scale_error", "rpe_t_m", "rpe_r_deg"),
    *("segment_t_pct", "standing_drift_m"),
)
MOTION_FIELDS = {"motion_nees": "frames", "stretch_nees": "stretches"}
CARS = {  # of the paper
    "0002": ("1",),
    "0003": ("0", "1"),
    "0004": ("2",),
    "0005": ("31",),
    "0010": ("0",),
    "0018": ("1", "2", "3"),
    "0020": ("12", "122"),
}
METHODS = {
    "paper": "the paper's method, re-implemented, live",
    "paper_final": "the paper's method, re-implemented, final",
    "paper_eq1": "the paper's method with the paper's placing of vehicles, live",
    "paper_eq1_final": "the paper's method with the paper's placing of vehicles, final",
    "nair": "Nair et al., re-implemented",
    "birdslam_live": "ours, live",
    "birdslam": "**ours, final**",
    SEEN_EXACTLY: "of it the ego's: cars seen exactly from our live ego",
}

Figures = Any  # plain JSON


@dataclass(frozen=True)
class Evaluation:
    """A report: the command that writes it, and what of it is kept."""

    command: str  # of `birdslam evaluate`
    keep: Callable[[Any], Figures]

    def kept(self, report: str) -> str:
        """The text of docs/results/NAME.json, of the report's."""
        return json.dumps(self.keep(json.loads(report)), indent=1) + "\n"


def _odometry(report: Sequence[Mapping[str, Any]]) -> Figures:
    kept = []
    for row in report:
        ego, ahead = row["ego"], row["car_ahead"]
        few = {name: row[name] for name in ODOMETRY_FIELDS} | {"nees": ego and ego["nees"]}
        motion = row.get("motion") or {}
        few |= {name: motion.get(part, {}).get("nees_measured") for name, part in MOTION_FIELDS.items()}
        kept.append(few | {"car_ahead": ahead})
    return _short(kept)


def _localisation(report: Sequence[Mapping[str, Any]]) -> Figures:
    names = ("range", "n", "depth_error_median_rel", "lateral_error_median_m", "inside_1_sigma", "inside_2_sigma")
    whole = [row for row in report if row["sequence"] == "all"]
    worst = {
        row["range"]: max(
            other["depth_error_median_rel"] or 0.0
            for other in report
            if other["range"] == row["range"] and other["sequence"].isdigit()
        )
        for row in whole
    }
    return _short([{name: row[name] for name in names} | {"worst_sequence_rel": worst[row["range"]]} for row in whole])


def _tracking(report: Sequence[Mapping[str, Any]]) -> Figures:
    every = msgspec.convert(report, list[Row])
    rows = [row for row in every if row.odometry != "images"]
    egos = dict.fromkeys(CARS, (EGO,))
    kept: dict[str, Any] = {"seeds": rows[0].seeds}
    for method in METHODS:
        of = {(row.sequence, row.body): row.ate_m for row in rows if row.method == method}
        kept[method] = {_body(sequence, car): of.get((sequence, car)) for sequence in CARS for car in CARS[sequence]}
        seen = {
            (row.sequence, row.body): row.ate_m for row in every if (row.method, row.odometry) == (method, "images")
        }
        if seen:
            at = {_body(s, body): seen.get((s, body)) for s in CARS for body in (*CARS[s], EGO) if (s, EGO) in seen}
            kept[f"{method}, images"] = at
        kept[method] |= {"mean, cars": mean_ate_m(rows, method, CARS), "mean, ego": mean_ate_m(rows, method, egos)}
    return _short(kept)


def _body(sequence: str, body: str) -> str:
    return f"{int(sequence)}/{body}"


def _short(value: Any) -> Any:
    """With as many digits as a page can need."""
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, Mapping):
        return {key: _short(inner) for key, inner in value.items()}
    return [_short(inner) for inner in value] if isinstance(value, list) else value


EVALUATIONS = {
    "odometry": Evaluation(
        f"odometry {SEQUENCES}/00 {SEQUENCES}/01 {SEQUENCES}/06 {{data}}/kitti_raw_clip "
        f"{{data}}/kitti_tracking/training/image_03/0005 {REAL}",
        _odometry,
    ),
    "odometry_from_14": Evaluation(f"odometry {SEQUENCES}/00 --frames 14: {REAL}", _odometry),
    "odometry_stride_2": Evaluation(f"odometry {SEQUENCES}/00 {SEQUENCES}/06 --stride 2 {REAL}", _odometry),
    "odometry_moving_median": Evaluation(
        f"odometry {SEQUENCES}/00 {SEQUENCES}/06 {{data}}/kitti_raw_clip {REAL} "
        "--constant slam.frontend.odometry.road.mode=paper",
        _odometry,
    ),
    "odometry_demo": Evaluation("odometry demo", _odometry),
    "odometry_shipped": Evaluation(f"odometry {SEQUENCES}/00 {SEQUENCES}/06 {{data}}/kitti_raw_clip", _odometry),
    "localisation": Evaluation(f"{PLACES} --draws {DRAWS}", _localisation),
    "localisation_paper": Evaluation(f"{PLACES} --mode paper", _localisation),
    "tracking": Evaluation(f"tracking {TRACKING} --frames paper {REAL}", _tracking),
}

COLUMNS = (  # of the odometry's table: field, title, format, what stands behind it
    ("frames", "frames", "d", ""),
    ("path_m", "path", ".1f", " m"),
    ("ate_m", "ATE", ".2f", " m"),
    ("ate_pct", "ATE", ".1f", "%"),
    ("ate_se3_m", "rigid", ".2f", " m"),
    ("scale_error", "scale error", "+.1%", ""),
    ("rpe_t_m", "RPE", ".3f", " m"),
    ("rpe_r_deg", "RPE", ".3f", " deg"),
    ("segment_t_pct", "KITTI segments", ".1f", "%"),
    ("standing_drift_m", "drift while standing", ".2f", " m"),
    ("nees", "NEES", ".1f", ""),
    ("motion_nees", "NEES of a motion", ".2f", ""),
    ("stretch_nees", "of 10 m", ".2f", ""),
)
DRIVES = {
    "odometry": "",
    "odometry_from_14": ", `--frames 14:`",
    "odometry_stride_2": ", every second frame",
    "odometry_moving_median": ", the paper's moving median of the scale",
    "odometry_demo": " (shipped drive and network)",
}
README_PARTS = {  # evaluation, or page, -> the rows of the summary that are of it
    "odometry": "ego motion, the car ahead",
    "odometry_demo": "the shipped drive",
    "localisation": "places",
    "tracking": "trajectories",
    "report": "age",
}


def run(arguments: list[str]) -> None:
    """Writes the page and the README's table. Raises PerfError."""
    benchmark_parser("results", label, output="").parse_args(arguments)
    for file, text in texts().items():
        (ROOT / file).write_text(text, encoding="utf-8")
        print(file)


def texts() -> dict[str, str]:
    """What is to stand in the page and in the README. Raises PerfError."""
    found, when = kept(), measured.load()
    return {"docs/results.md": page(found, when), "README.md": readme(README.read_text(encoding="utf-8"), found, when)}


def readme(text: str, found: Mapping[str, Figures], when: Mapping[str, measured.Measured]) -> str:
    """With the one table, and what it was measured with under it."""
    there = rf"\| what \| how good \| command \|\n(?:\|.*\n)+\n(?:{measured.BEGINNING}(?:.+\n)+\n)?"
    made = f"{summary(found)}\n\n{measured.line(when, README_PARTS)}\n\n"
    new, tables = re.subn(there, lambda _: made, text)
    if tables != 1:
        raise PerfError(f"{README} has {tables} tables of what, how good, command, not one")
    return new


def tables_page(report: str) -> str:
    """docs/tables.md: the evaluation's report unchanged, and the command that wrote it."""
    title, _, rest = report.partition("\n")
    about = (
        "Written by `python -m perf pages --write tracking`, which runs\n\n"
        f"    {_command('tracking')}\n\n"
        "[results.md](results.md) has the means, [ablations.md](ablations.md) what the ablations say. DATA and MODELS "
        "are the\nfolders of recordings and networks.\n"
    )
    return f"{title}\n\n{about}{rest}"


def kept() -> dict[str, Figures]:
    """What is kept of each report, by its name. Raises PerfError where the checkout's docs are not there."""
    if not TEXT.is_file():
        raise PerfError(f"{TEXT} is not there: the page is part of the checkout, and no wheel has it")
    return {name: json.loads((KEPT / f"{name}.json").read_text()) for name in EVALUATIONS}


def page(found: Mapping[str, Figures], when: Mapping[str, measured.Measured]) -> str:
    """The whole of docs/results.md."""
    ahead = _ahead(found["odometry"])
    return TEXT.read_text().format(
        summary=summary(found),
        measured=measured.line(when, {name: f"`{name}`" for name in (*EVALUATIONS, "report")}),
        **{name: _command(name) for name in EVALUATIONS},
        odometry_table=_odometry_table(found),
        shipped=", ".join(f"{row['ate_pct']:.1f} %" for row in found["odometry_shipped"]),
        car_ahead=_command("odometry").replace("odometry ", "car-ahead ", 1),
        ahead_median=_percent(ahead["error_median_rel"]),
        ahead_p90=_percent(ahead["error_p90_rel"]),
        ahead_frames=ahead["frames"],
        ahead_shipped=_percent(_ahead(found["odometry_shipped"])["error_median_rel"], ".0"),
        localisation_table=_localisation_table(found),
        seeds=found["tracking"]["seeds"],
        tracking_table=tracking_table(found["tracking"]),
    )


def summary(found: Mapping[str, Figures]) -> str:
    """The one table of the README: what, how good, and the command of each row."""
    rows = [("what", "how good", "command")]
    names = {
        "00": "KITTI 00, its first 12 s",
        "01": "KITTI 01, a ramp, 5 s",
        "06": "KITTI 06, 5 s",
        "kitti_raw_clip": "KITTI raw, stop and go",
        "0005": "KITTI tracking 0005, 30 s",
    }
    for row in (*found["odometry"], *found["odometry_demo"]):
        what = f"ego motion, {names.get(row['sequence'], 'the shipped drive')}, {row['path_m']:.0f} m"
        scale = _percent(row["scale_error"], "+.1")
        good = f"ATE {row['ate_m']:.2f} m ({row['ate_se3_m']:.2f} after rigid motion), scale {scale}"
        rows.append((what, good, "`birdslam evaluate odometry`"))
    ahead = _ahead(found["odometry"])
    good = f"median error {_percent(ahead['error_median_rel'])}, 90 % within {_percent(ahead['error_p90_rel'])}"
    rows.append(("distance to the car ahead, against LiDAR", good, "`birdslam evaluate car-ahead`"))
    ranges = [(row["range"], _percent(row["depth_error_median_rel"])) for row in found["localisation"]]
    good = "depth off in the median by " + ", ".join(f"{error} at {span} m" for span, error in ranges)
    rows.append(("places of cars, KITTI tracking", good, "`birdslam evaluate localisation`"))
    kept, published = found["tracking"], _published()
    for whose, name in (("eleven cars", "mean, cars"), ("seven egos", "mean, ego")):
        ours, theirs = (_metres(kept[method][name]) for method in ("birdslam_live", "paper"))
        good = f"ATE {ours} m in the mean, live; the paper's method on the same log {theirs}, live; "
        good += f"published, from images, {published[name]:.2f}"
        what = f"trajectories of the paper's {whose}; recorded boxes, simulated odometry"
        rows.append((what, good, "`birdslam evaluate tracking`"))
    report = (ROOT / "perf" / "results" / "report.md").read_text()
    age, cores = re.search(r"^\| system \|(.*)$", report, re.MULTILINE), re.search(r", (\d+) cores, ", report)
    assert age is not None
    assert cores is not None
    rate, dropped, *_, p50, p99, _, worst, _ = (cell.strip() for cell in age[1].strip("|").split("|"))
    good = f"p50 {p50}, p99 {p99}, max {worst} ms; {dropped} frames dropped"
    rows.append((f"age at the planner, {rate} Hz, {cores[1]} cores", good, "`python -m perf system`"))
    return table(rows)


def _command(name: str) -> str:
    return f"birdslam evaluate {EVALUATIONS[name].command.format(data='DATA', models='MODELS')}"


def _ahead(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    found: Mapping[str, Any] = next(row["car_ahead"] for row in rows if row["car_ahead"])
    return found


def _odometry_table(found: Mapping[str, Figures]) -> str:
    head = ("sequence", *(title for _, title, _, _ in COLUMNS))
    body = [
        (f"{row['sequence']}{kind}", *(_cell(row[field], form, after) for field, _, form, after in COLUMNS))
        for name, kind in DRIVES.items()
        for row in found[name]
    ]
    return table([head, *body])


def _cell(value: float | None, form: str, after: str) -> str:
    return "" if value is None else f"{value:{form}}{after}".replace("%", " %")


def _percent(share: float, form: str = ".1") -> str:
    return f"{share:{form}%}".replace("%", " %")


def _localisation_table(found: Mapping[str, Figures]) -> str:
    head = (
        "range",
        f"cars seen, in {DRAWS} draws",
        "depth error, median",
        "worst sequence",
        "paper mode",
        "lateral error, median",
    )
    body = [
        (
            f"{row['range']} m",
            str(row["n"]),
            _percent(row["depth_error_median_rel"]),
            _percent(row["worst_sequence_rel"]),
            _percent(paper["depth_error_median_rel"]),
            f"{row['lateral_error_median_m']:.2f} m",
            f"{_percent(row['inside_1_sigma'], '.0')} / {_percent(row['inside_2_sigma'], '.0')}",
        )
        for row, paper in zip(found["localisation"], found["localisation_paper"], strict=True)
    ]
    return table([(*head, "inside 1 / 2 sigma"), *body])


def _published() -> dict[str, float]:
    """Of the paper's own method (its Tables 1 and 2), where labels are at hand."""
    published = read_published(ROOT / "birdslam" / "bench" / "tracking" / "published.toml")
    cars, egos = published.table1.ate_m["paper"], published.table2.ate_m["paper"]
    out = {_body(sequence, car): cars[sequence][car] for sequence in CARS for car in CARS[sequence]}
    out |= {"mean, cars": sum(out.values()) / len(out)}
    return out | {"mean, ego": sum(egos[sequence][EGO] for sequence in CARS) / len(CARS)}


def tracking_table(kept: Mapping[str, Any]) -> str:
    """The rows of docs/tables.md's first table, as Markdown: the errors of each method, and the published ones."""
    lines = {f"published {METHOD_TITLES['paper']}": _published()}
    lines |= {title: kept[method] for method, title in METHODS.items() if method in kept}
    lines |= {
        f"{title}, images": kept[key] for method, title in METHODS.items() if (key := f"{method}, images") in kept
    }
    columns = [*kept["birdslam"]]
    columns = list(dict.fromkeys([*columns, *(column for errors in lines.values() for column in errors)]))
    body = [(title, *(_metres(errors.get(column)) for column in columns)) for title, errors in lines.items()]
    return table([("ATE, m", *columns), *body])


def _metres(ate_m: float | None) -> str:
    return "-" if ate_m is None else f"{ate_m:.2f}"
