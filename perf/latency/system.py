"""The whole system at a rate: age of estimates at the planner, its parts, and use of CPU and memory.

    python -m perf system --source demo|kitti:DIR --rate 33 --seconds 120 [--model detector=F.onnx] --output F.json

`birdslam run` starts the real processes; this process is their planner. A recording is played in a loop at `--rate`.
The results exclude the first seconds, except for dropped frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.perf.latency.live import Ask, Run, add_run_options, drive
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger, spread, spread_text
from birdslam.perf.reporting.machine import Steal
from birdslam.runtime.configuration import BudgetsConfig
from birdslam.runtime.doctor.costs import busy_cores
from birdslam.runtime.latency import key_of, queue_of, stages
from birdslam.runtime.transport.bus import Message
from birdslam.types import Status

label = "age at the planner, rate, drops, CPU and memory of the real processes"

WARM_UP_S = 3.0
TAIL_PERCENTILE = 99.0


def run(arguments: list[str]) -> int:
    parser = benchmark_parser("system", label)
    add_run_options(parser.add_argument)
    parser.add_argument("--rate", type=float, default=33.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--load", type=int, default=0, help="number of cores loaded by other processes")
    options = parser.parse_args(arguments)
    ask = Ask(
        source=options.source,
        rate=options.rate,
        seconds=options.seconds + WARM_UP_S,
        models=tuple(options.model),
        settings=tuple(options.set),
        config=options.config,
    )
    settings = {**msgspec.to_builtins(ask, enc_hook=str), "seconds": options.seconds, "load": options.load}
    with Ledger(options.output, label, **settings) as ledger:
        steal = Steal()
        with busy_cores(options.load), drive(ask) as result:
            ledger.set(**figures(result, WARM_UP_S), steal_during_percent=steal.percent())
        print(table(ledger.content))
        if not result.complete:
            raise KeyboardInterrupt
    return 0 if all(row["met"] for row in ledger.content["budgets"]) else 1


def figures(result: Run, warm_up_s: float = 0.0) -> dict[str, Any]:
    """The results of a run; the means of `stages` add up to the mean of `age_ms`."""
    summary, received = result.summary, len(result.messages)
    result.after(warm_up_s)
    age_ms = np.array([age_of(message) for message in result.messages])
    parts_ms = split(result.messages)
    late = age_ms >= np.percentile(age_ms, TAIL_PERCENTILE) if age_ms.size else np.zeros(0, dtype=bool)
    cpu, rss_mb = usage(result)
    periods_ms = np.diff([message.t_received_ns for message in result.messages]) / 1e6
    return {
        "rate_hz": round(1e3 / float(periods_ms.mean()), 3) if periods_ms.size else 0.0,
        "frames": summary["frames_in"],
        "dropped": summary["frames_dropped"],
        "dropped_by": summary["dropped_by"],
        "missed_by_planner": summary["frames_processed"] - received,
        "predicted": sum(_overtaken(message.record.status) for message in result.messages),
        "coasted": sum(Status.PERCEPTION_LATE in message.record.status for message in result.messages),
        "cpu_cores": round(float(sum(np.mean(values) for values in cpu.values() if len(values))), 3),
        "cpu_cores_by": {name: round(float(np.mean(values)), 3) for name, values in cpu.items() if len(values)},
        "rss_mb": round(sum(rss_mb.values()), 1),
        "rss_mb_by": {name: round(value, 1) for name, value in rss_mb.items()},
        "pss_mb": round(max((sum(sample.pss_mb.values()) for sample in result.samples), default=0.0), 1) or None,
        "pss_mb_by": {
            name: round(max(sample.pss_mb.get(name, 0.0) for sample in result.samples), 1) for name in rss_mb
        },
        "age_ms": spread(age_ms) | {"mean": _mean(age_ms)},
        "period_ms": spread(periods_ms),
        "start_late_ms": spread(lateness(result.messages, result.rate_hz)),
        "stages": {
            name: spread(gone(values)) | {"mean": _mean(values), "mean_in_tail": _mean(values[late])}
            for name, values in parts_ms.items()
        },
        "statuses": summary["statuses"],
        "restarts": summary["restarts"],
        "budgets": list(budgets(summary["configuration"]["budgets"], age_ms, parts_ms)),
        "configuration": summary["configuration"],
        "networks": summary["models"],
    }


def _overtaken(status: Sequence[Status]) -> bool:
    """Whether perceive skipped this frame for lack of time and reported it in time."""
    return Status.COASTING in status and Status.PERCEPTION_LATE not in status


def age_of(message: Message) -> float:
    """Time in ms from the frame's capture until this planner has the estimate."""
    return float(message.t_received_ns - message.record.t_capture_ns) / 1e6


def parts(message: Message) -> Iterator[tuple[str, float]]:
    """(name, ms) of the parts of an estimate's age, which add up to it.

    Late measurements of a skipped frame correct the newest coasted one. That estimate has their trace, which started
    before its own frame was captured.
    """
    first = message.trace.stages[0]
    if first.received_ns < message.record.t_capture_ns:
        yield "published again", age_of(message)
        return
    yield f"due -> {first.node}", (first.received_ns - message.record.t_capture_ns) / 1e6
    yield from stages(message.trace, message.t_received_ns)


def split(messages: Sequence[Message]) -> dict[str, Floats]:
    """Part -> ms (N,) of each message; NaN for a part that the message skipped (a coasted frame has no perceive)."""
    out: dict[str, Floats] = {}
    for number, message in enumerate(messages):
        for name, ms in parts(message):
            out.setdefault(name, np.full(len(messages), np.nan))[number] = ms
    return out


def gone(values: Floats) -> Floats:
    """The values without those of messages that skipped the part."""
    return values[~np.isnan(values)]


def lateness(messages: Sequence[Message], rate_hz: float | None) -> Floats:
    """Delay (N,) in ms of each capture relative to the schedule through the earliest frame."""
    if not messages or rate_hz is None:
        return np.zeros(0)
    period_ns = 1e9 / rate_hz
    offsets = np.array([m.record.t_capture_ns - m.record.frame_id * period_ns for m in messages])
    return (offsets - offsets.min()) / 1e6


def _mean(values: Floats) -> float:
    """Mean over all messages, 0 for those without the part, so that the parts' means add up."""
    return round(float(np.nansum(values)) / values.size, 4) if values.size else 0.0


def usage(result: Run) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Cores in use by each process per second, and its maximum memory (MB)."""
    cores: dict[str, list[float]] = {}
    most_mb: dict[str, float] = {}
    for before, after in zip(result.samples, result.samples[1:], strict=False):
        for name in before.cpu_s.keys() & after.cpu_s.keys():
            used = (after.cpu_s[name] - before.cpu_s[name]) / (after.t_s - before.t_s)
            cores.setdefault(name, []).append(max(0.0, used))
    for sample in result.samples:
        for name, mb in sample.rss_mb.items():
            most_mb[name] = max(most_mb.get(name, 0.0), mb)
    return dict(sorted(cores.items())), dict(sorted(most_mb.items()))


def budgets(configured: dict[str, float], age_ms: Floats, parts_ms: dict[str, Floats]) -> Iterator[dict[str, Any]]:
    """Each budget of the configuration, the measured value, and whether it is met."""
    limits = msgspec.convert(configured, BudgetsConfig)
    measured = {"end_to_end_ms": age_ms}
    for name, values in parts_ms.items():
        waited_ms = np.nan_to_num(parts_ms.get(queue_of(name), np.zeros(1)))
        measured[f"{key_of(name)}_ms"] = gone(values + waited_ms)
    for key in BudgetsConfig.__struct_fields__:
        if key != "percentile" and measured.get(key, np.zeros(0)).size:
            value = float(np.percentile(measured[key], limits.percentile))
            limit = float(getattr(limits, key))
            yield {
                "budget": key,
                "percentile": limits.percentile,
                "limit_ms": limit,
                "measured_ms": round(value, 3),
                "met": value <= limit,
            }


def table(content: dict[str, Any]) -> str:
    """The results as text."""
    cpu = ", ".join(f"{name} {cores:.2f}" for name, cores in content["cpu_cores_by"].items())
    lines = [
        f"{'rate':32}{content['rate_hz']:.2f} Hz",
        f"{'dropped':32}{content['dropped']} of {content['frames']} frames, "
        f"{content['predicted']} predicted without perception, {content['coasted']} coasted",
        f"{'cores':32}{content['cpu_cores']:.2f} ({cpu})",
        f"{'memory':32}{content['rss_mb']:.0f} MB, {content['pss_mb'] or 0:.0f} MB with shared pages counted once",
        *(
            f"  {name:30}{mb:.0f} MB, {content['pss_mb_by'][name]:.0f} with its share of shared pages"
            for name, mb in content["rss_mb_by"].items()
        ),
        f"{'steal':32}{content['steal_during_percent']:.2f} %",
        f"{'age at the planner':32}{spread_text(content['age_ms'], 'ms')}  mean {content['age_ms']['mean']:.2f}",
    ]
    for name, stage in content["stages"].items():
        means = f"mean {stage['mean']:.2f}, in the slowest 1 % {stage['mean_in_tail']:.2f}"
        lines.append(f"  {name:30}{spread_text(stage, 'ms')}  {means}")
    for row in content["budgets"]:
        verdict = "met" if row["met"] else "NOT MET"
        line = f"p{row['percentile']:g} {row['measured_ms']:.2f} of {row['limit_ms']:g} ms: {verdict}"
        lines.append(f"{row['budget']:32}{line}")
    return "\n".join(lines)
