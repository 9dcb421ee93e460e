"""Age at the planner and its parts with the map process, or lanes, at work and without, in turn on one machine."""

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

STEPS = "perceive", "optimize"
COMPARED = tuple((what, at) for what in ("age", *STEPS) for at in ("p50", "p99"))
NEVER = 1_000_000  # frames: lanes are made out of the first alone


def settings_of(part: str, folder: Path) -> dict[str, tuple[str, ...]]:
    """The settings without and with "map" or "lanes"."""
    if part == "map":
        return {"without": (), "with": (f"results.map={folder / 'street.map'}",)}
    return {"without": (f"perceive.schedule.lanes.every={NEVER}", "models.completion=false"), "with": ()}


def measure(ledger: Ledger, ask: Ask, part: str, pairs: int, split: Split, warm_up_s: float) -> None:
    """So many runs of each, the order turned from pair to pair; then the median of with over without.

    `split`: milliseconds of each part of the messages' ages.
    """
    rows: list[dict[str, dict[str, Any]]] = []
    with tempfile.TemporaryDirectory(prefix="perf-turns") as folder:
        settings = settings_of(part, Path(folder))
        for pair in range(pairs):
            rows.append({})
            for name in ("without", "with") if pair % 2 == 0 else ("with", "without"):
                with drive(msgspec.structs.replace(ask, settings=(*ask.settings, *settings[name]))) as run:
                    row = rows[-1][name] = _figures(run.after(warm_up_s), split)
                text = "; ".join(
                    f"{what} p50 {row[f'{what}_ms']['p50']:.2f} p99 {row[f'{what}_ms']['p99']:.2f} ms"
                    for what in ("age", *STEPS)
                )
                looked = f", {row['looks']} images looked at" if row["looks"] else ""
                ledger.add(f"{pair + 1}: {name} {part}", f"{text}; {row['dropped']} dropped{looked}", **row)
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
    steps = {f"{step}_ms": spread(parts[step][~np.isnan(parts[step])]) for step in STEPS}
    return {
        "age_ms": spread(age_ms),
        **steps,
        "dropped": summary["frames_dropped"],
        "looks": summary["map"]["looks"] if "map" in summary else 0,
    }
