"""Age at the planner and the optimizer's time with the map process at work and without it, in turn on one machine."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.perf.latency.live import Ask, Run, drive
from birdslam.perf.reporting.figures import Ledger, spread
from birdslam.runtime.transport.bus import Message

Split = Callable[[Sequence[Message]], dict[str, Floats]]

OPTIMIZER = "optimize"
COMPARED = ("age", "p50"), ("age", "p99"), ("optimize", "p50"), ("optimize", "p99")


def measure(ledger: Ledger, ask: Ask, pairs: int, split: Split, warm_up_s: float) -> None:
    """So many runs of each, the order turned from pair to pair; then the median of with over without.

    `split`: milliseconds of each part of the messages' ages.
    """
    rows: list[dict[str, dict[str, Any]]] = []
    with tempfile.TemporaryDirectory(prefix="perf-map") as folder:
        kept = f"results.map={Path(folder) / 'street.map'}"
        for pair in range(pairs):
            rows.append({})
            for name in ("without", "with") if pair % 2 == 0 else ("with", "without"):
                settings = (*ask.settings, kept) if name == "with" else ask.settings
                with drive(msgspec.structs.replace(ask, settings=settings)) as run:
                    row = rows[-1][name] = _figures(run.after(warm_up_s), split)
                age, optimize = row["age_ms"], row["optimize_ms"]
                looked = f", {row['looks']} images looked at" if name == "with" else ""
                text = (
                    f"age p50 {age['p50']:.1f} p99 {age['p99']:.1f} ms; optimizer p50 {optimize['p50']:.2f} "
                    f"p99 {optimize['p99']:.2f} ms; {row['dropped']} dropped{looked}"
                )
                ledger.add(f"{pair + 1}: {name} the map process", text, **row)
    over = {
        f"{what} {at}": [round(pair["with"][f"{what}_ms"][at] / pair["without"][f"{what}_ms"][at], 3) for pair in rows]
        for what, at in COMPARED
    }
    text = "; ".join(
        f"{name} {np.median(each):.3f} ({', '.join(f'{ratio:.3f}' for ratio in each)})" for name, each in over.items()
    )
    ledger.add("with over without, median (each pair)", text, over=over)


def _figures(run: Run, split: Split) -> dict[str, Any]:
    summary, parts = run.summary, split(run.messages)
    age_ms = [(message.t_received_ns - message.record.t_capture_ns) / 1e6 for message in run.messages]
    return {
        "age_ms": spread(age_ms),
        "optimize_ms": spread(parts[OPTIMIZER][~np.isnan(parts[OPTIMIZER])]),
        "dropped": summary["frames_dropped"],
        "looks": summary["map"]["looks"] if "map" in summary else 0,
    }
