"""Ego-motion on difficult roads, rendered or recorded, also behind drops, dirt, reflections, a bonnet, compression.

    python -m perf roads [NAME ...] [--every N] [--frames N] [--keep DIR] [--drives DIR] [--networks] [--output FILE]

A NAME is a road of `world/roads.py` (rendered, or from `--drives`), `demo`, kitti:DIR or a folder of `--data`. `+rain`
(of EFFECTS) may follow: rain from the middle on; `+rain@0` from another share; `+mirrored`; `+half` of the images.
The odometry runs from each image of `--begin-at` to the end, and cold from every `--every`-th (0: none).
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from birdslam.bench.ego import truth_quality
from birdslam.geometry.arrays import Image
from birdslam.geometry.pose import Pose
from birdslam.odometry.motion import Motion, planar
from birdslam.odometry.plausibility import PlausibilityConfig
from birdslam.perception import ModelError
from birdslam.perf.accuracy.drives import (
    MIN_IMAGES,
    SCALE_LIMIT,
    Drive,
    cold_start,
    errors,
    follow,
    is_valid,
    is_wrong,
    networks_of,
    read,
)
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import add_data, add_networks, benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.progress import with_progress
from birdslam.runtime.world.demo_drive import SAMPLES, write
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import inverse
from birdslam.types import NS_PER_S, Status
from birdslam.world.compression import VideoEncoder
from birdslam.world.windscreen import Edit, bonnet, from_share

label = "difficult roads, rendered or recorded: motorways, ramps, nights, cold starts, drops, dirt, reflections"

DEMO, DEMO_STRIDE, DEMO_FRAMES = "demo", 3, 132
ON_ROADS = ("drops", "dirt", "reflection", "bonnet", "compression")  # effects on rendered roads by default
EFFECTS = (*ON_ROADS, "rain", "drops_defocused", "night")
NIGHT_IMAGES, NIGHT_GREY = 30, 40
MIN_DRIVING_M = 0.1  # true motion per image of a car that is not stationary


def edit_of(effect: str, seed: int = 1, share: float = 0.5) -> Edit:
    """One of EFFECTS over the images from a share of the drive on; a bonnet and compression over all of them."""
    if effect == "bonnet":
        return lambda index, count, image: bonnet(image)
    if effect == "compression":
        encoder = VideoEncoder()
        return lambda index, count, image: encoder.code(image)
    return partial(_night, share) if effect == "night" else from_share(effect, seed, share)


def _night(share: float, index: int, count: int, image: Image) -> Image:
    """A while in which only the far middle of the image is lit."""
    if not 0 <= index - share * count < NIGHT_IMAGES:
        return image
    out, (height_px, width_px) = np.full_like(image, NIGHT_GREY), image.shape[:2]
    far = slice(0, round(0.55 * height_px)), slice(round(0.35 * width_px), round(0.65 * width_px))
    out[far] = image[far]
    return out


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("roads", label)
    parser.add_argument("names", nargs="*", metavar="NAME", help="drive, or DRIVE+EFFECT[@SHARE]")
    add_data(parser)
    add_networks(parser)
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn on the windscreen")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write each rendered drive to DIR/NAME")
    parser.add_argument("--drives", type=Path, metavar="DIR", help="use the drives in DIR; do not render")
    parser.add_argument("--frames", type=int, help="frames per drive; default: all")
    parser.add_argument("--width", type=int, default=640, help="image width in pixels; KITTI has 1242")
    parser.add_argument("--quality", type=int, default=92, help="of the WebP images, 1 to 100")
    parser.add_argument("--begin-at", type=int, nargs="+", default=[0], metavar="IMAGE", help="starts of full runs")
    parser.add_argument("--every", type=int, default=20, help="images between cold starts; 0: none")
    parser.add_argument("--images", type=int, default=25, help="images per cold start")
    options = parser.parse_args(arguments)
    if options.every < 0 or options.images < MIN_IMAGES or not 1 <= options.quality <= 100:
        raise PerfError(f"--every must be at least 0, --images {MIN_IMAGES}, --quality 1 to 100")
    if min(options.begin_at) < 0:
        raise PerfError(f"--begin-at {min(options.begin_at)}: must not be negative")
    if options.frames is not None and options.frames < MIN_IMAGES:
        raise PerfError(f"--frames must be at least {MIN_IMAGES}")
    if not 160 <= options.width <= 4096:
        raise PerfError(f"--width {options.width}: expected 160 to 4096")
    cv2.setNumThreads(1)
    try:
        with tempfile.TemporaryDirectory() as spare, Ledger(options.output, label) as ledger:
            drives = _Drives(options, Path(spare))
            for name in options.names or drives.names:
                road, effect, share = parse(name)
                recording = drives.open(road, 2 if effect == "half" else 1)
                edit = edit_of(effect, options.seed, share) if effect in EFFECTS else None
                count = options.frames or (DEMO_FRAMES if road == DEMO else 10**6)
                drive = read(recording, edit, count, networks_of(options), effect == "mirrored")
                row = measure(drive, options.begin_at, options.every, options.images, share if edit else None)
                ledger.add(name, row_text(row), hz=recording.rate_hz, **row)
    except (DatasetError, ModelError) as error:
        raise PerfError(str(error)) from error


def _is_recorded(road: str) -> bool:
    return road == DEMO or ":" in road or "/" in road


def parse(name: str) -> tuple[str, str, float]:
    """Drive, effect ("": none) and share of the images before it, of DRIVE+EFFECT@SHARE. Raises PerfError."""
    road, _, effect = name.partition("+")
    effect, _, share = effect.partition("@")
    if effect not in ("", "mirrored", "half", *EFFECTS):
        raise PerfError(f"{name}: unknown effect; expected one of mirrored, half, {', '.join(EFFECTS)}")
    try:
        return road, effect, float(share or 0.5)
    except ValueError:
        raise PerfError(f"{name}: {share} is not a share of the images") from None


class _Drives:
    """The drives by name; each is rendered once unless it is on disk."""

    def __init__(self, options: argparse.Namespace, spare: Path) -> None:
        self._options, self._folder = options, options.drives or options.keep or spare
        self._rendered: set[str] = set()
        wanted = [parse(name)[0] for name in options.names]
        if options.drives is not None:
            known = sorted(path.parent.name for path in options.drives.glob("*/drive.npz"))
        elif wanted and all(_is_recorded(road) for road in wanted):
            known = []
        elif importlib.util.find_spec("numba") is not None:
            from birdslam.world.roads import ROADS

            known = list(ROADS)
        else:
            raise PerfError("rendering needs numba; install the extra [train], or name drives with --drives")
        over = [name for name in (DEMO, "motorway_30") if name in (DEMO, *known)]
        self.names = [*known, DEMO, *(f"{road}+{effect}" for road in over for effect in ON_ROADS)]

    def open(self, road: str, stride: int = 1) -> Recording:
        """A drive; every `stride`-th image of a recorded one. Raises PerfError for an unknown name."""
        if _is_recorded(road) and road != DEMO:
            return open_recording(road if ":" in road else f"kitti:{self._options.data / road}", stride=stride)
        if road not in self.names or stride != 1:
            raise PerfError(f"{road}: unknown road; expected one of {', '.join(self.names)}, or a recorded drive")
        if road == DEMO:
            return DemoRecording(stride=DEMO_STRIDE)
        if self._options.drives is None and road not in self._rendered:
            self._render(road)
        return DemoRecording(directory=self._folder / road)

    def _render(self, name: str) -> None:
        from birdslam.world.roads import ROADS, camera_of
        from birdslam.world.scenario import drive

        road = ROADS[name]
        count = min(road.frames, self._options.frames or road.frames)
        camera = camera_of(self._options.width)
        frames = drive(road.scenario(), camera, count, road.rate_hz, SAMPLES)
        write(self._folder / name, with_progress(frames, name, count), camera, road.rate_hz, self._options.quality)
        self._rendered.add(name)


def measure(
    drive: Drive, begin_at: Sequence[int] = (0,), every: int = 0, images: int = 25, share: float | None = None
) -> dict[str, Any]:  # fmt: skip
    """Runs the odometry from some images to the end; with `every`, also cold starts over `images` images.

    "scale_errors" has a value per run; all other results are totals. "behind" counts what the first run says after a
    `share` of the images.
    """
    count = len(drive.images)
    ways, motions, first_motions = [], list[Motion](), list[Motion]()
    for first in begin_at:
        if first > count - MIN_IMAGES:
            raise DatasetError(f"start at image {first} of {count}: at least {MIN_IMAGES} images are needed")
        estimated, seen = follow(drive, range(first, count))
        way = errors(drive, range(first, count), estimated, seen)
        if way is None:
            raise DatasetError("the car of this drive does not move")
        ways.append(way)
        motions += seen
        first_motions = first_motions or seen
    starts = cold_starts(drive, every, images) if every else []
    driven_s = (drive.t_ns[-1] - drive.t_ns[begin_at[0]]) * 1e-9
    return {
        "speed_mps": round(ways[0]["true_way_m"][-1] / driven_s, 1),
        "way_m": ways[0]["true_way_m"][-1],
        "scale_errors": [way["scale_error"][-1] for way in ways],
        "rotation_error_deg": max(way["rotation_error_deg"][-1] for way in ways),
        "motions": len(motions),
        "valid": sum(way["valid"] for way in ways),
        "wrong_valid": [frame for way in ways for frame in way["wrong_valid"]],
        "standstill": sum(way["standstill"] for way in ways),
        "nees": _nees(drive, motions),
        "cold_starts": [start["scale_error"][-1] for start in starts],
        "of_cold_starts": summary(starts),
        "behind": None if share is None else behind(drive, first_motions, int(share * count)),
        "starts": ways,
    }


def cold_starts(drive: Drive, every: int, images: int) -> list[dict[str, Any]]:
    """The result of each cold start over `images` images, but of those in which the car does not move."""
    count, out = len(drive.images), []
    interpolated = truth_quality.interpolated(drive.poses)
    doubtful = truth_quality.doubtful(drive.poses, np.array(drive.t_ns, np.int64))
    for first in range(0, count - MIN_IMAGES + 1, every):
        start = cold_start(drive, range(first, min(first + images, count)))
        if start is not None:
            # A subset of the wrong ones: their truth is interpolated or implausible for a car
            doubted = [frame for frame in start["wrong_valid"] if doubtful[frame]]
            begins = bool(interpolated[first + 1])
            out.append(start | {"truth_interpolated": begins, "wrong_valid_truth_doubtful": doubted})
    return out


def summary(starts: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """All cold starts at their ends; None if there are none."""
    if not starts:
        return None
    scale = np.array([start["scale_error"][-1] for start in starts])
    rotation_deg = np.array([start["rotation_error_deg"][-1] for start in starts])
    interpolated = np.array([start["truth_interpolated"] for start in starts])
    return {
        "n": len(starts),
        "scale_median": float(np.median(scale)),
        "scale_worst": float(scale[np.abs(scale).argmax()]),
        "over_limit": int((np.abs(scale) > SCALE_LIMIT).sum()),
        "over_limit_interpolated": int((np.abs(scale[interpolated]) > SCALE_LIMIT).sum()),
        "rotation_median_deg": float(np.median(rotation_deg)),
        "rotation_worst_deg": float(rotation_deg.max()),
        "valid_share": sum(start["valid"] for start in starts) / sum(start["images"] - 1 for start in starts),
        "wrong_valid": sum(len(start["wrong_valid"]) for start in starts),
        "wrong_valid_truth_doubtful": sum(len(start["wrong_valid_truth_doubtful"]) for start in starts),
        "standstill": sum(start["standstill"] for start in starts),
    }


def behind(drive: Drive, motions: Sequence[Motion], first: int) -> dict[str, Any]:
    """Counts of the motions to images from `first` on; one that coasts for too long is not valid."""
    blind_ns, measured_ns = round(PlausibilityConfig().blind_s * NS_PER_S), drive.t_ns[0]
    row = dict.fromkeys(("frames", "valid", "wrong_valid", "standstill", "obstructed"), 0)
    way_m = true_m = 0.0
    for motion in motions:
        k = motion.to_frame
        if Status.ODOMETRY_COASTING not in motion.status:
            measured_ns = drive.t_ns[k]
        if k < first:
            continue
        valid = is_valid(motion) and drive.t_ns[k] - measured_ns <= blind_ns
        step_m = float(np.linalg.norm(drive.poses[k, :3, 3] - drive.poses[motion.from_frame, :3, 3]))
        row["frames"] += 1
        row["valid"] += valid
        row["wrong_valid"] += valid and is_wrong(motion, drive.poses)
        row["standstill"] += motion.standstill and step_m > MIN_DRIVING_M * (k - motion.from_frame)
        row["obstructed"] += Status.VIEW_OBSTRUCTED in motion.status
        if motion.from_frame == k - 1:
            way_m, true_m = way_m + float(np.linalg.norm(motion.t_prev_curr_m)), true_m + step_m
    return {**row, "scale_error": way_m / true_m - 1.0 if true_m else None}


def _nees(drive: Drive, motions: Sequence[Motion]) -> float | None:
    """Mean of e' P^-1 e over its 3 degrees of freedom, of the valid motions from image to image; 1 is consistent."""
    values = []
    for motion in motions:
        if is_valid(motion):
            true = inverse(drive.poses[motion.from_frame]) @ drive.poses[motion.to_frame]
            error = planar(Pose(true[:3, :3], true[:3, 3]), motion.ground).between(motion.T_prev_curr).log()
            values.append(float(error @ np.linalg.solve(motion.cov, error)) / len(error))
    return round(float(np.mean(values)), 2) if values else None


def row_text(row: dict[str, Any]) -> str:
    """A row as text.

    Ways and rotation: errors of distance and rotation at the end, for each start, and the worst. Wrong: valid frames
    with a speed error over 10 %. Standstill: frames with this status while the car moved. NEES: of the motion between
    images; 1 is consistent. Then the cold starts, and the frames behind an effect.
    """
    nees = "-" if row["nees"] is None else f"{row['nees']:.1f}"
    text = (
        f"ways {' '.join(f'{error:+.1%}' for error in row['scale_errors'])}  "
        f"rotation {row['rotation_error_deg']:.2f} deg  valid {row['valid'] / max(row['motions'], 1):.0%}  "
        f"of them wrong {len(row['wrong_valid'])}  standstill {row['standstill']}  NEES {nees}"
    )
    if starts := row["of_cold_starts"]:
        text += (
            f"\n  {starts['n']} cold starts  scale median {starts['scale_median']:+.1%} "
            f"worst {starts['scale_worst']:+.1%} (over {SCALE_LIMIT:.0%}: {starts['over_limit']}, "
            f"{starts['over_limit_interpolated']} where the truth is interpolated)  rotation median "
            f"{starts['rotation_median_deg']:.2f} worst {starts['rotation_worst_deg']:.2f} deg  valid "
            f"{starts['valid_share']:.0%}, of them wrong {starts['wrong_valid']} "
            f"({starts['wrong_valid_truth_doubtful']} where the truth is doubtful)"
        )
    if seen := row["behind"]:
        scale = "unknown" if seen["scale_error"] is None else f"{seen['scale_error']:+.1%}"
        text += (
            f"\n  behind the effect {seen['frames']} frames  valid {seen['valid']}, of them wrong "
            f"{seen['wrong_valid']}  standstill {seen['standstill']}  view_obstructed {seen['obstructed']}  "
            f"scale {scale}"
        )
    return text
