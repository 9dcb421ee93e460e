"""A benchmark sequence from above, estimates over truth, and the runtime of each update, as PNGs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.bench.tracking.benchmark import Truth
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2

MIN_FRAMES = 10  # vehicles matched in fewer are left out
INK, TRUTH_ALPHA = "#20242c", 0.35


def draw_sequence(title: str, truth: Truth, result: Trajectories, path: Path) -> None:
    """The ego and every vehicle: thick and pale the truth, thin the estimate; metres, forward up."""
    # Here, since matplotlib takes half a second to import
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.0), dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for k, (label, poses) in enumerate(sorted(truth.vehicles.items())):
        found = truth.found(label, result)
        if len(found) >= MIN_FRAMES:
            colour = f"C{k % 10}"
            at = _forward_up(poses)
            axes.plot(*at.T, color=colour, linewidth=5.0, alpha=TRUTH_ALPHA, solid_capstyle="round")
            axes.plot(*_forward_up(found).T, color=colour, linewidth=1.2)
            axes.annotate(str(label), at[-1], color=colour, fontsize=8, xytext=(3, 3), textcoords="offset points")
    axes.plot(*_forward_up(truth.ego).T, color=INK, linewidth=6.0, alpha=TRUTH_ALPHA, label="truth (pale)")
    axes.plot(*_forward_up(result.ego).T, color=INK, linewidth=1.5, label="estimate (thin), ego in black")
    axes.set(title=title, xlabel="right of the start (m)", ylabel="ahead of the start (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(linewidth=0.4)
    axes.legend(fontsize=8)
    figure.savefig(path)


def _forward_up(poses: Mapping[int, SE2]) -> Floats:
    """(N, 2) in the picture: metres to the right, metres ahead."""
    return np.array([[-pose.y_m, pose.x_m] for _, pose in sorted(poses.items())])


def draw_runtime(updates_ms: Mapping[str, Floats], path: Path) -> None:
    """How long each update of the graph took, (frames,) milliseconds for each scenario."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.5), dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, took in updates_ms.items():
        axes.plot(took, linewidth=0.9, label=f"{name}, median {np.median(took):.3f} ms")
    axes.set(xlabel="frame", ylabel="one update (ms)", title="Time of the incremental optimisation")
    axes.set_ylim(bottom=0.0)
    axes.grid(linewidth=0.4)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
