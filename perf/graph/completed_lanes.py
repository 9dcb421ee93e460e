"""The paper's Table 5 on images: lanes completed by the network, in the batch in SE(3) and in the graph of Eqs. 5-8.

    python -m perf completed_lanes --logs DIR [--model ROLE=PATH ...] [--clips 0005,0002] [--rendered DIR ...]

ATE in m, nothing aligned, ego and the mean car. A rendered drive is a folder of `perf roads --keep`, each drawn by a
seed of its own. *Seen lanes* are those of the same drive without the network. `--set method=paper` has the paper's own
front end; logs of it need a folder of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from birdslam.bench.baselines.trajectories import Method
from birdslam.bench.figures import markdown
from birdslam.bench.tracking.ablation import lane_variants
from birdslam.bench.tracking.benchmark import EGO, LEAST_FRAMES, PAPER
from birdslam.bench.tracking.completed_lanes import of_kind, with_completed_lanes
from birdslam.bench.tracking.metrics import path_errors
from birdslam.bench.tracking.tables import UNCONVERGED
from birdslam.geometry.camera import Camera
from birdslam.perf.graph.edges import CLIPS, Case, case_parser, recorded
from birdslam.perf.graph.lane_edges import rendered
from birdslam.perf.reporting.figures import write_json
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.options import configuration_of
from birdslam.sources.opening import open_recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.types import LandmarkKind, Measurements

label = "the paper's Table 5 on images: lanes completed by the network as constraints, and without it"

WHAT = ("ego", "cars")


@dataclass(frozen=True)
class Drive:
    """A case with the lanes that the network completed, and the same log without it."""

    completed: Case
    seen: list[Measurements]
    camera: Camera


@dataclass(frozen=True)
class Column:
    """A method, what of the log it takes, and the column that it is held against."""

    title: str
    method: Method
    against: str = ""
    lanes: bool = False  # the lanes of many frames in place of all other landmarks
    seen: bool = False  # of the log without the network

    def log(self, drive: Drive) -> list[Measurements]:
        """The drive's log for it."""
        log = drive.seen if self.seen else drive.completed.log
        return of_kind(with_completed_lanes(log), LandmarkKind.LANE_STATION) if self.lanes else log


def columns() -> list[Column]:
    """Table 5's batch, and the paper's graph, whose Eq. 7 has lanes."""
    batch = lane_variants()
    without = replace(PAPER, weights=msgspec.structs.replace(PAPER.weights, leave_out=("cp",)))
    before, alone = "batch before lanes", "Eq. 8 without CP"
    return [
        Column(before, batch["before_lanes"]),
        Column("all landmarks of single frames", batch["after_lanes"], before),
        Column("completed lanes", batch["after_lanes"], before, lanes=True),
        Column("seen lanes", batch["after_lanes"], before, lanes=True, seen=True),
        Column(alone, without),
        Column("Eq. 8, all of single frames", PAPER, alone),
        Column("Eq. 8, completed lanes", PAPER, alone, lanes=True),
        Column("Eq. 8, seen lanes", PAPER, alone, lanes=True, seen=True),
    ]


def errors(column: Column, drive: Drive) -> tuple[dict[str, float], bool]:
    """ATE of "ego" and, as "cars", of the mean car, and whether the method ended at its minimum."""
    result = column.method.run(column.log(drive), drive.camera)
    ego = path_errors(drive.completed.ego, result.ego)
    assert ego is not None
    out = {EGO: ego.ate_m}
    if drive.completed.truth is not None:
        found = drive.completed.truth.errors(result)
        cars = [e.ate_m for k, e in found.items() if k != EGO and e is not None and e.frames >= LEAST_FRAMES]
        if cars:
            out["cars"] = float(np.mean(cars))
    return out, result.converged


def run(arguments: list[str]) -> None:
    parser = case_parser("completed_lanes", label)
    parser.add_argument("--rendered", type=Path, nargs="*", default=[], metavar="DIR", help="drives of `perf roads`")
    parser.set_defaults(seeds=0)
    options = parser.parse_args(arguments)
    output, options.output = options.output, None  # of the benchmark, not of a drive
    configuration = configuration_of(options)
    drives = [
        *(_clip(name, options.data, options.logs, configuration) for name in options.clips.split(",") if name),
        *(_rendered(folder, options.logs, configuration) for folder in options.rendered),
    ]
    found: dict[str, dict[str, dict[str, float]]] = {column.title: {} for column in columns()}
    cells: dict[str, list[str]] = {f"{drive.completed.name} {what}": [] for drive in drives for what in WHAT}
    for drive in drives:
        name = drive.completed.name
        for column in columns():
            of, converged = errors(column, drive)
            found[column.title][name] = of
            for what in WHAT:
                text = f"{of[what]:.2f}" + UNCONVERGED * (not converged) if what in of else "-"
                cells[f"{name} {what}"].append(text)
        counts = [sum(point.lane >= 0 for m in log for point in m.lanes) for log in (drive.completed.log, drive.seen)]
        print(f"{name}: {counts[0]} points of completed lanes, {counts[1]} of seen ones", flush=True)
    table = markdown(
        ["ATE in m", *found],
        [*([row, *of] for row, of in cells.items() if set(of) != {"-"}), *(["", *_against(found, w)] for w in WHAT)],
    )
    print(table)
    if output is not None:
        write_json(output, {"table": table, "ate_m": found})


def _against(found: dict[str, dict[str, dict[str, float]]], what: str) -> list[str]:
    """For each column how much better it is than its own, in the geometric mean, with the spread, and on how many."""
    cells = []
    for column in columns():
        of, other = found[column.title], found.get(column.against, {})
        both = [name for name in of if what in of[name] and name in other]
        if not both:
            cells.append(f"{what}, over its own")
            continue
        ratios = np.log([of[name][what] / other[name][what] for name in both])
        better = int((ratios < 0.0).sum())
        cells.append(
            f"x {np.exp(ratios.mean()):.2f} (spread x {np.exp(ratios.std()):.2f}), better on {better} of {len(both)}"
        )
    return cells


def _logs(folder: Path, configuration: Configuration) -> dict[str, tuple[Path, Configuration]]:
    return {
        name: (
            folder / name,
            msgspec.structs.replace(
                configuration, models=msgspec.structs.replace(configuration.models, completion=name == "completed")
            ),
        )
        for name in ("completed", "seen")
    }


def _clip(name: str, data: Path, folder: Path, configuration: Configuration) -> Drive:
    of = {which: recorded(name, data, *where) for which, where in _logs(folder, configuration).items()}
    camera = open_recording(f"kitti:{data / CLIPS[name][0]}").camera
    return Drive(of["completed"], of["seen"].log, camera)


def _rendered(folder: Path, logs: Path, configuration: Configuration) -> Drive:
    of = {which: rendered(folder, *where) for which, where in _logs(logs, configuration).items()}
    return Drive(of["completed"], of["seen"].log, DemoRecording(folder).camera)
