"""Writes map.geojson: the lines of a drive as polylines in metres in world of their epoch.

A vertex is the position of the line NODE_AT_M ahead of the ego, where its covariance is least. A line is written when
it ends; memory holds the lines in view and at most MAX_DRAWN vertices of the others.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.keyframe_builder import MIN_EXISTENCE, NODE_AT_M, NODE_EVERY_M
from birdslam.types import NS_PER_S, Estimate, LaneLine

MIN_NODES = 3
MAX_UNSEEN_NS = 3 * NS_PER_S  # then the line ends
MAX_DRAWN = 20_000  # vertices for the picture
MAX_TAIL_M = 30.0  # of a line ahead at the end of a drive


@dataclass
class _Polyline:
    line: int
    epoch: int
    first_ns: int
    T_picture_world: SE2
    last_ns: int = 0
    kinds: dict[str, int] = field(default_factory=dict)
    colours: dict[str, int] = field(default_factory=dict)
    points_m: list[tuple[float, float]] = field(default_factory=list)  # in world
    sigmas_m: list[float] = field(default_factory=list)  # across the line, relative to the ego
    widths_m: list[float | None] = field(default_factory=list)  # of the lane to its right


class LineMap:
    """Writes the lines of consecutive estimates to one file, until `close`."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO = path.open("w", encoding="ascii")
        self._file.write('{"type": "FeatureCollection", "birdslam": {"metres_of": "the world of each epoch"}, ')
        self._file.write('"features": [')
        self._first = True
        self._open: dict[int, _Polyline] = {}
        self._travelled_m = 0.0
        self._last: Estimate | None = None
        self._drawn: list[Floats] = []
        self._drawn_count = 0

    def add(self, estimate: Estimate, T_picture_world: SE2) -> None:
        """Adds the estimate of one frame. `T_picture_world` is the transform from its epoch to the picture."""
        last, self._last = self._last, estimate
        if last is not None and last.epoch != estimate.epoch:
            self._end(list(self._open.values()))
            last = None
        if last is not None:
            step = last.T_world_ego.between(estimate.T_world_ego)
            self._travelled_m += float(np.hypot(step.x_m, step.y_m))
        lanes = estimate.lanes
        if lanes is None or not estimate.valid or (last is not None and self._travelled_m < NODE_EVERY_M):
            return
        self._travelled_m = 0.0
        widths = {lane.left: lane.width_m for lane in lanes.lanes if lane.left is not None}
        for line in lanes.lines:
            if line.existence >= MIN_EXISTENCE and line.seen_from_m < NODE_AT_M < line.seen_to_m:
                self._add_node(estimate, line, widths.get(line.line), T_picture_world)
        self._end([p for p in self._open.values() if estimate.t_source_ns - p.last_ns > MAX_UNSEEN_NS])

    def _add_node(self, estimate: Estimate, line: LaneLine, width_m: float | None, T_picture_world: SE2) -> None:
        new = _Polyline(line.line, estimate.epoch, estimate.t_source_ns, T_picture_world)
        polyline = self._open.setdefault(line.line, new)
        polyline.last_ns = estimate.t_source_ns
        for votes, value in ((polyline.kinds, line.kind.value), (polyline.colours, line.colour.value)):
            votes[value] = votes.get(value, 0) + 1
        _extend(polyline, estimate, line, np.array([NODE_AT_M]), width_m)

    def _end(self, polylines: list[_Polyline]) -> None:
        for polyline in polylines:
            del self._open[polyline.line]
            if len(polyline.points_m) >= MIN_NODES:
                self._file.write(("\n" if self._first else ",\n") + json.dumps(_feature(polyline)))
                self._first = False
                if self._drawn_count < MAX_DRAWN:
                    self._drawn.append(polyline.T_picture_world @ np.array(polyline.points_m))
                    self._drawn_count += len(polyline.points_m)

    def drawn(self) -> list[Floats]:
        """Returns polylines (N, 2) in the frame of the picture, after `close`."""
        return self._drawn

    def close(self) -> None:
        """Writes the lines in view up to MAX_TAIL_M ahead and closes the file."""
        if self._file.closed:
            return
        last = self._last
        if last is not None and last.lanes is not None:
            for line in last.lanes.lines:
                if line.line in self._open:
                    ahead = np.arange(
                        NODE_AT_M + NODE_EVERY_M, min(line.seen_to_m, line.to_m, MAX_TAIL_M), NODE_EVERY_M
                    )
                    _extend(self._open[line.line], last, line, ahead, None)
        self._end(list(self._open.values()))
        self._file.write("\n]}\n")
        self._file.close()


def _extend(polyline: _Polyline, estimate: Estimate, line: LaneLine, x_m: Floats, width_m: float | None) -> None:
    if not len(x_m):
        return
    points = np.column_stack([x_m, [line.y_m(x) for x in x_m.tolist()]])
    polyline.points_m += [(x, y) for x, y in (estimate.T_world_ego @ points).tolist()]
    polyline.sigmas_m += [line.sigma_m(x) for x in x_m.tolist()]
    polyline.widths_m += [width_m] * len(x_m)


def _feature(polyline: _Polyline) -> dict[str, object]:
    widths = [width for width in polyline.widths_m if width is not None]
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": [[round(v, 3) for v in p] for p in polyline.points_m]},
        "properties": {
            "line": polyline.line,
            "epoch": polyline.epoch,
            "kind": max(polyline.kinds, key=lambda kind: polyline.kinds[kind]),
            "colour": max(polyline.colours, key=lambda colour: polyline.colours[colour]),
            "sigma_m": [round(sigma, 3) for sigma in polyline.sigmas_m],
            "lane_right_of_it_m": round(float(np.median(widths)), 2) if widths else None,
            "first_seen_s": round(polyline.first_ns / NS_PER_S, 3),
            "last_seen_s": round(polyline.last_ns / NS_PER_S, 3),
        },
    }
