"""A long recorded drive, replayed: is every estimate the same, bit for bit, and what did the recording cost?

    python -m perf replay --source kitti:DIR [--minutes 10] [--rate 33] [--model ROLE=PATH] [--images] [--output F.json]

The source goes round in a loop under `--record`; then the recording's measurements go through the back end alone.
Before and after, the same drive runs for a while without and with recording, in turns: the ages say what it costs.
Ends with status 1 where an estimate differs, or where the recording is not whole.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.perf.latency.live import Ask, Run, add_run_options, drive
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger
from birdslam.perf.reporting.machine import Steal
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.replay.replay import compare
from birdslam.runtime.replay.report import report
from birdslam.runtime.wire import Health

label = "a recorded drive and its replay, bit for bit, and what recording costs"

WARM_UP_S = 5.0
TURNS = 2  # without and with recording


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("replay", label)
    add_run_options(parser.add_argument)
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--minutes", type=float, default=10.0, help="of the recording")
    parser.add_argument("--images", action="store_true", help="record the frames too")
    parser.add_argument("--beside", type=float, default=30.0, metavar="S", help="of each turn of the cost; 0: none")
    options = parser.parse_args(arguments)
    with (
        Ledger(options.output, label, minutes=options.minutes, rate=options.rate, images=options.images) as ledger,
        tempfile.TemporaryDirectory(prefix="replay") as folder,
    ):
        steal, place = Steal(), Path(folder)
        if options.beside:
            ledger.set(age_ms=_cost(options, place))
            print(_shown(ledger.content["age_ms"]))
        file = place / "drive.mcap"
        summary = _drive(options, options.minutes * 60.0, file).summary
        recording, begun_s = Recording(file), time.monotonic()
        verdict = compare(recording)
        replay_s = time.monotonic() - begun_s
        ledger.set(
            frames=summary["frames_processed"],
            dropped_by_nodes=summary["frames_dropped"],
            recording=summary["recording"],
            recorder=_recorder(recording),
            mb_a_minute=file.stat().st_size / 1e6 / options.minutes,
            equal=verdict.equal,
            coasted=verdict.coasted,
            unknown=verdict.unknown,
            maps=verdict.maps,
            epochs=verdict.epochs,
            first_difference=None if verdict.difference is None else verdict.difference.frame_id,
            replay_s=replay_s,
            times_real_time=options.minutes * 60.0 / replay_s,
            steal_during_percent=steal.percent(),
        )
        print(f"frames: {summary['frames_processed']} processed, {summary['frames_dropped']} dropped by the nodes")
        print(f"recording: {file.stat().st_size / 1e6:.1f} MB, {summary['recording']}")
        print("recorder: {cpu_percent:.1f} % of a core at the median, {rss_mb:.0f} MB".format(**_recorder(recording)))
        print(report(verdict, recording))
        print(f"replayed in {replay_s:.1f} s, {options.minutes * 60.0 / replay_s:.0f} times as fast as it was driven")
        whole = recording.complete and not summary["recording"]["dropped"] and not verdict.unknown
        return int(not (verdict.same and whole))


def _drive(options: argparse.Namespace, seconds: float, file: Path | None) -> Run:
    settings = list(options.set)
    if file is not None:
        settings += [f"recording.file={file}", f"recording.images={str(options.images).lower()}"]
    ask = Ask(
        source=options.source,
        rate=options.rate,
        seconds=seconds,
        models=tuple(options.model),
        settings=tuple(settings),
        config=options.config,
    )
    with drive(ask) as result:
        return result


def _cost(options: argparse.Namespace, place: Path) -> dict[str, Any]:
    """Age at a planner, p50 and p99 in ms, without and with recording."""
    ages: dict[str, list[float]] = {"without": [], "with": []}
    for turn in range(TURNS):
        for name in ages:
            file = place / f"{turn}.mcap" if name == "with" else None
            result = _drive(options, options.beside + WARM_UP_S, file).after(WARM_UP_S)
            ages[name] += [(m.t_received_ns - m.record.t_capture_ns) / 1e6 for m in result.messages]
    return {
        name: {f"p{percent}": round(float(np.percentile(values, percent)), 2) for percent in (50, 99)}
        for name, values in ages.items()
    }


def _recorder(recording: Recording) -> dict[str, float]:
    """Processor time and memory of the recorder, by its health records."""
    said = [msgspec.json.decode(message.data, type=Health) for message in recording.messages(("/health/record",))]
    if not said:
        return {"cpu_percent": float("nan"), "rss_mb": float("nan")}
    return {
        "cpu_percent": float(np.median([health.cpu_percent for health in said])),
        "rss_mb": max(health.rss_bytes for health in said) / 2**20,
    }


def _shown(ages: dict[str, dict[str, float]]) -> str:
    return "\n".join(f"age {name} recording: p50 {a['p50']:.1f}, p99 {a['p99']:.1f} ms" for name, a in ages.items())
