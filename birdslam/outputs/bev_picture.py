"""Draws a drive from above as a PNG: the ego trajectory, the tracks and the map, in metres.

Points are in world of the first epoch (x forward, y left). On paper, x points up and y points left.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.types import FIRST_PERSON, PEOPLE

DPI = 160
LONG_SIDE_IN = 9.0  # of the map
PANEL_IN = 2.9
MARGIN_M = 6.0
MIN_TRACK_FRAMES = 5  # a shorter track is mostly a false alarm
MIN_MOVING_SPEED_MPS, MIN_MOVING_DISTANCE_M, DEPTH_CREEP_RATIO = 1.5, 3.0, 0.15  # see Track.is_moving
MIN_PERSON_SPEED_MPS, MIN_PERSON_DISTANCE_M = 0.5, 1.0
MAX_LISTED_TRACKS = 22
LABEL_CHARACTERS = 12
EGO_LENGTH_M, EGO_WIDTH_M, EGO_FRONT_M = 4.2, 1.8, 1.7  # the ego symbol; its front is EGO_FRONT_M ahead of the camera

PAPER, INK, FAINT, GRID = "#12161d", "#e8ebf0", "#8b95a5", "#232a35"
EGO, LANE, LANDMARK, BREAK, SAMPLE = "#35d0ff", "#f3ecd2", "#5f6b7c", "#ff5d5d", "#c3cad6"
LINE = "#ffb84d"


@dataclass(frozen=True)
class Track:
    """One road user: poses (N, 3) in world as x_m, y_m, yaw_rad, latest last, and the median speed."""

    vehicle: int
    label: str
    length_m: float
    width_m: float
    poses: Floats
    frames: int
    speed_mps: float
    farthest_m: float  # maximum distance from the ego

    @property
    def is_moving(self) -> bool:
        """Whether both its speed and its displacement exceed their limits.

        The depth error of a parked car shrinks as the ego approaches. Its position therefore drifts by a share of the
        distance.
        """
        third = max(len(self.poses) // 3, 1)
        displacement = np.median(self.poses[-third:, :2], axis=0) - np.median(self.poses[:third, :2], axis=0)
        is_person = self.label in PEOPLE
        min_speed_mps = MIN_PERSON_SPEED_MPS if is_person else MIN_MOVING_SPEED_MPS
        min_distance_m = MIN_PERSON_DISTANCE_M if is_person else MIN_MOVING_DISTANCE_M
        max_creep_m = min_distance_m + DEPTH_CREEP_RATIO * self.farthest_m
        return self.speed_mps > min_speed_mps and float(np.hypot(*displacement)) > max_creep_m


@dataclass(frozen=True)
class Scene:
    """The content of the picture: ego poses (N, 3), map points (M, 2), starts of epochs (K, 2)."""

    name: str
    ego: Floats
    breaks: Floats
    tracks: list[Track]
    lanes: Floats
    landmarks: Floats
    path_m: float
    frames: int
    track_count: int
    sigma_rel: float = 0.0  # 1-sigma of all lengths, due to camera height and lens
    lines: tuple[Floats, ...] = ()  # polylines (N, 2) of lane lines and road edges


def draw(scene: Scene, path: Path) -> None:
    """Writes the picture."""
    # Imported here because matplotlib takes half a second, which would delay the start of a node.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tracks = [track for track in scene.tracks if track.frames >= MIN_TRACK_FRAMES]
    x_min, x_max, y_min, y_max = _extent(scene, tracks)
    across, along = x_max - x_min, y_max - y_min
    map_in = np.array([across, along]) * LONG_SIDE_IN / max(across, along)
    left_in, bottom_in, top_in = 0.75, 0.6, 0.85
    width_in, height_in = map_in[0] + left_in + PANEL_IN + 0.3, map_in[1] + bottom_in + top_in
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (left_in / width_in, bottom_in / height_in, map_in[0] / width_in, map_in[1] / height_in), facecolor=PAPER
    )
    axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal")
    axes.set_xlabel("right of the start (m)", color=FAINT)
    axes.set_ylabel("ahead of the start (m)", color=FAINT)
    axes.tick_params(colors=FAINT, labelsize=8, length=3)
    axes.grid(color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(GRID)

    _draw_map(axes, scene)
    for track in tracks:
        _draw_track(axes, track, scene.ego)
    _draw_ego(axes, scene)
    _draw_scale(axes, across)
    figure.text(left_in / width_in, 1.0 - 0.36 / height_in, scene.name, color=INK, fontsize=15, weight="bold")
    figure.text(
        left_in / width_in,
        1.0 - 0.62 / height_in,
        f"{scene.path_m:.1f} m in {scene.frames} frames, {scene.track_count} tracks"
        + (f"; all lengths +- {scene.sigma_rel:.0%}" if scene.sigma_rel >= 0.005 else ""),
        color=FAINT,
        fontsize=9.5,
    )
    panel_left = 1.0 - PANEL_IN / width_in
    top = 1.0 - top_in / height_in
    _draw_panel(figure, scene, tracks, (panel_left, top), height_in - top_in)
    figure.savefig(path, dpi=DPI, facecolor=PAPER)


def _paper(points: Floats) -> Floats:
    """Converts points from world (N, >= 2) to paper (N, 2): x up, y left."""
    return np.column_stack([-points[:, 1], points[:, 0]])


def _extent(scene: Scene, tracks: list[Track]) -> tuple[float, float, float, float]:
    """Returns limits on paper in metres that contain all but stray points, with a bounded aspect ratio."""
    parts = [_paper(scene.ego), *(_paper(track.poses) for track in tracks)]
    for points in (scene.lanes, scene.landmarks):
        if len(points):
            low, high = np.percentile(points, [1.0, 99.0], axis=0)
            parts.append(_paper(np.array([low, high])))
    everything = np.vstack([np.zeros((1, 2)), *parts])
    low, high = everything.min(axis=0) - MARGIN_M, everything.max(axis=0) + MARGIN_M
    centre, size = (low + high) / 2.0, high - low
    size = np.maximum(size, [max(30.0, 0.45 * size[1]), max(30.0, 0.45 * size[0])])
    return (
        float(centre[0] - size[0] / 2.0),
        float(centre[0] + size[0] / 2.0),
        float(centre[1] - size[1] / 2.0),
        float(centre[1] + size[1] / 2.0),
    )


def number_of(vehicle: int) -> int:
    """Returns the number that pictures show; the numbers of people start at 0."""
    return vehicle & (FIRST_PERSON - 1)


def colour_of(vehicle: int) -> tuple[float, float, float]:
    """Returns a colour for the id; consecutive ids have distant hues."""
    return colorsys.hsv_to_rgb((0.02 + vehicle * 0.6180339887) % 1.0, 0.62, 1.0)


def _footprint(pose: Floats, length_m: float, width_m: float, ahead_m: float) -> Floats:
    """Returns the outline (5, 2) on paper of a vehicle symbol whose front is `ahead_m` ahead of its pose."""
    half, back = width_m / 2.0, ahead_m - length_m
    shoulder = ahead_m - 0.22 * length_m
    outline = np.array([[back, half], [shoulder, half], [ahead_m, 0.0], [shoulder, -half], [back, -half]])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return _paper(outline @ np.array([[c, s], [-s, c]]) + pose[:2])


def _draw_map(axes: Any, scene: Scene) -> None:
    for points, colour, size, alpha in ((scene.landmarks, LANDMARK, 3.0, 0.8), (scene.lanes, LANE, 2.2, 0.75)):
        if len(points):
            axes.scatter(*_paper(points).T, s=size, color=colour, alpha=alpha, linewidths=0)
    for line in scene.lines:
        axes.plot(*_paper(line).T, color=LINE, linewidth=1.1, alpha=0.9)


def _draw_track(axes: Any, track: Track, ego: Floats) -> None:
    from matplotlib.patches import Polygon

    colour = colour_of(track.vehicle)
    path = _paper(track.poses)
    if track.is_moving:
        axes.plot(*path.T, color=colour, linewidth=3.4, alpha=0.75, solid_capstyle="round")
    else:
        axes.plot(*path.T, color=colour, linewidth=0.7, alpha=0.35)
    last = track.poses[-1]
    outline = _footprint(last, track.length_m, track.width_m, track.length_m / 2.0)
    face = (*colour, 0.9) if track.is_moving else (*colour, 0.12)
    axes.add_patch(Polygon(outline, closed=True, facecolor=face, edgecolor=colour, linewidth=1.1, zorder=4))
    # The label is on the side away from the ego trajectory, so that it does not cover it.
    x_m, y_m, yaw_rad = ego[np.argmin(np.hypot(*(ego[:, :2] - last[:2]).T))]
    left = np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
    away = left if left @ (last[:2] - [x_m, y_m]) >= 0.0 else -left
    half_m = float(np.abs((outline - path[-1]) @ _paper(away[None])[0]).max())
    axes.annotate(
        f"{number_of(track.vehicle)}",
        _paper((last[:2] + half_m * away)[None])[0],
        xytext=tuple(8.0 * _paper(away[None])[0]),
        textcoords="offset points",
        ha="center",
        va="center",
        color=colour,
        fontsize=8.5 if track.is_moving else 7,
        weight="bold" if track.is_moving else "normal",
        clip_on=True,
        zorder=6,
    )


def _draw_ego(axes: Any, scene: Scene) -> None:
    from matplotlib.patches import Polygon

    if not len(scene.ego):
        return
    path = _paper(scene.ego)
    axes.plot(*path.T, color=EGO, linewidth=6.0, alpha=0.18, solid_capstyle="round", zorder=3)
    axes.plot(*path.T, color=EGO, linewidth=1.8, solid_capstyle="round", zorder=5)
    axes.plot(*path[0], "o", color=PAPER, markeredgecolor=EGO, markersize=6, zorder=5)
    outline = _footprint(scene.ego[-1], EGO_LENGTH_M, EGO_WIDTH_M, EGO_FRONT_M)
    axes.add_patch(Polygon(outline, closed=True, facecolor=EGO, edgecolor=PAPER, linewidth=0.8, zorder=7))
    if len(scene.breaks):
        axes.plot(*_paper(scene.breaks).T, "X", color=BREAK, markeredgecolor=PAPER, markersize=9, zorder=8)


def _draw_scale(axes: Any, across_m: float) -> None:
    """Draws a scale bar of a round length at the lower right."""
    magnitude = 10.0 ** np.floor(np.log10(across_m / 4.0))
    length_m = max(step * magnitude for step in (1, 2, 5) if step * magnitude <= across_m / 4.0)
    x_max, y_min = axes.get_xlim()[1], axes.get_ylim()[0]
    tall = axes.get_ylim()[1] - y_min
    right, bottom = x_max - 0.04 * across_m, y_min + 0.025 * tall
    axes.plot([right - length_m, right], [bottom, bottom], color=INK, linewidth=2.5, solid_capstyle="butt", zorder=9)
    axes.annotate(
        f"{length_m:g} m",
        (right - length_m / 2.0, bottom),
        xytext=(0, 4),
        textcoords="offset points",
        ha="center",
        color=INK,
        fontsize=8.5,
        zorder=9,
    )


def _draw_panel(figure: Any, scene: Scene, tracks: list[Track], corner: tuple[float, float], room_in: float) -> None:
    """Draws the legend and a list of the longest tracks."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def mark(colour: str, marker: str, label: str) -> Line2D:
        return Line2D(
            [], [], color=colour, linestyle="", marker=marker, markersize=4 if marker == "o" else 8, label=label
        )

    handles: list[Any] = [Line2D([], [], color=EGO, linewidth=2.5, label="ego, from ring to arrow")]
    if any(track.is_moving for track in tracks):
        handles.append(Patch(facecolor=SAMPLE, edgecolor=SAMPLE, label="moving, last position"))
    if not all(track.is_moving for track in tracks):
        handles.append(Patch(facecolor=f"{SAMPLE}26", edgecolor=SAMPLE, label="stationary, last position"))
    if scene.lines:
        handles.append(Line2D([], [], color=LINE, linewidth=1.5, label="lane line or road edge, tracked"))
    if len(scene.lanes):
        handles.append(mark(LANE, "o", "lane point"))
    if len(scene.landmarks):
        handles.append(mark(LANDMARK, "o", "road landmark"))
    if len(scene.breaks):
        handles.append(mark(BREAK, "X", "new epoch, motion unknown"))
    legend = figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=corner,
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        borderaxespad=0.0,
        handlelength=1.8,
        labelspacing=0.7,
    )
    legend.set_in_layout(False)
    line_in = 0.185
    used_in = 0.29 * len(handles) + 0.25
    room = int((room_in - used_in - 0.9) / line_in) - 2
    listed = sorted(tracks, key=lambda track: (not track.is_moving, -track.frames))[
        : max(min(MAX_LISTED_TRACKS, room), 0)
    ]
    if not listed:
        return
    height_in = figure.get_size_inches()[1]

    def write(line: int, text: str, colour: Any) -> None:
        y = corner[1] - (used_in + line * line_in) / height_in
        figure.text(corner[0], y, text, color=colour, fontsize=8, family="monospace", va="top")

    write(0, f"{'id':>4}  {'class':<{LABEL_CHARACTERS}} frames   m/s", FAINT)
    for line, track in enumerate(sorted(listed, key=lambda track: track.vehicle), start=1):
        speed = f"{track.speed_mps:5.1f}" if track.is_moving else "    -"
        name = track.label[:LABEL_CHARACTERS]
        write(
            line,
            f"{number_of(track.vehicle):>4}  {name:<{LABEL_CHARACTERS}} {track.frames:>6} {speed}",
            colour_of(track.vehicle),
        )
    hidden = scene.track_count - len(listed)  # includes short tracks
    if hidden > 0:
        write(len(listed) + 1, f"      and {hidden} more", FAINT)
