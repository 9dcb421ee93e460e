"""Draws Fig. 4 of the paper for one frame: image, boundary and road cells, lanes without and with ENet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from birdslam.lanes.amodal.lanes import BOUNDARY, ROAD, LanesConfig, LaneView

TITLES = (
    "lane boundary, observed",
    "road, observed",
    "lanes without ENet",
    "lane boundary, completed",
    "road, completed",
    "lanes",
)
HIDDEN_ALPHA = 0.25  # of cells behind lanes


def draw_lanes(title: str, image: NDArray[np.uint8], view: LaneView, config: LanesConfig, path: Path) -> None:
    """Draws `image`, (H, W) grey or (H, W, 3) BGR, above the bird's-eye grids (x up, y left)."""
    # Imported here because matplotlib takes half a second
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width = 11.0
    above = width * image.shape[0] / image.shape[1]
    figure = Figure(figsize=(width, above + 2.9), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.add_gridspec(2, len(TITLES), height_ratios=(above, 2.4))
    top = figure.add_subplot(rows[0, :])
    top.imshow(image if image.ndim == 2 else image[:, :, ::-1], cmap="gray")
    top.set_axis_off()
    top.set_title(title)
    extent = (config.half_width_m, -config.half_width_m, -config.behind_m, config.ahead_m)
    seen, completed = view.seen, view.completed
    grids = [seen[BOUNDARY], seen[ROAD], seen[BOUNDARY], completed[BOUNDARY], completed[ROAD], completed[BOUNDARY]]
    for k, (name, grid) in enumerate(zip(TITLES, grids, strict=True)):
        axes = figure.add_subplot(rows[1, k])
        lanes = {2: view.lanes_seen, 5: view.lanes}.get(k)
        alpha = 1.0 if lanes is None else HIDDEN_ALPHA
        # Column 0 of a grid is at the right, row 0 at the rear
        axes.imshow(grid[:, ::-1], origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=1.0, alpha=alpha)
        for j, cloud in enumerate(lanes or ()):
            axes.scatter(cloud[:, 1], cloud[:, 0], s=4, color=f"C{j % 10}")
        axes.plot(0.0, 0.0, "^", color="#35a0d0")
        axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
    figure.supxlabel("left of the ego (m)", fontsize=9)
    figure.savefig(path)
