"""Ego-motion on difficult roads of the built-in world: empty motorways, ramps, nights; drops, dirt, a bonnet.

    python -m perf roads [NAME ...] [--output FILE.json] [--keep DIR] [--drives DIR] [--frames N] [--width PX]

A NAME is a road of `world/roads.py` or `demo`, optionally with one of EFFECTS after a plus (`motorway_30+drops`);
default: all, and the effects on two of them. Rendered from its seed (extra `train`), or read from `--drives`. The
odometry runs with the true boxes, from each image of `--begin-at` to the end, and cold from every `--every`-th.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from birdslam.geometry.pose import Pose
from birdslam.odometry.motion import Motion, planar
from birdslam.perf.accuracy.drives import (
    MIN_IMAGES,
    Drive,
    cold_start,
    errors,
    follow,
    is_valid,
)
from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.progress import with_progress
from birdslam.runtime.world.demo_drive import SAMPLES, write
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.trajectory import inverse
from birdslam.world.compression import VideoEncoder
from birdslam.world.windscreen import Edit, bonnet, from_middle

label = "difficult roads of the built-in world: motorways, ramps, nights, drops, dirt, reflections, compression"

DEMO, DEMO_STRIDE, DEMO_FRAMES = "demo", 3, 132
EFFECTS: dict[str, Callable[[], Edit]] = {
    "drops": lambda: from_middle("drops", 1),
    "dirt": lambda: from_middle("dirt", 1),
    "reflection": lambda: from_middle("reflection", 1),
    "bonnet": lambda: lambda index, count, image: bonnet(image),
    "compression": lambda: _compressed(VideoEncoder()),
}
MIN_VISIBLE_RATIO = 0.05  # of a body with a box


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("roads", label)
    parser.add_argument("names", nargs="*", metavar="NAME", help="road, or ROAD+EFFECT")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write each rendered drive to DIR/NAME")
    parser.add_argument("--drives", type=Path, metavar="DIR", help="use the drives in DIR; do not render")
    parser.add_argument("--frames", type=int, help="frames per drive; default: all")
    parser.add_argument("--width", type=int, default=640, help="image width in pixels; KITTI has 1242")
    parser.add_argument("--quality", type=int, default=92, help="of the WebP images, 1 to 100")
    parser.add_argument("--begin-at", type=int, nargs="+", default=[0], metavar="IMAGE", help="starts of full runs")
    parser.add_argument("--every", type=int, default=20, help="images between cold starts")
    parser.add_argument("--images", type=int, default=25, help="images per cold start")
    options = parser.parse_args(arguments)
    if options.every < 1 or options.images < MIN_IMAGES or not 1 <= options.quality <= 100:
        raise PerfError(f"--every must be at least 1, --images {MIN_IMAGES}, --quality 1 to 100")
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
                recording, edit = drives.open(name)
                drive = read(recording, edit, drives.image_count(name))
                row = measure(drive, options.begin_at, options.every, options.images)
                ledger.add(name, row_text(row), hz=recording.rate_hz, **row)
    except DatasetError as error:
        raise PerfError(str(error)) from error


class _Drives:
    """The drives by name; each is rendered once unless it is on disk."""

    def __init__(self, options: argparse.Namespace, spare: Path) -> None:
        self._options, self._folder = options, options.drives or options.keep or spare
        self._rendered: set[str] = set()
        if options.drives is None:
            if importlib.util.find_spec("numba") is None:
                raise PerfError("rendering needs numba; install the extra [train], or name drives with --drives")
            from birdslam.world.roads import ROADS

            known = list(ROADS)
        else:
            known = sorted(path.parent.name for path in options.drives.glob("*/drive.npz"))
        over = [name for name in (DEMO, "motorway_30") if name in (DEMO, *known)]
        self.names = [*known, DEMO, *(f"{road}+{effect}" for road in over for effect in EFFECTS)]

    def image_count(self, name: str) -> int:
        """Number of images to use."""
        return self._options.frames or (DEMO_FRAMES if name.partition("+")[0] == DEMO else 10**6)

    def open(self, name: str) -> tuple[DemoRecording, Edit | None]:
        """A drive and the edit of its images. Raises PerfError for an unknown name."""
        road, _, effect = name.partition("+")
        if (name not in self.names and f"{DEMO}+{effect}" not in self.names) or road not in self.names:
            raise PerfError(f"{name}: unknown road; expected one of {', '.join(self.names)}")
        edit = EFFECTS[effect]() if effect else None
        if road == DEMO:
            return DemoRecording(stride=DEMO_STRIDE), edit
        if self._options.drives is None and road not in self._rendered:
            self._render(road)
        return DemoRecording(directory=self._folder / road), edit

    def _render(self, name: str) -> None:
        from birdslam.world.roads import ROADS, camera_of
        from birdslam.world.scenario import drive

        road = ROADS[name]
        count = min(road.frames, self._options.frames or road.frames)
        camera = camera_of(self._options.width)
        frames = drive(road.scenario(), camera, count, road.rate_hz, SAMPLES)
        write(self._folder / name, with_progress(frames, name, count), camera, road.rate_hz, self._options.quality)
        self._rendered.add(name)


def _compressed(encoder: VideoEncoder) -> Edit:
    return lambda index, count, image: encoder.code(image)


def read(recording: DemoRecording, edit: Edit | None = None, max_images: int = 10**6) -> Drive:
    """A drive of the built-in world, grey, with the true boxes of visible bodies; at most `max_images` images."""
    count = min(len(recording), max_images)
    images, t_ns, seen = [], [], []
    for frame in itertools.islice(recording.frames(), count):
        if frame.image is None:
            raise DatasetError(f"{recording.name}: image {frame.index}: {frame.error}")
        image = frame.image if edit is None else edit(frame.index, count, frame.image)
        boxes = [body.box_px for body in recording.truth_bodies(frame.index) if body.visible > MIN_VISIBLE_RATIO]
        seen.append((np.array(boxes, np.float64).reshape(-1, 4), None))
        images.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
        t_ns.append(frame.t_source_ns)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = recording.truth_poses()[:count]
    return Drive(recording.camera, images, t_ns, poses, list(seen))


def measure(
    drive: Drive, begin_at: Sequence[int] = (0,), every: int | None = None, images: int = 25
) -> dict[str, Any]:  # fmt: skip
    """Runs the odometry from some images to the end; with `every`, also cold starts over `images` images.

    "scale_errors" has a value per run; all other results are totals.
    """
    count = len(drive.images)
    ways, motions = [], []
    for first in begin_at:
        if first > count - MIN_IMAGES:
            raise DatasetError(f"start at image {first} of {count}: at least {MIN_IMAGES} images are needed")
        estimated, seen = follow(drive, range(first, count))
        way = errors(drive, range(first, count), estimated, seen)
        if way is None:
            raise DatasetError("the car of this drive does not move")
        ways.append(way)
        motions += seen
    firsts = range(0, count - MIN_IMAGES + 1, every) if every else range(0)
    starts = [cold_start(drive, range(first, min(first + images, count))) for first in firsts]
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
        "cold_starts": [start["scale_error"][-1] for start in starts if start is not None],
        "starts": ways,
    }


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
    images; 1 is consistent. Worst start: scale error of the worst cold start.
    """
    nees = "-" if row["nees"] is None else f"{row['nees']:.1f}"
    return (
        f"ways {' '.join(f'{error:+.1%}' for error in row['scale_errors'])}  "
        f"rotation {row['rotation_error_deg']:.2f} deg  valid {row['valid'] / max(row['motions'], 1):.0%}  "
        f"of them wrong {len(row['wrong_valid'])}  standstill {row['standstill']}  NEES {nees}  "
        f"worst start {max(row['cold_starts'], key=abs, default=math.nan):+.1%}"
    )
