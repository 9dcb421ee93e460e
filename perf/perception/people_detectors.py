"""How well detectors find people, riders and motorcycles on labelled frames of KITTI tracking (0002, 0005).

    python -m perf people_detectors [--network F.onnx ...] [--every 5] [--data DIR] [--output F.json]

Recall is over labels of at least LEAST_PX rows that are neither truncated nor heavily occluded, at IoU 0.5; precision
over boxes of that height that lie in no DontCare region. A rider's box is joined of person and bicycle as the front
end joins them. Milliseconds are of one frame on one thread, and of this machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from birdslam.bench.tracking.metrics import assign
from birdslam.geometry.arrays import Floats
from birdslam.people.people_boxes import PeopleBoxesConfig, people_boxes
from birdslam.perception import ModelSpec, load_network
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.kitti import find_images, read_image
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking
from birdslam.sources.label_projection import DONT_CARE, Label
from birdslam.sources.recording import DatasetError
from birdslam.vehicles.placement.localisation import iou

label = "detectors of people and cyclists on labelled frames: recall, precision, milliseconds"

SEQUENCES = ("0002", "0005")
# Ours -> the labels'; whoever is found at all is followed, be it under the other class
KINDS = {"pedestrian": ("Pedestrian",), "cyclist": ("Cyclist",), "anybody": ("Pedestrian", "Cyclist")}
LEAST_PX = 25.0
MATCH_IOU = 0.5


class Counts(msgspec.Struct):
    """Of one class."""

    labels: int = 0
    found: int = 0
    boxes: int = 0
    right: int = 0

    def ratios(self) -> dict[str, float | int | None]:
        """Recall and precision, None where nothing was asked."""
        return {
            "labels": self.labels,
            "recall": round(self.found / self.labels, 3) if self.labels else None,
            "precision": round(self.right / self.boxes, 3) if self.boxes else None,
        }


def run(arguments: list[str]) -> None:
    """Prints a row for each network, and writes them."""
    parser = benchmark_parser("people_detectors", label)
    parser.add_argument("--network", action="append", required=True, metavar="F.onnx", help="may be repeated")
    parser.add_argument("--every", type=int, default=5, help="one frame in so many")
    add_data(parser)
    options = parser.parse_args(arguments)
    root = options.data / "kitti_tracking" / "training"
    sequences = [open_tracking(root, name) for name in SEQUENCES]
    with Ledger(options.output, label, every=options.every) as ledger:
        for path in options.network:
            row = measure(path, sequences, options.every)
            ledger.add(Path(path).stem, "  ".join(f"{name} {value}" for name, value in row.items()), **row)


def measure(path: str, sequences: Sequence[TrackingSequence], every: int) -> dict[str, object]:
    """One network's counts by class, and its median milliseconds."""
    network = load_network("multitask" if "multitask" in path else "detector", ModelSpec(path=path, threads=1))
    counts, times_ms = {kind: Counts() for kind in KINDS}, []
    for sequence in sequences:
        if sequence.images is None:
            raise DatasetError(f"{sequence.name}: has no images")
        for frame, image_path in list(find_images(sequence.images).items())[::every]:
            image = read_image(image_path)
            before_s = time.perf_counter()
            findings = network.run(image)
            times_ms.append(1e3 * (time.perf_counter() - before_s))
            if findings is None or findings.detections is None:
                continue
            seen = people_boxes(findings.detections, sequence.camera, sequence.camera.ground, PeopleBoxesConfig())
            here = sequence.labels_of(frame)
            for kind in KINDS:
                boxes = np.array([box.box_px for box in seen if kind in (box.label, "anybody")]).reshape(-1, 4)
                _count(counts[kind], here, KINDS[kind], boxes)
    of_kinds = {f"{kind}_{name}": value for kind, c in counts.items() for name, value in c.ratios().items()}
    return {**of_kinds, "frames": len(times_ms), "median_ms": round(float(np.median(times_ms)), 1)}


def _count(counts: Counts, here: Sequence[Label], kinds: Sequence[str], boxes: Floats) -> None:
    every = [o for o in here if o.kind in kinds]
    clear = np.array(
        [o.truncated <= 0 and o.occluded <= 1 and o.box_px[3] - o.box_px[1] >= LEAST_PX for o in every], dtype=np.bool_
    )
    rows, columns = assign(iou(np.array([o.box_px for o in every]).reshape(-1, 4), boxes), MATCH_IOU)
    counts.labels += int(clear.sum())
    counts.found += int(clear[rows].sum())
    matched = set(columns.tolist())
    regions = np.array([o.box_px for o in here if o.kind == DONT_CARE]).reshape(-1, 4)
    for k, box in enumerate(boxes):
        span = np.clip(np.minimum(box[2:], regions[:, 2:]) - np.maximum(box[:2], regions[:, :2]), 0.0, None)
        ignored = bool((span.prod(axis=1) > 0.5 * np.prod(box[2:] - box[:2])).any())
        if k in matched or (box[3] - box[1] >= LEAST_PX and not ignored):
            counts.boxes += 1
            counts.right += k in matched
