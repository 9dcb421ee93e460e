"""Road and lane lines behind vehicles, judged by what shows once the vehicles have moved on.

A cell of the grids of Sec. 3.2 is hidden in a frame where a vehicle's box covers it and no earlier frame saw it. Later
frames of the same drive see it: their points, brought into the ego of that frame by the odometry, are the truth. The
completion network, morphological closing, and nothing at all are scored on the same cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lanes import (
    BOUNDARY,
    ROAD,
    AmodalLanes,
    Completion,
    LanesConfig,
    LaneView,
    Points,
    cell_centres_m,
    count_cells,
    in_cells,
    lane_view,
    points_of,
)
from birdslam.perception import Segmentation

Grids = Floats32

LATER_LOOKS = 75  # whose points are the truth: at 0.4 m from one to the next the ego has passed by then
MIN_LOOKED = 6.0  # points of later frames in a cell, for it to be known
MAX_SHARE = 0.5  # of them on the road, for a cell of the road; of a line a quarter does: it is narrower than a cell
LINE_SHARE = 0.25
CLOSING_CELLS = 9  # of the morphological closing: 2 m
METHODS = ("seen", "closing", "network")


class HiddenReport(msgspec.Struct, frozen=True, kw_only=True):
    """IoU over the hidden cells that later frames saw, by method; of lines at a tolerance of a cell."""

    drive: str
    frames: int  # with hidden cells that are known later
    cells: int
    road_iou: dict[str, float | None]
    line_iou: dict[str, float | None]


@dataclass
class _Look:
    T_world_ego: SE2
    clouds: tuple[Points, Points, Points]  # of the road, of lines, and of all that was looked at
    view: LaneView
    hidden: Bools


@dataclass(frozen=True)
class Recovered:
    """The look whose hidden road the network recovered best, for a picture."""

    look: int
    view: LaneView
    later: Grids  # (2, rows, columns) what later frames saw


class HiddenCells:
    """Collects the segmented frames of a drive."""

    def __init__(self, camera: Camera, config: LanesConfig, complete: Completion | None) -> None:
        self.camera, self.config = camera, config
        self._amodal = AmodalLanes(config, complete)
        self._centres_m = cell_centres_m(np.ones(config.shape, bool), config)
        self._looks: list[_Look] = []

    def add(
        self,
        T_world_ego: SE2,
        ground: GroundPlane,
        segmentation: Segmentation,
        boxes_px: Floats,
        bonnet_px: Floats | None = None,
    ) -> int:
        """One frame with the boxes (B, 4) of its vehicles; its look's number, -1 where the ego has not moved.

        Nothing is seen below `bonnet_px` (N, 2), the upper edge of the car's own bonnet.
        """
        if not self._amodal.has_moved(T_world_ego):
            return -1
        shown = np.ones_like(segmentation.road)
        everywhere = Segmentation(shown, shown)
        if bonnet_px is not None:
            segmentation, everywhere = segmentation.above(bonnet_px), everywhere.above(bonnet_px)
        road_m, line_m = points_of(segmentation, self.camera, ground, boxes_px, self.config)
        looked_m, _ = points_of(everywhere, self.camera, ground, boxes_px, self.config)
        self._amodal.add(T_world_ego, road_m, line_m)
        view = lane_view(self._amodal, T_world_ego)
        road, line, looked = (points.astype(np.float32)[:, None] for points in (road_m, line_m, looked_m))
        self._looks.append(_Look(T_world_ego, (road, line, looked), view, self._hidden(ground, boxes_px, view.seen)))
        return len(self._looks) - 1

    def _hidden(self, ground: GroundPlane, boxes_px: Floats, seen: Grids) -> Bools:
        """(rows, columns) the cells that a box covers and that nobody has seen yet."""
        px = bev.ego_to_pixel(self.camera, ground, self._centres_m)
        x, y = px.T
        with np.errstate(invalid="ignore"):
            near = (self._centres_m[:, 0] > 0.0) & (self._centres_m[:, 0] < self.config.depth_m)
            covered = np.zeros(len(px), bool)
            for u1, v1, u2, v2 in boxes_px.tolist():
                covered |= (x >= u1) & (x <= u2) & (y >= v1) & (y <= v2)
        out: Bools = (near & covered).reshape(self.config.shape) & (seen.max(axis=0) == 0.0)
        return out

    def _later(self, k: int) -> tuple[Grids, Bools]:
        """What the frames after look `k` saw, in its ego: occupancy (2, rows, columns), and which cells are known."""
        T_ego_world = self._looks[k].T_world_ego.inverse()
        later = self._looks[k + 1 : k + 1 + LATER_LOOKS]
        road, line, looked = (
            count_cells(
                [in_cells(look.clouds[c], T_ego_world @ look.T_world_ego, self.config) for look in later], self.config
            )
            for c in range(3)
        )
        known = looked >= MIN_LOOKED
        share = np.stack([road + line, line]) / np.maximum(looked, 1.0)
        least = np.array([MAX_SHARE, LINE_SHARE])[:, None, None]
        return (known & (share >= least)).astype(np.float32), known

    def report(self, drive: str) -> tuple[HiddenReport, Recovered | None]:
        """All looks, each judged by those after it, and the one that shows most."""
        cells = {name: np.zeros((2, 2), np.int64) for name in METHODS}  # road, line; intersection, union
        frames, known_cells, best, best_gain = 0, 0, None, 0
        for k, look in enumerate(self._looks):
            if not look.hidden.any():
                continue
            later, known = self._later(k)
            judged = look.hidden & known
            if not judged.any():
                continue
            frames, known_cells = frames + 1, known_cells + int(judged.sum())
            kernel = np.ones((CLOSING_CELLS, CLOSING_CELLS))
            closed: Grids = np.stack(
                [np.asarray(cv2.morphologyEx(g, cv2.MORPH_CLOSE, kernel), np.float32) for g in look.view.seen]
            )
            for name, grids in zip(METHODS, (look.view.seen, closed, look.view.completed), strict=True):
                cells[name] += self._overlap(grids, later, judged)
            right = judged & (look.view.completed[ROAD] >= self.config.least_occupancy) & (later[ROAD] > 0.0)
            if int(right.sum()) > best_gain:
                best, best_gain = Recovered(k, look.view, later), int(right.sum())
        road, line = (
            {name: float(c[channel, 0] / c[channel, 1]) if c[channel, 1] else None for name, c in cells.items()}
            for channel in (ROAD, BOUNDARY)
        )
        return HiddenReport(drive=drive, frames=frames, cells=known_cells, road_iou=road, line_iou=line), best

    def _overlap(self, grids: Grids, later: Grids, judged: Bools) -> Ints:
        out = np.zeros((2, 2), np.int64)
        for channel in (ROAD, BOUNDARY):
            found, true = grids[channel] >= self.config.least_occupancy, later[channel] > 0.0
            if channel == BOUNDARY:
                found, true = (cv2.dilate(g.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for g in (found, true))
            out[channel] = np.sum(found & true & judged), np.sum((found | true) & judged)
        return out
