"""Ego-motion on recorded drives with rain drops, dirt and reflections on the windscreen.

    python -m perf overlays [SEQUENCE ...] [--kinds KIND ...] [--seeds N ...] [--output FILE.json] [--data DIR]
        [--networks] [--model ROLE=PATH ...]

SEQUENCE is kitti:DIR, a folder of --data, or one with a rendered `drive.npz`. Each kind (`windscreen.Overlay`) is drawn
from the first and from the middle image on. Counts valid frames with a speed error over 10 % and false standstills.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from birdslam.geometry.arrays import Image
from birdslam.odometry.odometry import Odometry
from birdslam.odometry.plausibility import PlausibilityConfig
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import (
    Drive,
    Task,
    add_drive_options,
    is_valid,
    is_wrong,
    networks_of,
    read,
    uri_of,
)
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.sources.recording import DatasetError
from birdslam.types import NS_PER_S, Status
from birdslam.world import windscreen

label = "drops, dirt and a reflection over recorded drives"

SEQUENCES = (
    "kitti_odometry/sequences/00",
    "kitti_odometry/sequences/06",
    "kitti_tracking/training/image_03/0005",
    "kitti_tracking/training/image_02/0002",
)
KINDS = (*windscreen.KINDS, "night")
BEGINS = {"from the start": 0.0, "from the middle": 0.5}  # at which share of the images
NIGHT_IMAGES = 30
_COUNTS = (
    "frames", "valid", "wrong_valid", "standstill", "obstructed"
)  # fmt: skip
MIN_DRIVING_M = 0.1  # true motion per image of a car that is not stationary


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("overlays", label)
    add_drive_options(parser)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    options = parser.parse_args(arguments)
    configuration = networks_of(options)
    cv2.setNumThreads(1)
    try:
        with Ledger(options.output, label, seeds=options.seeds, networks=configuration is not None) as ledger:
            for sequence in options.sequences or SEQUENCES:
                task = Task(uri_of(sequence, options.data), "", False, 1, 1, 0, None)
                for kind, seed, begin in variants(options.kinds, options.seeds):
                    # The networks also see the overlay
                    edit = edit_of(kind, seed, BEGINS[begin])
                    name, drive = read(replace(task, configuration=configuration), edit)
                    row = measure(drive, BEGINS[begin])
                    ledger.add(f"{name} {kind} {begin}, seed {seed}", row_text(row), **row)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error


def variants(kinds: Sequence[str], seeds: Sequence[int]) -> list[tuple[str, int, str]]:
    """Kind, seed and start of each variant, without duplicates."""
    out = []
    for kind in kinds:
        drawn = kind not in ("nothing", "night")
        begins = ["from the start"] if kind == "nothing" else ["from the middle"] if kind == "night" else list(BEGINS)
        out += [(kind, seed, begin) for seed in (seeds if drawn else seeds[:1]) for begin in begins]
    return out


def edit_of(kind: str, seed: int, share: float) -> windscreen.Edit:
    """The edit of the images after a fraction of the sequence."""
    return _night if kind == "night" else windscreen.from_share(kind, seed, share)


def _night(index: int, count: int, image: Image) -> Image:
    if not count <= 2 * index < count + 2 * NIGHT_IMAGES:
        return image
    out, (height_px, width_px) = np.full_like(image, 40), image.shape[:2]
    far = slice(0, round(0.55 * height_px)), slice(round(0.35 * width_px), round(0.65 * width_px))
    out[far] = image[far]
    return out


def measure(drive: Drive, share: float = 0.5) -> dict[str, Any]:
    """Results of the odometry for the images after a fraction of the sequence."""
    odometry, first = Odometry(drive.camera), int(share * len(drive.images))
    blind_ns, measured_ns = round(PlausibilityConfig().blind_s * NS_PER_S), drive.t_ns[0]
    row = dict.fromkeys(_COUNTS, 0)
    way_m = true_m = 0.0
    for k, image in enumerate(drive.images):
        motion = odometry.estimate(odometry.track(image), k, drive.t_ns[k], *drive.seen[k])
        if motion is None:
            continue
        if Status.ODOMETRY_COASTING not in motion.status:
            measured_ns = drive.t_ns[k]
        if k < first:
            continue
        valid = is_valid(motion) and drive.t_ns[k] - measured_ns <= blind_ns
        step_m = float(np.linalg.norm(drive.poses[k, :3, 3] - drive.poses[motion.from_frame, :3, 3]))
        row["frames"] += 1
        length_m = float(np.linalg.norm(motion.t_prev_curr_m))
        row["valid"] += valid
        row["wrong_valid"] += valid and is_wrong(motion, drive.poses)
        row["standstill"] += motion.standstill and step_m > MIN_DRIVING_M * (k - motion.from_frame)
        row["obstructed"] += Status.VIEW_OBSTRUCTED in motion.status
        if motion.from_frame == k - 1:
            way_m, true_m = way_m + length_m, true_m + step_m
    return {**row, "scale_error": way_m / true_m - 1.0 if true_m else None}


def row_text(row: dict[str, Any]) -> str:
    """A row as text."""
    scale = "unknown" if row["scale_error"] is None else f"{row['scale_error']:+.1%}"
    return (
        f"{row['frames']:4} frames  valid {row['valid']}, of them wrong {row['wrong_valid']}  "
        f"standstill {row['standstill']}  "
        f"view_obstructed {row['obstructed']}  scale {scale}"
    )
