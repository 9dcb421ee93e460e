"""Age at the planner and the optimizer's time with the map process at work and without it, in turn on one machine."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.perf.latency.live import Ask, Run, drive
from birdslam.perf.latency.system import WARM_UP_S, age_of, gone, split
from birdslam.perf.reporting.figures import Ledger, spread

OPTIMIZER = "optimize"
COMPARED = ("age", "p50"), ("age", "p99"), ("optimize", "p50"), ("optimize", "p99")


def measure(ledger: Ledger, ask: Ask, pairs: int) -> None:
    """So many runs of each, the order turned from pair to pair; then the median of with over without."""
    rows: list[dict[str, dict[str, Any]]] = []
    with tempfile.TemporaryDirectory(prefix="perf-map") as folder:
        kept = f"results.map={Path(folder) / 'street.map'}"
        for pair in range(pairs):
            rows.append({})
            for name in ("without", "with") if pair % 2 == 0 else ("with", "without"):
                settings = (*ask.settings, kept) if name == "with" else ask.settings
                with drive(msgspec.structs.replace(ask, settings=settings)) as run:
                    row = rows[-1][name] = _figures(run)
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


def _figures(run: Run) -> dict[str, Any]:
    summary = run.summary
    run.after(WARM_UP_S)
    stages = split(run.messages)
    return {
        "age_ms": spread([age_of(message) for message in run.messages]),
        "optimize_ms": spread(gone(stages[OPTIMIZER])),
        "dropped": summary["frames_dropped"],
        "looks": summary["map"]["looks"] if "map" in summary else 0,
    }
