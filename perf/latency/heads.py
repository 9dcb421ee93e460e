"""What each head of the shipped network costs a core: processor time of one thread, whole and with heads left out.

    python -m perf heads [--runs 60] [--output F.json]

The graph is cut before it runs, so that what only a head that is left out needs is left out too.
The variants run in turn, so that a busy machine bears on all alike; the fastest tenth is what the computation takes,
the median what this machine gave. `looks` says what a schedule costs a second at 33 Hz, by these.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from birdslam.perception.decoding.multitask import OUTPUTS
from birdslam.perception.manifest import SHIPPED_NETWORKS
from birdslam.perception.onnx_files.unread_outputs import without_outputs
from birdslam.perception.session import plain_session
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "what each head of the shipped network costs a core"

FILES = ("multitask_int8.onnx", "multitask.onnx")
BOXES, FINE = ("heat", "body"), ("segmentation", "depth")
VARIANTS: dict[str, tuple[str, ...]] = {
    "whole": (*FINE, *BOXES),
    "without depth": ("segmentation", *BOXES),
    "without segmentation": ("depth", *BOXES),
    "boxes alone": BOXES,
    "masks alone": ("segmentation",),
}
RATE_HZ = 33.0
# (variant, on one frame in so many); without depth is what a vehicle runs, which has no Frustum-PointNet
SCHEDULES: dict[str, tuple[tuple[str, int], ...]] = {
    "whole on every frame": (("whole", 1),),
    "without depth on every frame": (("without depth", 1),),
    "without depth on every 2nd frame": (("without depth", 2),),
    "boxes on every frame, masks on every 2nd": (("without depth", 2), ("boxes alone", 2)),
    "boxes on every 2nd frame, masks on every 4th": (("without depth", 4), ("boxes alone", 4)),
    "without depth on every 3rd frame": (("without depth", 3),),
}


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("heads", label)
    parser.add_argument("--runs", type=int, default=60, help="of each variant")
    options = parser.parse_args(arguments)
    with Ledger(options.output, label, runs=options.runs) as ledger:
        for file in FILES:
            took_ms = measure(SHIPPED_NETWORKS / file, options.runs)
            for name, times_ms in took_ms.items():
                fastest, median = np.percentile(times_ms, [10, 50])
                shown = f"fastest tenth {fastest:.1f} ms  median {median:.1f} ms of a core"
                ledger.add(f"{file} {name}", shown, fastest_ms=float(fastest), median_ms=float(median))
            for name, parts in SCHEDULES.items():
                cores = sum(np.percentile(took_ms[variant], 50) / every for variant, every in parts) * RATE_HZ / 1e3
                ledger.add(f"{file} looks: {name}", f"{cores:.2f} of a core at 33 Hz", cores=float(cores))


def measure(path: Path, runs: int) -> dict[str, list[float]]:
    """Processor time in ms of each run, by variant."""
    content = path.read_bytes()
    cut = {name: without_outputs(content, set(OUTPUTS) - set(read)) for name, read in VARIANTS.items()}
    sessions = {name: plain_session(network, threads=1) for name, network in cut.items()}
    (image,) = sessions["whole"].get_inputs()
    feed = {image.name: np.random.default_rng(0).random(image.shape, dtype=np.float32)}
    took_ms: dict[str, list[float]] = {name: [] for name in sessions}
    for _ in range(runs):
        for name, session in sessions.items():
            begun_s = time.thread_time()
            session.run(None, feed)
            took_ms[name].append((time.thread_time() - begun_s) * 1e3)
    return took_ms
