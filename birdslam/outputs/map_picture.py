"""Draws a place map from above as a PNG: keyframes coloured by drive, loops, lines and points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from birdslam.loops.place_map import PlaceMap

SIDE_IN, DPI = 9.0, 130
MAX_POINT_DISTANCE_M = 30.0  # from the keyframe; farther points are inaccurate
PAPER, INK, FAINT, LOOP = "#12161d", "#e8ebf0", "#5f6b7c", "#ff9d3d"
LINES = {"yellow": "#ffd54a", "edge": "#b08968"}  # INK for others
DRIVES = "#35d0ff", "#7bd88f", "#f3ecd2", "#ff8fa3", "#c39bff"


def draw_map(place_map: PlaceMap, path: Path) -> None:
    """Writes the picture, x up and y left. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIDE_IN, SIDE_IN), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.08, 0.07, 0.88, 0.86), facecolor=PAPER)
    points = [
        (keyframe.T_map_keyframe @ near[:, :2])
        for keyframe in place_map.keyframes
        for near in [
            keyframe.points_m[np.hypot(keyframe.points_m[:, 0], keyframe.points_m[:, 1]) < MAX_POINT_DISTANCE_M]
        ]
    ]
    if points:
        x, y = np.concatenate(points).T
        axes.scatter(-y, x, s=0.6, c=FAINT, linewidths=0, rasterized=True)
    lines = place_map.lines()
    for line in lines:
        colour = LINES.get(line.kind.value) or LINES.get(line.colour.value, INK)
        x, y = line.points_m.T
        axes.plot(-y, x, "--" if line.kind.value == "dashed" else "-", color=colour, linewidth=0.7)
    at = {keyframe.number: keyframe.T_map_keyframe for keyframe in place_map.keyframes}
    drive = {keyframe.number: keyframe.drive for keyframe in place_map.keyframes}
    for link in place_map.links:
        a, b = at[link.from_number], at[link.to_number]
        colour = LOOP if link.loop else DRIVES[drive[link.to_number] % len(DRIVES)]
        axes.plot([-a.y_m, -b.y_m], [a.x_m, b.x_m], color=colour, linewidth=0.8 if link.loop else 1.6)
    for number, T in at.items():
        axes.plot([-T.y_m], [T.x_m], "o", color=DRIVES[drive[number] % len(DRIVES)], markersize=2.5)
    axes.set_aspect("equal")
    axes.tick_params(colors=INK)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
    axes.set_xlabel("to the right, m", color=INK)
    axes.set_ylabel("forward, m", color=INK)
    loops = sum(link.loop for link in place_map.links)
    drives = f"{len(place_map)} keyframes, {place_map.length_m:.0f} m, {place_map.drives} drives"
    title = f"{drives}, {loops} loop links, {len(lines)} lines"
    axes.set_title(title, color=INK, fontsize=11)
    figure.savefig(path, facecolor=PAPER)
