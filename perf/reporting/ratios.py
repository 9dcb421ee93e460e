"""Ratios of our results to those of an alternative in the same run, which hold across machines, with upper bounds.

    python -m perf ratios [--rounds 3] [--output F.json]

The pairs run one after the other, in several rounds; the median of the rounds must not exceed the bound.
`perf/reference.toml` has the measured ratios and the bounds.
"""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np

from birdslam.perf.latency import optimizer, transport
from birdslam.perf.latency.drive import DriveConfig
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "ratios to alternatives in one run, compared with the reference"

REFERENCE = Path(__file__).parent.parent / "reference.toml"
FRAMES, LIMIT_S = 300, 10.0
RATE_HZ, TRANSPORT_S = 200, 0.6


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The reference value of a ratio, and its upper bound."""

    measured: float
    bound: float


def reference() -> dict[str, Bound]:
    """Reads perf/reference.toml."""
    return msgspec.convert(tomllib.loads(REFERENCE.read_text(encoding="utf-8")), dict[str, Bound])


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("ratios", label)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    bounds = reference()
    with Ledger(options.output, label, rounds=options.rounds) as ledger:
        found = measure(options.rounds)
        for name, values in found.items():
            bound = bounds[name]
            verdict = "held" if np.median(values) <= bound.bound else "WORSE than its bound"
            line = f"{np.median(values):.3f} (reference {bound.measured:g}, bound {bound.bound:g}): {verdict}"
            ledger.add(
                name,
                line,
                rounds=values,
                median=float(np.median(values)),
                **msgspec.structs.asdict(bound),
            )
    return 1 if worse(found, bounds) else 0


def worse(found: dict[str, list[float]], bounds: dict[str, Bound]) -> list[str]:
    """The ratios whose median over the rounds exceeds the bound."""
    return [name for name, values in found.items() if np.median(values) > bounds[name].bound]


def measure(rounds: int) -> dict[str, list[float]]:
    """The values of each ratio per round."""
    out: dict[str, list[float]] = {}
    pairs: tuple[Callable[[], Iterator[tuple[str, float]]], ...] = (_pixels, _records, _back_end)
    for _ in range(rounds):
        for pair in pairs:
            for name, value in pair():
                out.setdefault(name, []).append(round(value, 4))
    return out


def _pixels() -> Iterator[tuple[str, float]]:
    """A colour frame through the ring, compared with zenoh over a socket."""
    size = max(transport.SIZES_B)
    rows = [transport.measure(transport.Case(c, size, RATE_HZ, 0), TRANSPORT_S) for c in ("ring", "zenoh")]
    ours, peer = ([row["latency_ms"]["p50"], sum(row["cpu_percent"].values())] for row in rows)
    yield "ring over zenoh, 1.4 MB, latency", ours[0] / peer[0]
    yield "ring over zenoh, 1.4 MB, cpu", ours[1] / peer[1]


def _records() -> Iterator[tuple[str, float]]:
    """A typed record validated at both ends, compared with raw bytes."""
    rows = [transport.measure(transport.Case(c, 4_000, RATE_HZ, 0), TRANSPORT_S) for c in ("bus", "zenoh")]
    yield "bus over bare zenoh, 4 kB, cpu", sum(rows[0]["cpu_percent"].values()) / sum(rows[1]["cpu_percent"].values())


def _back_end() -> Iterator[tuple[str, float]]:
    """The pose graph compared with gtsam's fixed-lag smoother, and its growth with vehicles and frames."""
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        took = {}
        for contender, vehicles in (("ours", 3), ("ours", 15), ("incremental_fixed_lag_qr", 15)):
            log = Path(folder) / f"{vehicles}.log"
            if not log.exists():
                optimizer.write_log(log, DriveConfig(frames=FRAMES, vehicles=vehicles, traffic="convoy"), seed=1)
            took[contender, vehicles] = optimizer.measure(contender, vehicles, log, LIMIT_S)
    ours, peer = took["ours", 15], took["incremental_fixed_lag_qr", 15]
    over_frames_us = ours["over_frames_us"]
    third = len(over_frames_us) // 3
    first_us, last_us = np.median(over_frames_us[third : 2 * third]), np.median(over_frames_us[2 * third :])
    yield ("pose graph over gtsam's fixed lag, 15 vehicles", ours["p50_us"] / peer["p50_us"])
    yield "pose graph, 15 vehicles over 3", ours["p50_us"] / took["ours", 3]["p50_us"]
    yield "pose graph, last frames over middle ones", float(last_us / first_us)
