"""How far off the edges of detectors' boxes are, and what sigma that makes: by family, or of boxes of your own.

    python -m perf box_edges [--places] [--data DIR] [--models DIR] [--output F.json]
    python -m perf box_edges --boxes FILE --truth FILE

RRC's recorded boxes of KITTI tracking, and boxes of two networks on 0002 and 0005 as they leave the network; files are
as `run --detections` takes them. `--places`: the front end's depths of cars, too. `fitted` says what a sigma is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES, match_cars, measure
from birdslam.bench.tracking.metrics import MATCH_IOU, assign
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.perception import ModelSpec, load_network
from birdslam.perception.decoding.detection import Detections, EdgeSigma
from birdslam.perception.families import FAMILIES
from birdslam.perception.manifest_file import shipped_manifests
from birdslam.perception.schedule import NO_DETECTIONS
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.detection_file import read_detection_file
from birdslam.sources.kitti import find_images, read_image
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence, open_tracking, read_detections
from birdslam.vehicles.placement.localisation import LocalisationConfig, iou

label = "how far off the edges of detectors' boxes are, by family; or those of a file, against drawn ones"

EDGES = ("left", "right", "upper", "lower")
NETWORKS = {"yolox": "yolox_nano_416", "ssd": "vehicle_detection_adas_0002_640x192"}  # of families, in --models
IMAGES = ("0002", "0005")
RECORDED, RECORDED_BOXES = "rrc", "det_02_rrc"
LEAST_PX = 25.0  # of a drawn box's height, as of KITTI's easier cars
AT_BORDER_PX = 2.0
PX, RELS = (0.25, 0.4, 0.5, 0.75, 1.0, 1.5, 2.0), np.arange(0.0, 0.2, 0.0025)
WITHIN = ((0.683, 1.0), (0.954, 2.0))  # shares of a normal distribution, and how many sigma wide
PLACED = ("0000", "0003", "0006", "0012")  # of the recorded ones, for --places
FEWEST = 30  # matched boxes of a sequence that is judged


@dataclass(frozen=True)
class Edges:
    """N found boxes beside drawn ones: `off_px` and the `side_px` across each edge (N, 4) as EDGES, widths by score."""

    off_px: Floats
    side_px: Floats
    wider: Floats  # (N, 1)

    def __len__(self) -> int:
        return len(self.off_px)

    def in_sigmas(self, sigma: EdgeSigma) -> Floats:
        """(N, 4) differences over their sigmas."""
        return np.abs(self.off_px) / (self.wider * np.hypot(self.side_px * np.array(sigma.rel), sigma.px))

    def shares(self, sigma: EdgeSigma) -> list[tuple[float, float]]:
        """Of each edge, how many are within one sigma and two."""
        inside = self.in_sigmas(sigma)
        return [(float(np.mean(edge <= 1.0)), float(np.mean(edge <= 2.0))) for edge in inside.T]


def joined(parts: Iterable[Edges]) -> Edges:
    """All of them."""
    many = list(parts)
    return Edges(*(np.concatenate([getattr(each, name) for each in many]) for name in ("off_px", "side_px", "wider")))


def fitted(edges: Edges) -> EdgeSigma:
    """Of an edge the sigma is sqrt((rel * side)^2 + px^2), wider as the score falls (`wider`).

    `rel` is the least of RELS by which 68 % of the edges are within it and 95 % within twice it, their mean error
    counted in; `px` of PX what makes small and large boxes alike. Each sequence, of networks each half of one, is
    judged by what the others give, and by what its family has.
    """

    def least(px: float) -> list[float]:
        rels = []
        for off, side in zip((edges.off_px / edges.wider).T, edges.side_px.T, strict=True):
            sigmas = np.hypot(side * RELS[:, None], px)
            enough = [np.mean(np.abs(off) <= times * sigmas, axis=1) >= share for share, times in WITHIN]
            rels.append(float(RELS[max(int(np.argmax(each)) if each.any() else len(RELS) - 1 for each in enough)]))
        return rels

    def uneven(sigma: EdgeSigma) -> float:
        found = edges.in_sigmas(sigma)
        low = edges.side_px[:, 3] < np.median(edges.side_px[:, 3])
        of_low, of_high = (np.quantile(found[rows], WITHIN[0][0], axis=0) for rows in (low, ~low))
        return float(np.abs(np.log(of_low / of_high)).sum())

    (a, b, upper, lower), px = min(
        ((least(px), px) for px in PX),
        key=lambda tried: uneven(EdgeSigma(tuple(tried[0]), tried[1])),  # type: ignore[arg-type]
    )
    across = max(a, b)
    return EdgeSigma((across, across, upper, lower), px)


def beside(found: Detections, drawn: Floats, size_px: tuple[int, int] | None) -> Edges:
    """The boxes that were drawn, whole ones of a frame (M, 4), and what was found of them."""
    config = LocalisationConfig()
    boxes = found.boxes_px[[i for i, name in enumerate(found.labels) if name in config.vehicles]]
    scores = found.scores[[i for i, name in enumerate(found.labels) if name in config.vehicles]]
    rows, columns = assign(iou(drawn, boxes), MATCH_IOU)
    truth, box, score = drawn[rows], boxes[columns], scores[columns]
    sides = (truth[:, 2:] - truth[:, :2])[:, [0, 0, 1, 1]]
    whole = sides[:, 3] >= LEAST_PX
    if size_px is not None:
        whole &= (truth[:, :2] > AT_BORDER_PX).all(axis=1)
        whole &= (truth[:, 2:] < np.array(size_px) - AT_BORDER_PX).all(axis=1)
    wider = 1.0 + config.sigma_growth * np.maximum(0.0, config.sure_score - score[:, None])
    off = (box - truth)[:, [0, 2, 1, 3]]
    return Edges(off[whole], sides[whole], wider[whole])


def of_labels(sequence: TrackingSequence, found: Sequence[Detections], first: int = 0) -> Edges:
    """A sequence's vehicles in full view; `found` are the boxes of each frame from `first` on."""
    size_px = sequence.camera.width_px, sequence.camera.height_px
    parts = []
    for frame, detections in enumerate(found, first):
        here = [o for o in sequence.labels_of(frame) if o.kind in VEHICLE_KINDS]
        clear = [o for o in here if o.truncated <= 0 and o.occluded == 0]
        parts.append(beside(detections, np.array([o.box_px for o in clear]).reshape(-1, 4), size_px))
    return joined(parts)


def networks_boxes(path: Path, sequence: TrackingSequence) -> list[Detections]:
    """What a network finds in each frame, its edges as they leave it: not moved by what its manifest says of them."""
    manifest = shipped_manifests()[path.stem].read_text()
    lines = [line for line in manifest.splitlines() if not line.startswith("drawn_inside")]
    with TemporaryDirectory() as folder:
        as_it_is = Path(folder) / "manifest.toml"
        as_it_is.write_text("\n".join(lines))
        network = load_network("detector", ModelSpec(path=str(path), manifest=str(as_it_is), threads=1))
    assert sequence.images is not None
    out = [NO_DETECTIONS] * len(sequence)
    for frame, image in find_images(sequence.images).items():
        found = network.run(read_image(image))
        if frame < len(out) and found is not None and found.detections is not None:
            out[frame] = found.detections
    return out


def run(arguments: list[str]) -> None:
    """Prints a row for each family and sequence."""
    parser = benchmark_parser("box_edges", label)
    add_data(parser)
    parser.add_argument("--models", type=Path, default=Path("../shared/models"), help="of the networks")
    parser.add_argument("--boxes", type=Path, metavar="FILE", help="another detector's, as run --detections takes them")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="the same frames' drawn boxes, in such a file")
    parser.add_argument("--places", action="store_true", help="the front end's depths of cars, too")
    options = parser.parse_args(arguments)
    if (options.boxes is None) != (options.truth is None):
        parser.error("--boxes and --truth are of one another")
    with Ledger(options.output, label) as ledger:
        if options.boxes is not None:
            _own(ledger, options.boxes, options.truth)
        else:
            _families(ledger, options.data / "kitti_tracking" / "training", options.models, options.places)


def _own(ledger: Ledger, boxes: Path, truth: Path) -> None:
    found, drawn = read_detection_file(boxes), read_detection_file(truth)
    parts = [beside(found[frame], drawn[frame].boxes_px, None) for frame in sorted(found.keys() & drawn.keys())]
    if not parts or len(edges := joined(parts)) < FEWEST:
        raise PerfError(f"{boxes}: fewer than {FEWEST} boxes lie over drawn ones of {truth}")
    _add(ledger, boxes.name, edges, fitted(edges))


def _families(ledger: Ledger, root: Path, models: Path, places: bool) -> None:
    names = sorted(path.stem for path in (root / RECORDED_BOXES / "Car").glob("*.txt"))
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    recorded = [read_detections(root / RECORDED_BOXES, each.name, len(each)) for each in sequences]
    _family(ledger, RECORDED, {o.name: of_labels(o, boxes) for o, boxes in zip(sequences, recorded, strict=True)})
    seen = [open_tracking(root, name) for name in IMAGES]
    found = {family: [networks_boxes(models / f"{stem}.onnx", of) for of in seen] for family, stem in NETWORKS.items()}
    for family, boxes_of in found.items():
        halves: dict[str, Edges] = {}
        for sequence, of in zip(seen, boxes_of, strict=True):
            middle = len(sequence) // 2
            halves[f"{sequence.name} first half"] = of_labels(sequence, of[:middle])
            halves[f"{sequence.name} second half"] = of_labels(sequence, of[middle:], middle)
        _family(ledger, family, halves)
    if places:
        judged = [(of, boxes) for of, boxes in zip(sequences, recorded, strict=True) if of.name in PLACED]
        for sequence, boxes in judged:
            _place(ledger, RECORDED, sequence, boxes)
        for family, boxes_of in found.items():
            for sequence, boxes in zip(seen, boxes_of, strict=True):
                _place(ledger, family, sequence, boxes)


def _place(ledger: Ledger, family: str, sequence: TrackingSequence, boxes: Sequence[Detections]) -> None:
    for name, sigma in (("one for all", None), (family, FAMILIES[family])):
        given = [replace(each, edge_sigma=sigma) for each in boxes]
        errors = [e for e in match_cars(sequence, measure(sequence, given, FrontEndConfig(), True)) if not e.cut]
        if len(errors) < FEWEST:
            return
        rel = np.array([e.error_m[0] / e.depth_m for e in errors])
        sigmas = np.array([abs(e.error_m[0]) / e.sigma_depth_m for e in errors])
        cars, median = len({e.label for e in errors}), float(np.median(np.abs(rel)))
        within = [float(np.mean(sigmas <= times)) for _, times in WITHIN]
        row = {"cars": cars, "sights": len(errors), "depth_error_median_rel": median, "within": within}
        shown = f"{len(errors)} sights of {cars} cars, median error {100.0 * median:.1f} %, "
        shown += f"within {within[0]:.2f}/{within[1]:.2f}"
        ledger.add(f"{family} {sequence.name}, depths by {name}", shown, **row)


def _family(ledger: Ledger, family: str, by_sequence: dict[str, Edges]) -> None:
    enough = {name: edges for name, edges in by_sequence.items() if len(edges) >= FEWEST}
    whole = joined(enough.values())
    _add(ledger, f"{family}: all", whole, fitted(whole), FAMILIES[family], LocalisationConfig().edge_sigma)
    for name, edges in enough.items() if len(enough) > 1 else ():
        others = fitted(joined(of for other, of in enough.items() if other != name))
        _add(ledger, f"{family} {name}, by the others", edges, others, FAMILIES[family])


def _add(ledger: Ledger, name: str, edges: Edges, *sigmas: EdgeSigma) -> None:
    bias = np.median(edges.off_px / edges.side_px, axis=0)
    row: dict[str, Any] = {"boxes": len(edges), "median_rel": dict(zip(EDGES, bias.round(4).tolist(), strict=True))}
    shown = [f"{len(edges)} boxes, medians " + " ".join(f"{100.0 * each:+.1f}" for each in bias) + " %"]
    row["by"] = []
    for sigma in sigmas:
        shares = edges.shares(sigma)
        row["by"].append({"rel": sigma.rel, "px": sigma.px, "within": dict(zip(EDGES, shares, strict=True))})
        rel = " ".join(f"{100.0 * each:.2f}" for each in sigma.rel)
        inside = " ".join(f"{one:.2f}/{two:.2f}" for one, two in shares)
        shown.append(f"{rel} % {sigma.px:g} px: within {inside}")
    ledger.add(name, "; ".join(shown), **row)
