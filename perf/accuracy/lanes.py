"""Bird's-eye road and lane IoU with the lane completion (ENet) and without it, on held-out worlds.

Both grids are compared at a tolerance of a cell (0.25 m): the boundary's cells are widened by one on each side before
the intersection is counted, since two lines one cell wide that lie side by side would share nothing. The worlds need
the extra [train].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats32, Ints
from birdslam.mapping.lanes import BOUNDARY, ROAD, LanesConfig
from birdslam.perception.completion import SHIPPED, GridCompletion
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "amodal lanes in bird's-eye view, with and without their completion"


def overlap(grids: Floats32, truth: Floats32, config: LanesConfig) -> Ints:
    """(2, 2): intersection and union, in cells, of road and boundary."""
    out = np.zeros((2, 2), dtype=np.int64)
    for channel in (ROAD, BOUNDARY):
        a, b = grids[channel] >= config.least_occupancy, truth[channel] > 0.5
        if channel == BOUNDARY:
            a, b = (cv2.dilate(g.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for g in (a, b))
        out[channel] = np.sum(a & b), np.sum(a | b)
    return out


def measure(drives: int, path: Path = SHIPPED) -> dict[str, Any]:
    """IoU of `raw` and `completed` grids over `drives` worlds that no training saw."""
    try:
        from birdslam.runtime.world.train_lanes import HELD_OUT
        from birdslam.runtime.world.train_lanes import drives as render
    except ImportError as error:
        raise PerfError(f"the built-in world needs the extra [train] ({error})") from error
    config = LanesConfig()
    complete = GridCompletion(config.shape, path)
    cells = {"raw": np.zeros((2, 2), dtype=np.int64), "completed": np.zeros((2, 2), dtype=np.int64)}
    frames = 0
    for part in render(HELD_OUT + 1000, drives, 2):
        for gathered, truth in part.astype(np.float32) / np.float32(255.0):
            frames += 1
            cells["raw"] += overlap(gathered, truth, config)
            cells["completed"] += overlap(complete(gathered), truth, config)
    return {"frames": frames} | {
        f"{name}_{what}_iou": float(counts[channel, 0] / max(counts[channel, 1], 1))
        for name, counts in cells.items()
        for channel, what in ((ROAD, "road"), (BOUNDARY, "lane"))
    }


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("lanes", label)
    parser.add_argument("--drives", type=int, default=24, help="worlds to drive through")
    parser.add_argument("--model", type=Path, default=SHIPPED)
    options = parser.parse_args(arguments)
    with Ledger(options.output, label, drives=options.drives) as ledger:
        report = measure(options.drives, options.model)
        ledger.add("lanes", "  ".join(f"{key} {value:.3f}" for key, value in report.items()), **report)
