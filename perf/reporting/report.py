"""Writes report.md, the summary of the benchmarks' results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from birdslam.perf.reporting.machine import ROOT
from birdslam.runtime.latency import key_of

MIN_FOR_P999 = 1000  # samples
Row = Mapping[str, Any]
Benchmarks = Mapping[str, Mapping[str, Any]]


def write(folder: Path, content: Mapping[str, Any]) -> None:
    """Writes `folder/report.md`."""
    (folder / "report.md").write_text(markdown(content), encoding="utf-8")


def markdown(content: Mapping[str, Any]) -> str:
    """Returns the report."""
    sections = [_head(content)]
    benchmarks: Benchmarks = content["benchmarks"]
    for title, section in SECTIONS:
        body = "\n".join(section(benchmarks))
        if body:
            sections.append(f"## {title}\n\n{body}")
    return "\n\n".join(sections).replace(str(ROOT.parent), "..") + "\n"


def table(titles: Iterable[str], rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """A Markdown table; numbers have three digits."""
    titles = list(titles)
    yield f"| {' | '.join(titles)} |"
    yield f"|{'---|' * len(titles)}"
    for row in rows:
        yield f"| {' | '.join(_cell(value) for value in row)} |"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)


def _percentiles(figures: Mapping[str, Any], names: tuple[str, ...] = ("p50", "p99", "p999", "max")) -> list[object]:
    few = figures.get("n", 0) < MIN_FOR_P999  # p99.9 would be the maximum
    return [None if few and name == "p999" else figures.get(name) for name in names]


def _head(content: Mapping[str, Any]) -> str:
    machine = content["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    shared = ", on a hypervisor" if machine["hypervisor"] else ""
    changed = f" with {machine['uncommitted_files']} files not committed" if machine["uncommitted_files"] else ""
    missing = [f"{name}: {how}" for name, how in content["outcome"].items() if how != "complete"]
    lines = [
        "# BirdSLAM's performance on this machine",
        "",
        f"    {content['command']}",
        "",
        f"- {machine['utc']}, {machine['cpu']}, {machine['cores']} cores, {machine['memory_gb']} GB{shared}; "
        f"{machine['kernel']}; load of 1 minute before: {machine['load_before']}",
        f"- commit {machine['commit'] or 'unknown'}{changed}; {versions}",
        f"- source {content['source']}; networks: {', '.join(content['models']) or 'the shipped ones'}",
        f"- configuration: {_configuration(content['benchmarks'])}",
        *(f"- **{line}**" for line in missing),
        "",
        "Times are in ms unless stated otherwise, at p50, p99, p99.9 and max. `steal` is the share of CPU time that "
        "the hypervisor took; if it is not near 0, it determines the tail.",
    ]
    return "\n".join(lines)


def _configuration(benchmarks: Benchmarks) -> str:
    """The part of the configuration that affects times; report.json has all of it."""
    whole: Mapping[str, Any] = next((run["configuration"] for run in benchmarks.values() if "configuration" in run), {})
    parts = [text for key in ("source", "perceive", "models") for text in _set(key, whole.get(key))]
    networks = [network for run in benchmarks.values() for network in run.get("networks", {}).values()]
    ran = dict.fromkeys(f"{n['file']} on {n['threads']} threads" for n in networks)
    return "; ".join((*ran, ", ".join(parts), "whole in report.json"))


def _set(key: str, value: object) -> Iterator[str]:
    """KEY=VALUE of all settings below a key that are not None."""
    if isinstance(value, Mapping):
        for name, below in value.items():
            yield from _set(f"{key}.{name}", below)
    elif value is not None:
        yield f"{key}={_cell(value)}"


def _system(benchmarks: Benchmarks) -> Iterator[str]:
    runs = {name: run for name, run in benchmarks.items() if "age_ms" in run}
    if not runs:
        return
    titles = ("run", "rate Hz", "dropped", "cores", "MB", "MB shared once", "age p50", "p99", "p99.9", "max", "steal %")
    yield from table(
        titles,
        (
            [
                *(name, run["rate_hz"], f"{run['dropped']} of {run['frames']}", run["cpu_cores"], run["rss_mb"]),
                *(run.get("pss_mb"), *_percentiles(run["age_ms"]), run["steal_during_percent"]),
            ]
            for name, run in runs.items()
        ),
    )
    for name, run in runs.items():
        yield f"\n**{name}**, parts of an estimate's age (the means add up to {run['age_ms']['mean']:.2f}):\n"
        budgets = {row["budget"]: row for row in run["budgets"]}
        rows = []
        for stage, figures in [*run["stages"].items(), ("whole", run["age_ms"])]:
            key = "end_to_end_ms" if stage == "whole" else f"{key_of(stage)}_ms"
            budget = budgets.get(key, {})
            limit = f"p{budget['percentile']:g} {budget['limit_ms']:g}" if budget else None
            figured = (figures["mean"], figures.get("mean_in_tail"), *_percentiles(figures, ("p50", "p99", "max")))
            rows.append((stage, *figured, limit, budget.get("met")))
        stage_titles = ("stage", "mean", "mean in the slowest 1 %", "p50", "p99", "max", "budget", "met")
        yield from table(stage_titles, rows)
    yield "\nCores by process: " + "; ".join(
        f"{name}: " + ", ".join(f"{process} {cores:.2f}" for process, cores in run["cpu_cores_by"].items())
        for name, run in runs.items()
    )
    yield ("\nMB is the sum of the processes' maxima, spares included; MB shared once counts shared pages once (PSS).")


def _optimizer(benchmarks: Benchmarks) -> Iterator[str]:
    titles = ("who", "vehicles", "frames", "p50 us", "p99", "p99.9", "max", "first 1000", "last 1000", "MB more")
    names = ("frames", "p50_us", "p99_us", "p999_us", "max_us", "first_thousand_p50_us", "last_thousand_p50_us")
    picked = ("contender", "vehicles", *names, "rss_growth_mb")
    yield from _table_of("optimizer", titles, lambda row: [row[name] for name in picked])(benchmarks)
    yield from _table_of(
        "batch",
        ("who", "seconds", "ratio"),
        lambda row: [row["name"], row["seconds"], "not converged" if row["ratio"] is None else row["ratio"]],
        "\nA whole sequence, batch over incremental (the paper's own ratio is 1.9 s / 0.016 s = 119):\n",
    )(benchmarks)


def _table_of(
    benchmark: str, titles: Sequence[str], cells: Callable[[Row], Iterable[object]], before: str = ""
) -> Callable[[Benchmarks], Iterator[str]]:
    """A section with one table of a benchmark's rows; empty without rows."""

    def section(benchmarks: Benchmarks) -> Iterator[str]:
        rows = benchmarks.get(benchmark, {}).get("rows", [])
        if rows:
            yield from [before] if before else []
            yield from table(titles, map(cells, rows))

    return section


_transport = _table_of(
    "transport",
    ("case", "p50", "p99", "p99.9", "max", "cpu % send", "cpu % receive", "dropped", "steal %"),
    lambda row: [
        *(row["name"], *_percentiles(row["latency_ms"]), *row["cpu_percent"].values()),
        *(f"{row['dropped']} of {row['sent']}", row["steal_percent"]),
    ],
)
SECTIONS = (
    ("The whole system", _system),
    ("Optimizer", _optimizer),
    ("Transport", _transport),
)
