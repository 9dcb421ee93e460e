"""Age at the planner with many people and vehicles in view: a rendered street, boxes of its truth, the real processes.

    python -m perf people_age [--people 20] [--vehicles 10] [--rate 33] [--seconds 12] [--output F.json]
                               [--street DIR] [--render-only]

The street is rendered first (extra `train`), or taken from DIR, then driven once by `birdslam run --detections FILE`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from birdslam.perf.errors import PerfError
from birdslam.perf.latency.live import Ask, Run, drive
from birdslam.perf.latency.system import WARM_UP_S, figures, table
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.reporting.machine import Steal
from birdslam.runtime.world.demo_drive import write

if TYPE_CHECKING:
    from birdslam.world.truth import WorldFrame

label = "age at the planner with many people and vehicles in view"

EGO_MPS = 0.5
QUALITY = 80  # of the images
KITTI_TYPES = {"person": "Pedestrian", "cyclist": "Cyclist", "van": "Van", "truck": "Truck"}


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("people_age", label)
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--vehicles", type=int, default=10)
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=12.0, help="of the street, with the first three")
    parser.add_argument("--street", type=Path, metavar="DIR", help="where the street is kept, and taken from")
    parser.add_argument("--render-only", action="store_true", help="keeps the street: measure on a quiet machine")
    options = parser.parse_args(arguments)
    if options.render_only and options.street is None:
        raise PerfError("--render-only: --street says where to keep it")
    settings = {name: getattr(options, name) for name in ("people", "vehicles", "rate", "seconds")}
    with Ledger(options.output, label, **settings) as ledger, tempfile.TemporaryDirectory(prefix="perf") as folder:
        place = options.street or Path(folder)
        if not (place / "boxes.txt").exists():
            place.mkdir(parents=True, exist_ok=True)
            render(place, options.people, options.vehicles, options.rate, round(options.rate * options.seconds))
        if options.render_only:
            return
        ask = Ask(
            source=f"demo:{place / 'street'}",
            rate=options.rate,
            seconds=options.seconds,
            settings=(f"source.detections={place / 'boxes.txt'}", "source.detector=configured"),
            loop=False,
        )
        steal = Steal()
        with drive(ask) as result:
            ledger.set(**in_view(result), **figures(result, WARM_UP_S), steal_during_percent=steal.percent())
        content = ledger.content
        print(f"{'people, vehicles in view':32}{content['people_in_view']}, {content['vehicles_in_view']} (median)")
        print(table(content))


def render(place: Path, people: int, vehicles: int, rate_hz: float, count: int) -> None:
    """The drive, and its boxes as KITTI's text. Raises PerfError without the renderer."""
    try:
        from birdslam.world.people_scenes import CAMERA, boxes, crowd
        from birdslam.world.scenario import drive as rendered
    except ImportError as error:
        raise PerfError(f"rendering needs the extra `train` (pip install 'birdslam[train]'): {error}") from None
    frames = rendered(crowd(people, EGO_MPS, vehicles), CAMERA, count, rate_hz, 1)
    rng, lines = np.random.default_rng(0), list[str]()

    def with_boxes() -> Iterator[WorldFrame]:
        for frame in frames:
            for box, name, score, _ in zip(*boxes(frame, rng), strict=True):
                corners = " ".join(f"{edge:.2f}" for edge in box)
                kind = KITTI_TYPES.get(name, "Car")
                lines.append(f"{frame.frame_id} -1 {kind} 0 0 0 {corners} 0 0 0 0 0 0 0 {score:.3f}")
            yield frame

    write(place / "street", with_boxes(), CAMERA, rate_hz, QUALITY)
    (place / "boxes.txt").write_text("\n".join(lines) + "\n")


def in_view(result: Run) -> dict[str, Any]:
    """How many people and vehicles the planner received, at the median."""
    estimates = [message.record for message in result.messages]
    return {
        "people_in_view": int(np.median([sum(p.in_sight for p in e.people) for e in estimates])),
        "vehicles_in_view": int(np.median([sum(v.in_sight for v in e.vehicles) for e in estimates])),
    }
