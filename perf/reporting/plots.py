"""The pictures of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Benchmarks = Mapping[str, Mapping[str, Any]]


def draw(folder: Path, benchmarks: Benchmarks) -> list[str]:
    """Draws what the benchmarks have; gives the files' names."""
    names = []
    for name, figure in _figures(benchmarks):
        figure.savefig(folder / name, dpi=80, bbox_inches="tight")
        plt.close(figure)
        names.append(name)
    return names


def _figures(benchmarks: Benchmarks) -> Iterator[tuple[str, Figure]]:
    runs = {name: run for name, run in benchmarks.items() if run.get("age_curve_ms")}
    if runs:
        yield "age.png", _age(runs)
        yield "stages.png", _stages(runs)
    transport = benchmarks.get("transport", {}).get("rows", [])
    if transport:
        yield "transport.png", _transport(transport)
    vehicles = benchmarks.get("vehicles", {}).get("rows", [])
    if vehicles:
        yield "vehicles.png", _vehicles(vehicles)
    optimizer = benchmarks.get("optimizer", {}).get("rows", [])
    if optimizer:
        yield "optimizer.png", _optimizer(optimizer)


def _tail(axes: Axes, curve: list[list[float]], label: str, color: str | None = None) -> None:
    """The share of samples above a value, both on a log scale, so that the tail can be seen."""
    points = [(value, 1.0 - percent / 100.0) for percent, value in curve]
    axes.loglog(*zip(*points, strict=True), label=label, color=color, marker=".", markersize=3, linewidth=1)


def _age(runs: Benchmarks) -> Figure:
    figure, axes = plt.subplots(figsize=(7, 4))
    for name, run in runs.items():
        _tail(
            axes, run["age_curve_ms"], f"{name} (n = {run['age_ms']['n']}, steal {run['steal_during_percent']:.2g} %)"
        )
    axes.set(xlabel="age at the planner, ms", ylabel="share of estimates that are older", title="Age of estimates")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _stages(runs: Benchmarks) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 1.2 + 0.8 * len(runs)))
    labels = [f"{name}{when}" for name in runs for when in ("", ", slowest 1 %")]
    stages = list(dict.fromkeys(stage for run in runs.values() for stage in run["stages"]))
    left = np.zeros(len(labels))
    for stage in stages:
        figures = [run["stages"].get(stage, {}) for run in runs.values()]
        widths = np.array([f.get(key, 0.0) for f in figures for key in ("mean", "mean_in_tail")])
        axes.barh(labels, widths, left=left, label=stage)
        left += widths
    axes.invert_yaxis()
    axes.set(xlabel="mean, ms", title="Where an estimate's age comes from")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _transport(rows: list[dict[str, Any]]) -> Figure:
    sizes = sorted({row["bytes"] for row in rows})
    loads = sorted({row["load"] for row in rows})
    carriers = list(dict.fromkeys(row["carrier"] for row in rows))
    rate_hz = max(row["rate_hz"] for row in rows)  # the most samples
    size = (4 * len(sizes), 3 * len(loads))
    figure, grid = plt.subplots(len(loads), len(sizes), figsize=size, squeeze=False, sharey=True)
    for row in rows:
        if row["rate_hz"] == rate_hz and row["curve_ms"]:
            axes = grid[loads.index(row["load"])][sizes.index(row["bytes"])]
            _tail(axes, row["curve_ms"], row["carrier"], f"C{carriers.index(row['carrier'])}")
            axes.set_title(f"{row['bytes']} B, {rate_hz} Hz, {row['load']} cores loaded", fontsize=9)
            axes.set_xlabel("latency, ms")
            axes.grid(True, which="both", alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("share that is slower")
    grid[0][0].legend(fontsize=7)
    figure.tight_layout()
    return figure


def _vehicles(rows: list[dict[str, Any]]) -> Figure:
    figure, (over, tails) = plt.subplots(1, 2, figsize=(11, 4))
    for key in ("p50", "p99", "max"):
        over.plot([row["vehicles"] for row in rows], [row["step_ms"][key] for row in rows], marker="o", label=key)
    over.set(xlabel="vehicles in sight", ylabel="step, ms", title="The optimize process at its rate", ylim=(0.0, None))
    for row in rows:
        _tail(tails, row["curve_ms"], f"{row['vehicles']} vehicles (steal {row['steal_percent']:.2g} %)")
    tails.set(xlabel="step, ms", ylabel="share that is slower")
    for axes in (over, tails):
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(fontsize=8)
    return figure


def _optimizer(rows: list[dict[str, Any]]) -> Figure:
    figure, (over_frames, over_vehicles) = plt.subplots(1, 2, figsize=(11, 4))
    most = max(row["vehicles"] for row in rows)
    for contender in dict.fromkeys(row["contender"] for row in rows):
        own = [row for row in rows if row["contender"] == contender]
        vehicles = [row["vehicles"] for row in own]
        (line,) = over_vehicles.semilogy(vehicles, [row["p50_us"] / 1e3 for row in own], marker="o", label=contender)
        p99 = [row["p99_us"] / 1e3 for row in own]
        over_vehicles.semilogy(vehicles, p99, marker=".", linestyle=":", color=line.get_color())
        for row in own:
            if row["vehicles"] == most:
                times_ms = np.array(row["over_frames_us"]) / 1e3
                frames = (np.arange(len(times_ms)) + 0.5) * row["frames"] / len(times_ms)
                over_frames.semilogy(frames, times_ms, color=line.get_color(), label=contender)
    over_frames.set(xlabel="frame", ylabel="median of a stretch, ms", title=f"An update over frames, {most} vehicles")
    over_vehicles.set(xlabel="vehicles in sight", ylabel="ms", title="p50, and p99 dotted, over vehicles")
    for axes in (over_frames, over_vehicles):
        axes.grid(True, which="both", alpha=0.3)
    over_frames.legend(fontsize=7)
    return figure
