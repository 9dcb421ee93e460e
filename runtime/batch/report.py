"""Writes the report of all drives: report.json, report.csv, and a page with a table and plots.

It reads the results drive by drive, so that only the plotted numbers are kept in memory.
"""

from __future__ import annotations

import csv
import html
import importlib.util
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np

from birdslam.outputs.drive_files import FRAMES_FILE, ResultsError
from birdslam.outputs.report.drive_table import read_drive
from birdslam.outputs.report.page import REPORT, plotly_script, report_page
from birdslam.runtime.batch.drive import DRIVES, RESULT, DriveResult, Failure, failure_file
from birdslam.runtime.batch.drives import Task

MAX_BARS = 40  # of a plot; more drives are drawn as a histogram
MAX_STATUSES = 12
PLOTLY = "plotly.js"  # shared by the pages of all drives
MAX_IN_A_CELL = 4  # statuses of one drive
COLUMNS = (
    "drive", "source", "settings", "error", "frames", "duration_s", "path_m", "mean_speed_mps", "top_speed_mps",
    "vehicles", "invalid_frames", "epochs", "statuses", "ate_m", "ate_pct", "ate_se3_m", "ate_sim3_m", "scale_error",
    "rpe_t_m", "rpe_r_deg",
)  # fmt: skip
PLOTS = (
    ("path_m", "distance (m)"),
    ("mean_speed_mps", "mean speed (m/s)"),
    ("vehicles", "vehicles"),
    ("invalid_frames", "invalid frames"),
    ("ate_m", "ATE (m), with ground truth"),
)
STYLE = (
    ":root{color-scheme:light dark}body{font:15px sans-serif;margin:2em;background:Canvas}table{"
    "border-collapse:collapse;margin:1em 0}"
    "td,th{padding:.25em .7em;border-bottom:1px solid #8888;text-align:right}"
    "td:first-child,th:first-child{text-align:left}"
    ".wide{overflow-x:auto}.failed{color:#d1342f;text-align:left}img{max-width:100%;background:#fff}a{color:inherit}"
)

Outcome = DriveResult | Failure


def outcomes(tasks: Sequence[Task], output: Path) -> Iterator[Outcome]:
    """Yields the outcome of every finished drive, in order."""
    for task in tasks:
        result, failure = output / DRIVES / task.name / RESULT, failure_file(output, task.name)
        if result.is_file():
            yield msgspec.json.decode(result.read_bytes(), type=DriveResult)
        elif failure.is_file():
            yield msgspec.json.decode(failure.read_bytes(), type=Failure)


def row(outcome: Outcome) -> dict[str, Any]:
    """Returns one row of the report; unknown values are None."""
    out: dict[str, Any] = dict.fromkeys(COLUMNS)
    truth = outcome.truth if isinstance(outcome, DriveResult) else None
    for part in (outcome, truth):
        if part is not None:
            own = {name: value for name, value in msgspec.structs.asdict(part).items() if name in out}
            out |= {name: value for name, value in own.items() if part is outcome or out[name] is None}
    return out


def write_report(tasks: Sequence[Task], output: Path) -> None:
    """Writes report.json, report.csv, report.html and report.png. Raises ResultsError."""
    try:
        _whole(output / "report.json", lambda file: _write_json(file, tasks, output))
        _whole(output / "report.csv", lambda file: _write_csv(file, tasks, output))
        names, numbers, statuses = _numbers(tasks, output)
        _plot(names, numbers, statuses, output / "report.png")
        _write_drives(tasks, output)
        _whole(output / "report.html", lambda file: _write_page(file, tasks, output))
    except OSError as error:
        raise ResultsError(f"report in {output}: {error.strerror}") from None


def _write_drives(tasks: Sequence[Task], output: Path) -> None:
    """Writes a page for each drive if plotly is installed; all pages share its script."""
    if importlib.util.find_spec("plotly") is None:
        return
    _whole(output / PLOTLY, lambda file: file.write(plotly_script()))
    for outcome in outcomes(tasks, output):
        folder = output / DRIVES / outcome.drive
        if (folder / FRAMES_FILE).is_file() and not (folder / REPORT).is_file():
            page = report_page(read_drive(folder), plotly=f"../../{PLOTLY}")
            _whole(folder / REPORT, lambda file, page=page: file.write(page))  # type: ignore[misc]


def _whole(path: Path, write: Callable[[IO[str]], object]) -> None:
    """Writes a file atomically; on failure the old file stays."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", encoding="utf-8", newline="") as file:
        write(file)
    os.replace(partial, path)


def _write_json(file: IO[str], tasks: Sequence[Task], output: Path) -> None:
    counts = Counter("failed" if isinstance(o, Failure) else "done" for o in outcomes(tasks, output))
    left = len(tasks) - counts.total()
    file.write(f'{{"done": {counts["done"]}, "failed": {counts["failed"]}, "left": {left}, "drives": [')
    for number, outcome in enumerate(outcomes(tasks, output)):
        file.write(("," if number else "") + "\n" + msgspec.json.encode(outcome).decode())
    file.write("\n]}\n")


def _write_csv(file: IO[str], tasks: Sequence[Task], output: Path) -> None:
    table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    table.writeheader()
    for outcome in outcomes(tasks, output):
        table.writerow({name: _cell(value) for name, value in row(outcome).items()})


def _cell(value: Any) -> Any:
    return " ".join(f"{key}={entry}" for key, entry in value.items()) if isinstance(value, dict) else value


def _numbers(tasks: Sequence[Task], output: Path) -> tuple[list[str], np.ndarray, Counter[str]]:
    """Returns names, numbers (N, len(PLOTS)) with nan for unknown, and the number of frames with each status."""
    names, numbers, statuses = [], [], Counter[str]()
    for outcome in outcomes(tasks, output):
        if isinstance(outcome, DriveResult):
            found = row(outcome)
            names.append(outcome.drive)
            numbers.append([np.nan if found[column] is None else found[column] for column, _ in PLOTS])
            statuses.update(outcome.statuses)
    return names, np.array(numbers, dtype=np.float64).reshape(-1, len(PLOTS)), statuses


def _plot(names: list[str], numbers: np.ndarray, statuses: Counter[str], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow import
    from matplotlib.figure import Figure

    bars = len(names) <= MAX_BARS
    row_in = 1.5 + 0.25 * max(len(names), 4) if bars else 4.0
    figure = Figure(figsize=(13.0, 3.0 * row_in), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 2).ravel()
    for plot, (_, title), values in zip(axes, PLOTS, numbers.T, strict=False):
        known = np.isfinite(values)
        if bars:
            plot.barh(range(len(names)), np.where(known, values, 0.0), color="#3a7ca5")
            plot.set_yticks(range(len(names)), [name[-32:] for name in names], fontsize=8)
            plot.invert_yaxis()
        elif known.any():
            plot.hist(values[known], bins=30, color="#3a7ca5")
            plot.set_ylabel("drives")
        plot.set_title(title)
    common = statuses.most_common(MAX_STATUSES)
    axes[-1].barh([name for name, _ in common], [count for _, count in common], color="#c0504d")
    axes[-1].invert_yaxis()
    axes[-1].set_title("frames with each status")
    partial = path.with_name(f".{path.name}.partial")
    figure.savefig(partial, format="png")
    os.replace(partial, path)


def _write_page(file: IO[str], tasks: Sequence[Task], output: Path) -> None:
    head = '<!doctype html><html lang="en"><meta charset="utf-8">'
    wide = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    file.write(f"{head}{wide}<title>BirdSLAM: drives</title><style>{STYLE}</style>\n<body>")
    file.write('<h1>Drives</h1>\n<p><img src="report.png" alt="plots"></p>\n')
    if any(task.settings for task in tasks):
        _write_sweep(file, tasks, output)
    heads = (
        "drive",
        "frames",
        "s",
        "m",
        "m/s",
        "top m/s",
        "vehicles",
        "invalid",
        "ATE m",
        "ATE %",
        "scale error",
        "statuses",
    )
    file.write('<div class="wide"><table><tr>' + "".join(f"<th>{head}</th>" for head in heads) + "</tr>\n")
    for outcome in outcomes(tasks, output):
        name = html.escape(outcome.drive)
        if isinstance(outcome, Failure):
            error = html.escape(outcome.error)
            file.write(f'<tr><td>{name}</td><td class="failed" colspan="{len(heads) - 1}">{error}</td></tr>\n')
            continue
        found = row(outcome)
        columns = ("frames", "duration_s", "path_m", "mean_speed_mps", "top_speed_mps", "vehicles", "invalid_frames")
        cells = [found[column] for column in (*columns, "ate_m", "ate_pct", "scale_error")]
        most = sorted(outcome.statuses.items(), key=lambda one: -one[1])[:MAX_IN_A_CELL]
        cells.append(", ".join(f"{name} {count}" for name, count in most))
        page = REPORT if (output / DRIVES / outcome.drive / REPORT).is_file() else "bev.png"
        link = f'<a href="{DRIVES}/{name}/{page}">{name}</a>'
        file.write(f"<tr><td>{link}</td>" + "".join(f"<td>{_text(cell)}</td>" for cell in cells) + "</tr>\n")
    file.write("</table></div>\n</body></html>\n")


def _write_sweep(file: IO[str], tasks: Sequence[Task], output: Path) -> None:
    """Writes a table of drives by settings: the ATE, or the distance without ground truth."""
    cells: dict[str, dict[str, str]] = {}
    heads: dict[str, None] = {}
    for outcome in outcomes(tasks, output):
        head = " ".join(f"{key}={value}" for key, value in outcome.settings.items())
        heads[head] = None
        found = row(outcome)
        shown = f"{found['ate_m']:.3f} m ATE" if found["ate_m"] is not None else f"{_text(found['path_m'])} m"
        cells.setdefault(outcome.source, {})[head] = "failed" if isinstance(outcome, Failure) else shown
    file.write("<h2>By settings</h2>\n<table><tr><th>drive</th>")
    file.write("".join(f"<th>{html.escape(head or 'default')}</th>" for head in heads) + "</tr>\n")
    for source, own in cells.items():
        row_cells = "".join(f"<td>{own.get(head, '')}</td>" for head in heads)
        file.write(f"<tr><td>{html.escape(source)}</td>{row_cells}</tr>\n")
    file.write("</table>\n")


def _text(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
