"""Lane lines as curves in the graph: what they are worth to the ego and to vehicles, and the most they could be worth.

    python -m perf lane_edges --logs DIR [--model ROLE=PATH ...] [--clips 0005,0002] [--seeds 3] [--rendered DIR ...]

ATE in m, nothing aligned, ego and the mean car, live. Logs are those of `perf edges`; simulated drives have no lines,
so that only what is true is tried on them; a rendered drive is a folder of `perf roads --keep`. *True line*: painted
without a gap at the left of the true way, seen to 25 m without error, 2 cm stated. *True places*: each car's true place
across its way, 10 cm stated, and heading, 20 mrad, once in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from birdslam.bench.figures import markdown
from birdslam.bench.tracking.benchmark import Truth, ours
from birdslam.perf.graph.edges import Case, Variant, case_parser, cases_of, grade, log_of
from birdslam.perf.graph.lane_curves import (
    EgoOnLines,
    SeenCurve,
    VehiclesOnLanes,
    line_along,
    poses_on_curves,
    seen_curves,
    vehicles_in_lanes,
)
from birdslam.perf.reporting.figures import write_json
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.options import configuration_of
from birdslam.slam import SlamConfig
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import as_poses, inverse, mount_pose, split_pose
from birdslam.types import Measurements
from birdslam.vehicles.placement.localisation import iou

label = "what lane lines as curves are worth in the graph, and the most that they could be"

SURE_M = 0.02
CARS = frozenset({"car", "van", "truck", "bus"})
LEAST_OVERLAP = 0.5  # intersection over union of a box and the body's


def variants(case: Case) -> dict[str, Variant]:
    """All that are compared on a case; the first is the default."""
    base = Variant(ours(SlamConfig()))
    painted = line_along(case.ego, SURE_M)
    held: dict[int, list[object]] = {}
    if case.truth is not None:
        for frame, record in poses_on_curves(case.truth.ego, case.truth.vehicles, case.truth.matches):
            held.setdefault(frame, []).append(record)

    def true_line(m: Measurements) -> Sequence[SeenCurve]:
        return (painted[m.frame_id],) if m.frame_id in painted else ()

    ego, vehicles = (lambda: (EgoOnLines(),)), (lambda: (VehiclesOnLanes(),))
    return {
        "default": base,
        "ego on its lines": replace(base, factors=ego, records=seen_curves),
        "... ten times as sure": replace(base, factors=ego, records=lambda m: seen_curves(m, 0.01)),
        "ego on a true line": replace(base, factors=ego, records=true_line),
        "cars in their lanes": replace(base, factors=vehicles, records=vehicles_in_lanes),
        "cars by true places": replace(base, factors=vehicles, records=lambda m: held.get(m.frame_id, ())),
    }


def rendered(folder: Path, logs: Path, configuration: Configuration) -> Case:
    """A rendered drive's log of its images with its true poses and bodies."""
    recording = DemoRecording(folder)
    log = log_of(f"demo:{folder}", logs / f"{folder.name}.log", configuration)
    mount, camera = mount_pose(recording.camera.ground), as_poses(recording.truth_poses())
    first = inverse(camera[log[0].frame_id])
    ego = {m.frame_id: split_pose(mount @ first @ camera[m.frame_id] @ inverse(mount))[0] for m in log}
    truth = Truth(ego, {}, {}, {}, [])
    for m in log:
        bodies = [body for body in recording.truth_bodies(m.frame_id) if body.label in CARS]
        for body in bodies:
            truth.vehicles.setdefault(body.body, {})[m.frame_id] = ego[m.frame_id] @ body.T_ego_body
            truth.kinds[body.body] = body.label
        overlap = iou(np.array([body.box_px for body in bodies]), np.array([edge.box_px for edge in m.cv]))
        truth.matches[m.frame_id] = {
            body.body: edge.vehicle
            for body, row in zip(bodies, overlap, strict=True)
            for edge, shared in zip(m.cv, row, strict=True)
            if shared > LEAST_OVERLAP
        }
    return Case(folder.name, log, ego, recording.camera, truth)


def run(arguments: list[str]) -> None:
    parser = case_parser("lane_edges", label)
    parser.add_argument("--rendered", type=Path, nargs="*", default=[], metavar="DIR", help="drives of `perf roads`")
    options = parser.parse_args(arguments)
    output, options.output = options.output, None  # of the benchmark, not of a drive
    configuration = configuration_of(options)
    seen, drives = cases_of(options, configuration)
    cases = [*seen, *(rendered(folder, options.logs, configuration) for folder in options.rendered), *drives]
    grades: dict[str, dict[str, dict[str, float]]] = {}
    for case in cases:
        for name, variant in variants(case).items():
            grades.setdefault(name, {})[case.name] = grade(variant, case)
        print(f"{case.name}: {sum(len(seen_curves(m)) for m in case.log)} sights of lines", flush=True)
    table = markdown(["log", "", *grades], [row for case in cases for row in _rows(case.name, grades)])
    print(table)
    if output is not None:
        write_json(output, {"table": table, "grades": grades})


def _rows(case: str, grades: dict[str, dict[str, dict[str, float]]]) -> list[list[str]]:
    found = [
        (what, [of[case].get(what) for of in grades.values()]) for what in ("ego", "cars, live", "NEES of the ego")
    ]
    return [
        [case, what, *("-" if v is None else f"{v:.3f}" for v in values)]
        for what, values in found
        if any(v is not None for v in values)
    ]
