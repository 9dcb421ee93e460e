"""What an update of the graph costs over the number of agents and the length of the window.

    python -m perf agents [--frames N] --output DIR

Up to 30 vehicles are in the joint graph; people beside ten vehicles are filtered outside and get the graph's world
(graph/around/people.py). Each cell is a process of its own (perf/latency/optimizer.py). Writes agents.json, .md, .png.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from birdslam.bench.figures import markdown
from birdslam.bench.simulation.drive import DriveConfig
from birdslam.graph.graph_config import GraphConfig
from birdslam.perf.latency.optimizer import WINDOWS, measure, summary, write_log
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import Ledger

label = "the pose graph's update over agents and the window's length"

VEHICLES, PEOPLE = (0, 10, 20, 30), (20, 50)  # the latter beside ten vehicles: 30 and 60 agents
BESIDE = 10
LIMIT_S = 120.0
SEED = 1


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("agents", label, output="")
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    cases = [*((vehicles, 0) for vehicles in VEHICLES), *((BESIDE, people) for people in PEOPLE)]
    rows: list[dict[str, Any]] = []
    ledger = Ledger(options.output / "agents.json", label, seed=SEED)
    with ledger, tempfile.TemporaryDirectory() as folder:
        for vehicles, people in cases:
            log = Path(folder) / "drive.log"
            write_log(log, DriveConfig(frames=options.frames, vehicles=vehicles, traffic="convoy"), SEED, people)
            for poses in WINDOWS:
                row = measure(f"ours_live of {poses} poses", vehicles, log, LIMIT_S)
                row |= {"people": people, "poses": poses}
                ledger.add(f"{vehicles} vehicles, {people} people, {poses} poses", summary(row), **row)
                rows.append(row)
    (options.output / "agents.md").write_text(_page(rows), encoding="utf-8")
    _draw(rows, options.output / "agents.png")


def _page(rows: list[dict[str, Any]]) -> str:
    lines = [
        "# What an update of the graph costs",
        "",
        "Written by `python -m perf pages --write agents`. One frame from its decoded record to poses, covariances, "
        "closest approaches and hidden road, in ms on one core: p50, p99 without the updates that another process "
        "interrupted, and the most; of the default window, four poses of the ego, the processor's time too, in which "
        "others' load is only what it takes of caches. People beside ten vehicles are "
        "filtered by the front end; the graph gives them its world ([method.md](method.md)).",
        "",
        "![The cost over agents and the length of the window](agents.png)",
        "",
    ]
    columns = {"p50": "p50_us", "p99": "undisturbed_p99_us", "max": "max_us"}
    by_default = columns | {"CPU p50": "cpu_p50_us", "CPU p99": "cpu_p99_us"}
    of_window = {poses: by_default if poses == GraphConfig().ego_nodes else columns for poses in WINDOWS}
    head = ["agents", *(f"{poses} poses: {what}" for poses in WINDOWS for what in of_window[poses])]
    cells: dict[str, list[str]] = {}
    for row in rows:
        name = f"{row['vehicles']} vehicles" + (f", {row['people']} people" if row["people"] else "")
        cells.setdefault(name, [name]).extend(f"{row[key] / 1e3:.2f}" for key in of_window[row["poses"]].values())
    return "\n".join([*lines, markdown(head, [*cells.values()])])


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(8, 4.5))
    for poses in WINDOWS:
        own = [row for row in rows if row["poses"] == poses]
        vehicles = [row for row in own if not row["people"]]
        beside = [row for row in own if row["vehicles"] == BESIDE]
        color = None
        for some, style, name in ((vehicles, "-", "vehicles"), (beside, "--", f"{BESIDE} vehicles, and people")):
            agents = [row["vehicles"] + row["people"] for row in some]
            p50_ms = [row["p50_us"] / 1e3 for row in some]
            (line,) = axes.plot(agents, p50_ms, style, marker="o", color=color, label=f"{poses} poses, {name}")
            color = line.get_color()
    axes.set(xlabel="agents", ylabel="p50 of an update, ms", ylim=(0.0, None), title="Agents and the window's length")
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=90, bbox_inches="tight")
    plt.close(figure)
