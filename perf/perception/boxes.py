"""The same boxes by `run --detections`, as `supervision.Detections` and as `norfair.Detection`: do they give the same?

    python -m perf boxes [--source demo] [--frames 60]

The shipped network's boxes of a recording are written to a file of COCO results. `birdslam run` drives by it, each
process its own; then `BirdSLAM.step` by either library's objects of the same boxes, and its answers go back into them.
Status 1 where an estimate or an answer differs in one bit. A library that is not installed is named.
"""

from __future__ import annotations

import importlib
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from birdslam.integrations import norfair as norfair_adapter
from birdslam.integrations import supervision as supervision_adapter
from birdslam.perception import Detections, ModelSpec, load_network
from birdslam.perception.external import external_detections
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import run_birdslam
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.runtime.recording.recorded_drive import recorded_drive
from birdslam.runtime.recording.recording import Recording
from birdslam.slam import BirdSLAM
from birdslam.sources.detection_file import COCO, read_detection_file
from birdslam.sources.opening import open_recording
from birdslam.types import Estimate, Frame, VehicleEstimate
from birdslam.vehicles.placed_boxes import PlacedBox

label = "the same boxes by a file, by supervision and by norfair: estimates and answers that differ"

CATEGORIES = {name: number for number, name in COCO.items()}
NONE = external_detections([], [])
Vehicles = dict[int, tuple[VehicleEstimate, ...]]  # by frame
Answer = Sequence[PlacedBox | None]


@dataclass(frozen=True)
class Library:
    """How boxes become its objects, these our detections, and our answers numbers of these: a row a box."""

    name: str
    objects: Callable[[Any, Detections], Any]
    ours: Callable[[Any], Detections]
    answered: Callable[[Any, Answer], list[float | None]]


def _supervision(library: Any, boxes: Detections) -> Any:
    names = {"class_name": np.array(boxes.labels, dtype=str)}
    return library.Detections(boxes.boxes_px, confidence=boxes.scores, data=names)


def _supervisions_metres(theirs: Any, placed: Answer) -> list[float | None]:
    supervision_adapter.add_metres(theirs, placed)
    return [None if np.isnan(metres) else float(metres) for metres in theirs.data["distance_m"]]


def _norfair(library: Any, boxes: Detections) -> Any:
    rows = zip(boxes.boxes_px, boxes.scores, boxes.labels, strict=True)
    return [library.Detection(box.reshape(2, 2), scores=np.array([score] * 2), label=name) for box, score, name in rows]


def _norfairs_metres(theirs: Any, placed: Answer) -> list[float | None]:
    norfair_adapter.add_metres(theirs, placed)
    return [None if (place := each.data[norfair_adapter.KEY]) is None else place.distance_m for each in theirs]


LIBRARIES = (
    Library("supervision", _supervision, supervision_adapter.from_supervision, _supervisions_metres),
    Library("norfair", _norfair, norfair_adapter.from_norfair, _norfairs_metres),
)


def run(arguments: list[str]) -> int:
    """Prints a line a way; 1 where one differs from the file's."""
    parser = benchmark_parser("boxes", label, output="")
    parser.add_argument("--source", default="demo", metavar="URI")
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args(arguments)
    recording = open_recording(options.source)
    frames = list(islice(recording.undistorted_frames(), options.frames))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "boxes.json"
        file.write_text(json.dumps(list(found_boxes(frames))))
        boxes = read_detection_file(file)
        by_file = driven(options.source, file, len(frames))
    vehicles = sum(map(len, by_file.values()))
    print(
        f"run --detections: {len(frames)} frames of {options.source}, "
        f"{sum(map(len, boxes.values()))} boxes, {vehicles} estimates of vehicles"
    )
    differing = 0
    for library in LIBRARIES:
        try:
            module = importlib.import_module(library.name)
        except ImportError as error:
            print(f"{library.name}: left out, it is not here ({error})")
            continue
        slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
        others, wrong, placed = handed_over(library, module, slam, frames, boxes)
        apart = differences(others, by_file)
        differing += apart + wrong
        version = getattr(module, "__version__", "")
        print(f"{library.name} {version}: {apart} of {vehicles} estimates differ, {wrong} of {placed} answers")
    return int(differing > 0)


def found_boxes(frames: Sequence[Frame]) -> Iterator[dict[str, Any]]:
    """What the shipped network finds, as COCO's results."""
    network = load_network("multitask", ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK)))
    for frame in frames:
        found = None if frame.image is None else network.run(frame.image)
        if found is None or found.detections is None:
            raise PerfError(f"frame {frame.frame_id}: the network gave no boxes")
        boxes = found.detections
        for (x1, y1, x2, y2), score, name in zip(boxes.boxes_px, boxes.scores, boxes.labels, strict=True):
            if name in CATEGORIES:
                box = [float(x1), float(y1), float(x2 - x1), float(y2 - y1)]
                yield {"image_id": frame.frame_id, "category_id": CATEGORIES[name], "bbox": box, "score": float(score)}


def driven(source: str, file: Path, frames: int) -> Vehicles:
    """The vehicles of each frame, by the processes of a run at rate "max"."""
    recorded = file.with_name("drive.mcap")
    run_birdslam(
        *("run", "--source", source, "--detections", str(file), "--rate", "max", "--record", str(recorded)),
        *("--set", f"source.frames={frames}", "--output", str(file.parent / "out")),
    )
    records = recorded_drive([Recording(recorded)])
    return {record.frame_id: record.vehicles for record in records if isinstance(record, Estimate)}


def handed_over(
    library: Library, module: Any, slam: BirdSLAM, frames: Sequence[Frame], boxes: dict[int, Detections]
) -> tuple[Vehicles, int, int]:
    """By a library's objects: the vehicles of each frame, answers that came back otherwise than given, boxes placed."""
    vehicles: Vehicles = {}
    wrong = known = 0
    for frame in frames:
        theirs = library.objects(module, boxes.get(frame.frame_id, NONE))
        _, estimate, placed = slam.step(frame, library.ours(theirs))
        vehicles[frame.frame_id] = estimate.vehicles
        given = [None if place is None else place.distance_m for place in placed]
        wrong += sum(a != b for a, b in zip(library.answered(theirs, placed), given, strict=True))
        known += sum(place is not None for place in placed)
    return vehicles, wrong, known


def differences(found: Vehicles, expected: Vehicles) -> int:
    """Vehicles that are not the same to the bit, or there on one side alone."""
    total = 0
    for frame in found.keys() | expected.keys():
        ours = {each.vehicle: each for each in found.get(frame, ())}
        theirs = {each.vehicle: each for each in expected.get(frame, ())}
        total += sum(ours.get(number) != theirs.get(number) for number in ours.keys() | theirs.keys())
    return total
