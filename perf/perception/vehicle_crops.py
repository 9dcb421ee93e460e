"""Size and heading of vehicles by their own images, against the labels of KITTI tracking (0002, 0005).

    python -m perf vehicle_crops [--network F.onnx] [--every 3] [--data DIR] [--output F.json]

The boxes are the labels' own, so that no detector's error is in it; cars alone, neither cut nor mostly hidden. Errors
of size are a car's means, since they last for a car: what is left of the spread of its class is what the network knows.
The network, vehicle_crops.onnx beside this file, is of `birdslam.runtime.world.train_crops`; nothing drives by it yet.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.perception.crops import INPUT, MEAN_SIZE_M, WINDOW, cut_out, read_heading, read_size_m
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.kitti import find_images, read_image
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking
from birdslam.sources.label_projection import Label
from birdslam.sources.recording import DatasetError

label = "size and heading of cars by their own images, against labels"

SEQUENCES = ("0002", "0005")
NETWORK = Path(__file__).with_suffix(".onnx")
RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0), (0.0, 90.0))
LEAST_PX, MOST_TRUNCATED, MOST_OCCLUDED = 14.0, 0.2, 1
OFF_DEG = 10.0  # a heading that is off by more


def run(arguments: list[str]) -> None:
    """Prints a row for each range of depths, and the milliseconds of one crop on one thread."""
    parser = benchmark_parser("vehicle_crops", label)
    parser.add_argument("--network", type=Path, default=NETWORK, metavar="F.onnx")
    parser.add_argument("--every", type=int, default=3, help="one frame in so many")
    add_data(parser)
    options = parser.parse_args(arguments)
    from birdslam.perception.session import plain_session

    session = plain_session(options.network.read_bytes(), 1)
    rows: list[Floats] = []
    cars: list[str] = []
    for name in SEQUENCES:
        sequence = open_tracking(options.data / "kitti_tracking" / "training", name)
        if sequence.images is None:
            raise DatasetError(f"{name}: has no images")
        for frame, path in list(find_images(sequence.images).items())[:: options.every]:
            labels = [each for each in sequence.labels_of(frame) if _clear(each)]
            if not labels:
                continue
            image = np.atleast_3d(read_image(path))
            image = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
            windows = np.stack([cut_out(image, np.array(each.box_px)) for each in labels])
            (out,) = session.run(None, {INPUT: windows.transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1.0})
            rows += [_errors(sequence, *pair) for pair in zip(labels, np.asarray(out, np.float64), strict=True)]
            cars += [f"{name}:{each.track}" for each in labels]
    with Ledger(options.output, label, every=options.every, network=options.network.name) as ledger:
        table, of = np.array(rows), np.array(cars)
        for low_m, high_m in RANGES_M:
            near = (table[:, 0] >= low_m) & (table[:, 0] < high_m)
            row = summary(table[near], of[near])
            ledger.add(f"{low_m:.0f}-{high_m:.0f} m", "  ".join(f"{k} {v}" for k, v in row.items()), **row)
        took_ms = _milliseconds(session)
        ledger.add("time", f"{took_ms:.2f} ms a crop, p50, one thread", crop_p50_ms=round(took_ms, 2))


def _clear(each: Label) -> bool:
    x1, y1, x2, y2 = each.box_px
    whole = each.truncated <= MOST_TRUNCATED and each.occluded <= MOST_OCCLUDED
    return each.kind == "Car" and whole and y2 - y1 >= LEAST_PX and x2 > x1


def _errors(sequence: TrackingSequence, each: Label, out: Floats) -> Floats:
    """Depth (m); heading off by (rad, in (-pi, pi]); logs of size said over true, and true over the class's mean."""
    place_m = np.linalg.inv(sequence.T_cam0_camera) @ np.append(each.place_m, 1.0)
    # KITTI's yaw is about down and 0 to the right, ours about up and 0 ahead
    yaw_rad = math.atan2(-math.cos(each.rotation_y_rad), -math.sin(each.rotation_y_rad))
    alpha_rad = yaw_rad - math.atan2(-place_m[0], place_m[2])
    true_m = np.array([each.length_m, each.width_m, each.height_m])
    off_rad = math.remainder(read_heading(out)[0] - alpha_rad, 2.0 * math.pi)
    return np.hstack([place_m[2], off_rad, np.log(read_size_m(out) / true_m), np.log(true_m / MEAN_SIZE_M)])


def summary(table: Floats, cars: np.ndarray) -> dict[str, float | int]:
    """Of rows of `_errors`: headings by sight, sizes by car."""
    off_deg = np.degrees(np.abs(table[:, 1]))
    axis_deg = np.minimum(off_deg, 180.0 - off_deg)
    means = np.array([table[cars == car].mean(axis=0) for car in np.unique(cars)])
    bias, left, spread = means[:, 2:5].mean(axis=0), means[:, 2:5].std(axis=0), means[:, 5:8].std(axis=0)
    return {
        "sights": len(table),
        "cars": len(means),
        "axis_deg_p50": round(float(np.median(axis_deg)), 1),
        "axis_off": round(float(np.mean(axis_deg > OFF_DEG)), 2),
        "swapped": round(float(np.mean(off_deg > 90.0)), 2),
        "height_bias": round(float(bias[2]), 3),
        "height_sd": round(float(left[2]), 3),
        "height_spread": round(float(spread[2]), 3),
        "length_bias": round(float(bias[0]), 3),
        "length_sd": round(float(left[0]), 3),
        "length_spread": round(float(spread[0]), 3),
    }


def _milliseconds(session: object) -> float:
    one = {INPUT: np.zeros((1, 3, WINDOW[1], WINDOW[0]), np.float32)}
    took_ms = []
    for _ in range(200):
        before_s = time.perf_counter()
        session.run(None, one)  # type: ignore[attr-defined]
        took_ms.append(1e3 * (time.perf_counter() - before_s))
    return float(np.median(took_ms))
