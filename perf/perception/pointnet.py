"""Where a vehicle's depth puts it, on held-out worlds: Frustum-PointNet, the geometric fit, and Eq. 1 beside them.

    python -m perf pointnet [--network F.onnx] [--frames 300] [--depth noisy|network] [--output F.json]

`noisy`: the worlds' exact depth with the errors that depth networks make, in the bodies' own boxes, drawn a little
wrong. `network`: depth and boxes as the shipped multi-task network finds them in the image. Eq. 1 stands on the true
road, its pitch off by PITCH_ERROR_RAD; without a multi-task body, which says it, the vehicle's yaw is taken to be
the ego's, as that of a new track is. Needs the extra [train].
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.perception import DepthMap, ModelSpec, Network, load_network
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.perception.manifest import SHIPPED_NETWORKS
from birdslam.perception.pointnet import PointNet, load_pointnet
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.vehicles.placement.depth_fusion import DepthPlace, PseudoLidarConfig, fuse
from birdslam.vehicles.placement.localisation import LocalisationConfig, Observation, Place, iou, observe_boxes, place
from birdslam.vehicles.placement.pseudolidar import localise_by_depth, places_of
from birdslam.vehicles.placement.tyre_contact import bottom_at_face
from birdslam.vehicles.placement.uncertain_yaw import HeadingConfig
from birdslam.vehicles.placing import Assignment

if TYPE_CHECKING:
    from birdslam.world.truth import WorldFrame, WorldObject

label = "vehicles' places by depth: Frustum-PointNet, geometric fit and Eq. 1 on held-out worlds"

LOCALISATION = LocalisationConfig()

IMAGE_PX, MAP_PX = (640, 192), (320, 96)
FIRST_SEED = 1_000  # training draws from two million on
RANGES_M = ((0.0, 10.0), (10.0, 30.0), (30.0, 60.0))
PITCH_ERROR_RAD = 0.003
SAME_IOU = 0.5
INSIDE_1_SIGMA, INSIDE_2_SIGMA = 2.30, 6.18  # chi-square of two degrees of freedom at 68.3 and 95.4 %


@dataclass
class Errors:
    """Of one method in one range."""

    centre_rel: list[float] = field(default_factory=list)  # of the distance
    centre_m: list[float] = field(default_factory=list)
    axis_rad: list[float] = field(default_factory=list)
    flipped: list[bool] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)  # Mahalanobis

    def figures(self) -> dict[str, float]:
        """Medians and shares."""
        squares = np.array(self.squares)
        out = {
            "vehicles": float(len(self.centre_m)),
            "centre_median_m": float(np.median(self.centre_m)),
            "centre_median_rel": float(np.median(self.centre_rel)),
            "inside_1_sigma": float(np.mean(squares < INSIDE_1_SIGMA)),
            "inside_2_sigma": float(np.mean(squares < INSIDE_2_SIGMA)),
        }
        if self.axis_rad:
            out["yaw_median_deg"] = math.degrees(float(np.median(self.axis_rad)))
        if self.flipped:
            out["flips"] = float(np.mean(self.flipped))
        return out


@dataclass(frozen=True)
class Sample:
    """A frame's depth and its observed vehicles, each with its truth."""

    frame: WorldFrame
    depth: DepthMap
    seen: list[Observation]
    truth: list[WorldObject]
    bodies: list[DepthPlace | None]  # of the multi-task network


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("pointnet", label)
    parser.add_argument("--network", type=Path, default=SHIPPED_NETWORKS / "pointnet.onnx", help="a Frustum-PointNet")
    parser.add_argument("--multitask", type=Path, default=SHIPPED_NETWORKS / "multitask.onnx")
    parser.add_argument("--frames", type=int, default=300, help="each of a world of its own")
    parser.add_argument("--depth", choices=("noisy", "network"), default="noisy")
    options = parser.parse_args(arguments)
    if any(importlib.util.find_spec(name) is None for name in ("numba", "torch")):
        raise PerfError("held-out worlds need the extra [train]: numba, torch")
    pointnet = load_pointnet(ModelSpec(str(options.network), threads=1))
    if options.depth == "network":
        samples = _seen_by(load_network("multitask", ModelSpec(str(options.multitask))), options.frames)
    else:
        samples = _noisy(options.frames)
    with Ledger(options.output, label, network=pointnet.describe(), depth=options.depth) as ledger:
        for (method, near_m, far_m), errors in measured(samples, pointnet).items():
            if errors.centre_m:
                figures = errors.figures()
                line = "  ".join(f"{name} {value:.3f}" for name, value in figures.items())
                ledger.add(f"{method} {near_m:g}-{far_m:g} m", line, **figures)


def measured(samples: Iterator[Sample], pointnet: PointNet) -> dict[tuple[str, float, float], Errors]:
    """Errors by method and range."""
    config = PseudoLidarConfig()
    methods = (
        *("Eq. 1", "geometric fit", "Frustum-PointNet", "Eq. 1 + PointNet"),
        *("multi-task body", "Eq. 1 + multi-task body"),
    )
    found = {(method, *range_m): Errors() for method in methods for range_m in RANGES_M}
    rng = np.random.default_rng(1)
    for sample in samples:
        camera, true = sample.frame.camera, sample.frame.camera.ground
        pitch_rad = true.pitch_rad + float(rng.normal(0.0, PITCH_ERROR_RAD))
        ground = GroundPlane(true.height_m, pitch_rad, true.roll_rad)
        by_box = [by_bottom(o, ground, LOCALISATION) for o in sample.seen]
        headed = [
            by_bottom(o, ground, LOCALISATION, Assignment(0, None, o, body).yaw_rad(SE2(), HeadingConfig()))
            for o, body in zip(sample.seen, sample.bodies, strict=True)
        ]
        by_net = localise_by_depth(sample.seen, sample.depth, camera, ground, config, network=pointnet)
        places: dict[str, Sequence[DepthPlace | Place | None]] = {
            "Eq. 1": by_box,
            "geometric fit": localise_by_depth(sample.seen, sample.depth, camera, ground, config),
            "Frustum-PointNet": by_net,
            "Eq. 1 + PointNet": [fuse(a, b, config) for a, b in zip(by_box, by_net, strict=True)],
            "multi-task body": sample.bodies,
            "Eq. 1 + multi-task body": [
                None if b is None else fuse(a, b, config) for a, b in zip(headed, sample.bodies, strict=True)
            ],
        }
        for method, answers in places.items():
            for answer, truth in zip(answers, sample.truth, strict=True):
                _count(found, method, answer, truth.T_ego_object)
    return found


def _count(
    found: dict[tuple[str, float, float], Errors], method: str, answer: DepthPlace | Place | None, truth: SE2
) -> None:
    distance_m = math.hypot(truth.x_m, truth.y_m)
    within = [range_m for range_m in RANGES_M if range_m[0] <= distance_m < range_m[1]]
    if answer is None or not within:
        return
    errors = found[(method, *within[0])]
    off_m = answer.centre_m - [truth.x_m, truth.y_m]
    errors.centre_m.append(float(np.hypot(*off_m)))
    errors.centre_rel.append(errors.centre_m[-1] / distance_m)
    errors.squares.append(float(off_m @ np.linalg.solve(answer.cov, off_m)))
    if isinstance(answer, DepthPlace):
        turn = abs(math.remainder(answer.yaw_rad - truth.yaw_rad, 2.0 * math.pi))
        errors.axis_rad.append(min(turn, math.pi - turn))
        if answer.flip < 0.5:
            errors.flipped.append(turn > math.pi / 2.0)


def by_bottom(seen: Observation, ground: GroundPlane, config: LocalisationConfig, yaw_rad: float = 0.0) -> Place:
    """Eq. 1 on the bottom edge of the box of a vehicle with a yaw in ego; the noise of its edge and of the pitch."""
    seen = bottom_at_face(seen, yaw_rad, ground.height_m, config)
    slope = max(seen.slope_bottom, 1e-3)
    sigma = math.hypot(seen.sigma_bottom, PITCH_ERROR_RAD) / slope
    return place(seen, math.log(ground.height_m / slope), sigma**2, yaw_rad, config)


def _observed(
    frame: WorldFrame,
    boxes_px: Floats,
    labels: Sequence[str],
    truth: Sequence[WorldObject],
    edge_sigma: EdgeSigma | None = None,
) -> tuple[list[Observation], list[WorldObject], list[int]]:
    """The observations that `observe_boxes` makes of boxes, with their truth and rows."""
    seen = observe_boxes(
        boxes_px,
        np.full(len(boxes_px), 0.9),
        tuple(labels),
        frame.camera,
        frame.camera.ground,
        LOCALISATION,
        edge_sigma,
        "tyres",  # the world's boxes are outlines
    )
    rows = [o.row for o in seen]
    return seen, [truth[row] for row in rows], rows


def _noisy(frames: int) -> Iterator[Sample]:
    """Exact depth with a network's errors, each body's own."""
    from birdslam.world.training.pointnet import (
        FAR_M,
        DepthErrorConfig,
        FrustumConfig,
        box_of,
        chosen,
        erred,
        frustum_example,
    )
    from birdslam.world.world import sample

    config, errors = FrustumConfig(), DepthErrorConfig()
    for seed in range(FIRST_SEED, FIRST_SEED + frames):
        rng, frame = np.random.default_rng(seed), sample(seed, *MAP_PX)
        for body in chosen(frame, config):
            example = frustum_example(body, frame, config)
            depth_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(FAR_M))
            rows, columns = (slice(at, at + n) for at, n in zip(example.corner, example.own.shape, strict=True))
            depth_m[rows, columns] = erred(example, errors, rng)
            box_px = box_of(example, errors, rng)[None]
            seen, truth, _ = _observed(frame, box_px, [body.label], [body])
            if seen:
                yield Sample(frame, DepthMap(depth_m, *MAP_PX), seen, truth, [None] * len(seen))


def _seen_by(network: Network, frames: int) -> Iterator[Sample]:
    """Depth, boxes and bodies of the multi-task network; a box belongs to the vehicle that it overlaps most."""
    from birdslam.world.training.pointnet import FrustumConfig, chosen
    from birdslam.world.world import sample

    for seed in range(FIRST_SEED, FIRST_SEED + frames):
        frame = sample(seed, *IMAGE_PX)
        found, vehicles = network.run(frame.image), chosen(frame, FrustumConfig())
        if found is None or found.detections is None or found.depth is None or not vehicles:
            continue
        boxes = found.detections.boxes_px
        overlap = iou(boxes, np.array([v.box_px for v in vehicles]))
        rows = [row for row in range(len(boxes)) if overlap[row].max() >= SAME_IOU]
        labels = [found.detections.labels[row] for row in rows]
        matched = [vehicles[overlap[row].argmax()] for row in rows]
        seen, truth, kept = _observed(frame, boxes[rows], labels, matched, found.detections.edge_sigma)
        bodies = found.detections.boxes3d
        said: list[DepthPlace | None] = [None] * len(seen)
        if bodies is not None and seen:
            said = places_of(bodies.take([rows[i] for i in kept]), seen, frame.camera, frame.camera.ground)
        yield Sample(frame, found.depth, seen, truth, said)
