"""How fast one core renders the built-in world: training's samples, each a world of its own, and frames of a drive.

    python -m perf renderer [--samples 60] [--frames 60] [--output F.json]

Times are the process's own (CPU), of one thread: waiting for the processor is not in them, a busy machine's slower
caches are. Needs the extra [train].
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator

import cv2

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger, noise, spread, spread_text

label = "the built-in world's renderer: frames a second a core (extra train)"

SIZES = ((640, 192), (1242, 375))
FIRST_SEED = 0


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("renderer", label)
    parser.add_argument("--samples", type=int, default=60, help="worlds of one frame each")
    parser.add_argument("--frames", type=int, default=60, help="of one drive")
    options = parser.parse_args(arguments)
    if min(options.samples, options.frames) < 1:
        raise PerfError("--samples and --frames need at least 1")
    if importlib.util.find_spec("numba") is None:
        raise PerfError("the world is rendered with numba: install the extra [train]")
    cv2.setNumThreads(1)
    with Ledger(options.output, label) as ledger:
        for width_px, height_px in SIZES:
            for kind, times_ms in (
                ("samples", list(_samples(width_px, height_px, options.samples))),
                ("drive", list(_drive(width_px, height_px, options.frames))),
            ):
                figures = spread(times_ms)
                rate_hz = 1e3 * len(times_ms) / sum(times_ms)
                ledger.add(
                    f"{kind} {width_px}x{height_px}",
                    f"{spread_text(figures, 'ms')}  {rate_hz:.1f} frames/s",
                    frames_per_s=round(rate_hz, 2),
                    ms=figures,
                    noise=noise("ms", times_ms),
                )


def _samples(width_px: int, height_px: int, count: int) -> Iterator[float]:
    """The time of one after the other (ms), the kernels compiled before the first."""
    from birdslam.world.world import sample

    sample(FIRST_SEED, width_px, height_px)
    for seed in range(FIRST_SEED + 1, FIRST_SEED + 1 + count):
        begun_ns = time.process_time_ns()
        sample(seed, width_px, height_px)
        yield (time.process_time_ns() - begun_ns) / 1e6


def _drive(width_px: int, height_px: int, count: int) -> Iterator[float]:
    """The time of each frame of a drive but the first, with which the street is built."""
    from birdslam.world.world import World, WorldConfig

    frames = World(FIRST_SEED, WorldConfig(width_px=width_px, height_px=height_px)).frames(count + 1)
    next(frames)
    begun_ns = time.process_time_ns()
    for _ in frames:
        now_ns = time.process_time_ns()
        yield (now_ns - begun_ns) / 1e6
        begun_ns = time.process_time_ns()
