"""Age at the planner and its parts with the map process, or lanes, at work and without, in turn on one machine.

Frames that wait for a network are some 10 ms older than those without a look, and on how many of them networks look
follows the load of the moment (look_rate.py). So the median of all frames jumps between the two where the share of
looks does, whatever is compared: both kinds are compared by themselves as well, and CPU time a frame, the steadiest.
"""

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
from birdslam.types import Status

Split = Callable[[Sequence[Message]], dict[str, Floats]]

STEPS = "perceive", "optimize"
COMPARED = (
    *((what, at) for what in ("age", *STEPS) for at in ("p50", "p99")),
    *(("age_looked", "p50"), ("age_carried", "p50"), ("cpu", "mean")),
)
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
                    row = rows[-1][name] = figures(run.after(warm_up_s), split)
                text = "; ".join(
                    f"{what} p50 {row[f'{what}_ms']['p50']:.2f} p99 {row[f'{what}_ms']['p99']:.2f} ms"
                    for what in ("age", *STEPS)
                )
                text += (
                    f"; {row['cpu_ms']['mean']:.2f} ms of CPU a frame, networks on {100 * row['looked']:.0f} % of them"
                )
                looked = f", {row['looks']} images looked at" if row["looks"] else ""
                ledger.add(f"{pair + 1}: {name} {part}", f"{text}; {row['dropped']} dropped{looked}", **row)
    over = {
        f"{what} {at}": each
        for what, at in COMPARED
        if (each := [ratio for pair in rows if (ratio := ratio_of(pair, f"{what}_ms", at)) is not None])
    }
    text = "; ".join(
        f"{name} {np.median(each):.3f} ({', '.join(f'{ratio:.3f}' for ratio in each)})" for name, each in over.items()
    )
    ledger.add("with over without, median (each pair)", text, over=over)


def ratio_of(pair: dict[str, dict[str, Any]], what: str, at: str) -> float | None:
    """With over without; None where one of them has none of it."""
    made, plain = pair["with"][what].get(at), pair["without"][what].get(at)
    return round(made / plain, 3) if made is not None and plain else None


def figures(run: Run, split: Split) -> dict[str, Any]:
    summary, parts = run.summary, split(run.messages)
    age_ms = np.array([(message.t_received_ns - message.record.t_capture_ns) / 1e6 for message in run.messages])
    carried = np.array([Status.DETECTIONS_CARRIED in message.record.status for message in run.messages], dtype=bool)
    steps = {f"{step}_ms": spread(parts[step][~np.isnan(parts[step])]) for step in STEPS}
    return {
        "age_ms": spread(age_ms),
        "age_looked_ms": spread(age_ms[~carried]),
        "age_carried_ms": spread(age_ms[carried]),
        "looked": round(float(1.0 - carried.mean()), 3),
        "cpu_ms": {"mean": cpu_ms(run)},
        **steps,
        "dropped": summary["frames_dropped"],
        "looks": summary["map"]["looks"] if "map" in summary else 0,
    }


def cpu_ms(run: Run) -> float:
    """Of all processes but the spares, which load while the drive begins, for one frame."""
    first, last = run.samples[0], run.samples[-1]
    names = [name for name in first.cpu_s.keys() & last.cpu_s.keys() if not name.endswith(" spare")]
    frames = sum(first.t_s <= message.t_received_ns / 1e9 < last.t_s for message in run.messages)
    return round(1e3 * sum(last.cpu_s[name] - first.cpu_s[name] for name in names) / max(frames, 1), 3)
