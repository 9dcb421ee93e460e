"""Accuracy of the shipped network on held-out rendered worlds and on real frames.

    python -m perf networks [--network F.onnx] [--frames 300] [--data DIR] [--models DIR] [--output F.json]

Held-out worlds need the extra [train] and are skipped without it. Real frames come from BIRDSLAM_DATA: depth is
compared with the LiDAR of the raw clip, masks and boxes with two third-party networks (not ground truth), sizes and
headings of bodies with the labels of KITTI tracking.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.perception import Detections, Findings, ModelSpec, Network, load_network
from birdslam.perception.decoding.multitask import MultiTaskDecoder
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.opening import open_recording
from birdslam.world.training.grading import Grades, box_ious, overlap

label = "the shipped network on held-out worlds, and on real frames with LiDAR and two other networks"

SIZES = ((640, 192), (640, 360), (1242, 375))  # of the held-out worlds' images
RECORDINGS = {"00": "kitti_odometry/sequences/00", "06": "kitti_odometry/sequences/06", "clip": "kitti_raw_clip"}
VEHICLES = ("car", "truck", "bus")
OTHERS = {"detector": "yolox_nano_416.onnx", "segmenter": "twinlitenet_640x360.onnx"}
AP_MIN_SCORE = 0.05  # of boxes in the average precision
MIN_SCORE = 0.4  # of the other detector's boxes
MIN_HEIGHT_PX = 30.0
SAME_IOU = 0.5
BORDER_PX = 4.0  # a box this close to the image border may be truncated
MIN_DISTANCE_M = 2.0  # nearer LiDAR returns are from the ego


def run(arguments: list[str]) -> None:
    shared = Path("../shared")
    parser = benchmark_parser("networks", label)
    parser.add_argument(
        "--network", type=Path, default=SHIPPED_NETWORKS / SHIPPED_MULTITASK, help="a multi-task network"
    )
    parser.add_argument("--frames", type=int, default=300, help="held-out worlds of each image size")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("BIRDSLAM_DATA", shared / "data")))
    parser.add_argument("--models", type=Path, default=Path(os.environ.get("BIRDSLAM_MODELS", shared / "models")))
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    network = load_network("multitask", ModelSpec(path=str(options.network), threads=options.threads))
    with Ledger(options.output, label, network=network.describe()) as ledger:
        if importlib.util.find_spec("numba") is None:
            print("held-out worlds: skipped, numba is not installed (extra [train])")
        else:
            for width_px, height_px in SIZES:
                figures = simulated(network, options.frames, width_px, height_px)
                ledger.add(f"worlds {width_px}x{height_px}", _summary(figures), **figures)
        if options.data.is_dir():
            for name, folder in RECORDINGS.items():
                figures = real(network, options.data / folder, options.models)
                ledger.add(f"real {name}", _summary(figures), **figures)
        else:
            print(f"real frames: skipped, {options.data} does not exist (set BIRDSLAM_DATA)")


def simulated(network: Network, frames: int, width_px: int, height_px: int) -> dict[str, float]:
    """Results over held-out worlds: seeds from 0, which training does not use."""
    from birdslam.world.world import sample

    grades = Grades()
    decoder = network.decoder
    assert isinstance(decoder, MultiTaskDecoder)
    shipped, decoder.table = decoder.table, msgspec.structs.replace(decoder.table, score_threshold=AP_MIN_SCORE)
    for seed in range(frames):
        frame = sample(seed, width_px, height_px)
        grades.add(_findings(network, frame.image), frame)
    decoder.table = shipped
    return grades.figures()


def real(network: Network, folder: Path, models: Path) -> dict[str, float]:
    """Results on a real recording, without those that lack a reference."""
    recording = open_recording(f"kitti:{folder}")
    others = {role: _other(role, models / file) for role, file in OTHERS.items() if (models / file).is_file()}
    T_cam_cam0 = np.linalg.inv(recording.T_cam0_cam())
    road, lane, shares = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64), []
    agreed = np.zeros(4, dtype=np.int64)  # theirs found, theirs, ours confirmed, ours
    depths: list[Floats] = []  # (N, 3): estimated, LiDAR's, on the road
    for number, image in _images(recording.frames()):
        found = _findings(network, image)
        lidar = folder / "lidar_cam0" / f"{number:06d}.npy"
        if lidar.is_file():
            points_m = np.load(lidar).astype(np.float64) @ T_cam_cam0[:3, :3].T + T_cam_cam0[:3, 3]
            depths.append(_beside_lidar(found, points_m, recording.camera))
        if "segmenter" in others:
            theirs = others["segmenter"].run(image)
            if found.segmentation is not None and theirs is not None and theirs.segmentation is not None:
                road += overlap(found.segmentation.road, theirs.segmentation.road)
                lane += overlap(found.segmentation.lane, theirs.segmentation.lane)
                shares.append([mask.road.mean() for mask in (found.segmentation, theirs.segmentation)])
        if "detector" in others:
            theirs = others["detector"].run(image)
            # Includes images in which one of the networks detects nothing
            if found.detections is not None and theirs is not None and theirs.detections is not None:
                agreed += _agreement(found.detections, theirs.detections)
    figures: dict[str, float] = {"frames": len(recording)}
    if depths:
        figures |= _depth_figures(np.vstack(depths))
    if "segmenter" in others:
        figures |= {"road_iou": float(road[0] / road[1]), "lane_iou": float(lane[0] / lane[1])}
        ours, theirs = np.mean(shares, axis=0)  # of the image; a nearly empty mask is not compared
        figures |= {"road_share": float(ours), "road_share_theirs": float(theirs)}
    if "detector" in others:
        figures |= {
            "vehicle_recall": float(agreed[0] / max(agreed[1], 1)),
            "vehicle_precision": float(agreed[2] / max(agreed[3], 1)),
            "vehicles": int(agreed[1]),
        }
    return figures


def _findings(network: Network, image: NDArray[np.uint8]) -> Findings:
    found = network.run(image)
    if found is None:
        raise PerfError(f"{network.path}: has an output that is not finite")
    return found


def _other(role: str, path: Path) -> Network:
    return load_network(role, ModelSpec(path=str(path)))


def _images(frames: Iterator[Any]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    for number, frame in enumerate(frames):
        if frame.image is not None:
            yield number, cast(NDArray[np.uint8], frame.image)


def _beside_lidar(found: Findings, points_m: Floats, camera: Camera) -> Floats:
    """Estimated depth, LiDAR depth, 1 on the predicted road (N, 3) of the returns in the image."""
    assert found.depth is not None
    assert found.segmentation is not None
    points_m = points_m[points_m[:, 2] > MIN_DISTANCE_M]
    pixels = (points_m @ camera.K.T)[:, :2] / points_m[:, 2:]
    said_m = found.depth.in_metres(camera).at(pixels).astype(np.float64)
    inside = np.isfinite(said_m)
    x, y = np.floor(pixels[inside] + 0.5).astype(np.int64).T
    height_px, width_px = found.segmentation.road.shape
    on_road = found.segmentation.road[np.minimum(y, height_px - 1), np.minimum(x, width_px - 1)]
    return np.column_stack([said_m[inside], points_m[inside, 2], on_road])


def _depth_figures(depths: Floats) -> dict[str, float]:
    said_m, lidar_m, on_road = depths.T
    road = on_road > 0.0
    scale = float(np.median(lidar_m / said_m))
    return {
        "depth_absrel_scaled": float(np.mean(np.abs(scale * said_m - lidar_m) / lidar_m)),
        "depth_scale": scale,
        "depth_absrel": float(np.mean(np.abs(said_m - lidar_m) / lidar_m)),
        "road_absrel": float(np.mean(np.abs(said_m[road] - lidar_m[road]) / lidar_m[road])),
        "road_bias": float(np.median(said_m[road] / lidar_m[road]) - 1.0),
    }


def _agreement(ours: Detections, theirs: Detections) -> Ints:
    """Counts (4,) of vehicles above the thresholds: theirs found by ours, theirs, ours confirmed by theirs, ours."""
    ours, theirs = ours.only(VEHICLES), theirs.only(VEHICLES)
    shared = box_ious(theirs.boxes_px[theirs.scores > MIN_SCORE], ours.boxes_px)
    tall_theirs, tall_ours = (
        boxes[:, 3] - boxes[:, 1] > MIN_HEIGHT_PX
        for boxes in (theirs.boxes_px[theirs.scores > MIN_SCORE], ours.boxes_px)
    )
    found = shared.max(axis=1, initial=0.0) >= SAME_IOU
    confirmed = shared.max(axis=0, initial=0.0) >= SAME_IOU
    return np.array(
        [
            np.count_nonzero(found & tall_theirs),
            np.count_nonzero(tall_theirs),
            np.count_nonzero(confirmed & tall_ours),
            np.count_nonzero(tall_ours),
        ]
    )


def _summary(figures: dict[str, float]) -> str:
    return "  ".join(
        f"{name} {value:.3f}" if isinstance(value, float) else f"{name} {value}"
        for name, value in figures.items()
        if not math.isnan(value)
    )
