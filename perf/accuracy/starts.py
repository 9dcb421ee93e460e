"""Cold starts of the ego-motion along recorded drives: errors of scale and rotation over the distance travelled.

    python -m perf starts [SEQUENCE ...] [--output FILE.json] [--data DIR] [--networks] [--model ROLE=PATH ...]

From every `--every`-th image of each sequence (kitti:DIR, or a folder of `--data`) the odometry starts again, and runs
over `--images` images: as recorded, mirrored left to right, and over every second image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from birdslam.bench.ego import truth_quality
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import (
    MIN_IMAGES,
    SCALE_LIMIT,
    SEQUENCES,
    SPEED_LIMIT,
    Task,
    add_drive_options,
    cold_start,
    networks_of,
    read,
    uri_of,
)
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.process.workers import workers
from birdslam.sources.recording import DatasetError

label = "cold starts along recorded drives: errors of scale and rotation over the distance travelled"

VARIANTS = (("as recorded", False, 1), ("mirrored", True, 1), ("every second image", False, 2))
_COUNTS = ("n", "over_limit", "wrong_valid", "wrong_valid_truth_doubtful")


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("starts", label)
    add_drive_options(parser)
    parser.add_argument("--every", type=int, default=5, help="images between starts")
    parser.add_argument("--images", type=int, default=25, help="images per start")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    if min(options.every, options.jobs) < 1 or options.images < MIN_IMAGES:
        raise PerfError(f"--every and --jobs must be at least 1, --images at least {MIN_IMAGES}")
    configuration = networks_of(options)
    tasks = [
        Task(uri_of(sequence, options.data), name, mirrored, stride, options.every, options.images, configuration)
        for sequence in options.sequences or SEQUENCES
        for name, mirrored, stride in VARIANTS
    ]
    settings = {"every": options.every, "images": options.images, "networks": configuration is not None}
    try:
        with Ledger(options.output, label, **settings) as ledger, workers(min(options.jobs, len(tasks))) as pool:
            for task, (sequence, starts) in zip(tasks, pool.map(measure, tasks), strict=True):
                figures = summary(starts)
                ledger.add(f"{sequence} {task.name}", row_text(figures), **figures, starts=starts)
            rows = ledger.content["rows"]
            total = {key: sum(row[key] for row in rows) for key in _COUNTS}
            ledger.set(total=total)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error
    print(
        f"{total['n']} starts, {total['over_limit']} with a scale error over {SCALE_LIMIT:.0%}, "
        f"{total['wrong_valid']} valid frames with a speed error over {SPEED_LIMIT:.0%}, "
        f"{total['wrong_valid_truth_doubtful']} of them with doubtful truth"
    )


def measure(task: Task) -> tuple[str, list[dict[str, Any]]]:
    """The sequence's name, and the result of each start of one variant of it."""
    cv2.setNumThreads(1)
    name, drive = read(task)
    count = len(drive.images)
    starts = []
    interpolated = truth_quality.interpolated(drive.poses)
    doubtful = truth_quality.doubtful(drive.poses, np.array(drive.t_ns, np.int64))
    for first in range(0, count - MIN_IMAGES + 1, task.every):
        start = cold_start(drive, range(first, min(first + task.images, count)))
        if start is not None:
            # A subset of the wrong ones: their truth is interpolated or implausible for a car
            doubted = [frame for frame in start["wrong_valid"] if doubtful[frame]]
            begins = bool(interpolated[first + 1])
            starts.append(start | {"truth_interpolated": begins, "wrong_valid_truth_doubtful": doubted})
    return name, starts


def summary(starts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The result of each start of one variant, at its end."""
    scale = np.array([start["scale_error"][-1] for start in starts])
    rotation_deg = np.array([start["rotation_error_deg"][-1] for start in starts])
    if not len(scale):
        counts = ("n", "over_limit", "over_limit_interpolated", "wrong_valid", "wrong_valid_truth_doubtful")
        return dict.fromkeys(counts, 0)
    interpolated = np.array([start["truth_interpolated"] for start in starts])
    images = sum(start["images"] - 1 for start in starts)
    return {
        "n": len(starts),
        "scale_median": float(np.median(scale)),
        "scale_worst": float(scale[np.abs(scale).argmax()]),
        "over_limit": int((np.abs(scale) > SCALE_LIMIT).sum()),
        "over_limit_interpolated": int((np.abs(scale[interpolated]) > SCALE_LIMIT).sum()),
        "rotation_median_deg": float(np.median(rotation_deg)),
        "rotation_worst_deg": float(rotation_deg.max()),
        "valid_share": sum(start["valid"] for start in starts) / images,
        "wrong_valid": sum(len(start["wrong_valid"]) for start in starts),
        "wrong_valid_truth_doubtful": sum(len(start["wrong_valid_truth_doubtful"]) for start in starts),
        "standstill": sum(start["standstill"] for start in starts),
    }


def row_text(figures: dict[str, Any]) -> str:
    """A row as text."""
    if not figures["n"]:
        return "no start: the sequence is too short, or the car is stationary"
    return (
        f"{figures['n']:3} starts  scale median {figures['scale_median']:+.1%} worst {figures['scale_worst']:+.1%} "
        f"(over {SCALE_LIMIT:.0%}: {figures['over_limit']})  rotation median {figures['rotation_median_deg']:.2f} "
        f"worst {figures['rotation_worst_deg']:.2f} deg  valid {figures['valid_share']:.0%}, "
        f"of them wrong {figures['wrong_valid']} ({figures['wrong_valid_truth_doubtful']} where the truth is "
        "interpolated or accelerates as no car does)"
        + f"; {figures['over_limit_interpolated']} of those over begin where the truth is interpolated"
    )
