"""Amodal lanes (paper, Sec. 3.2): the road accumulated over many frames and completed where it was occluded.

Points of road and lane boundaries fill two occupancy grids in the newest ego frame; a network (ENet) completes them,
and the Hough transform segregates the boundary's cells into lanes with persistent ids.
A grid is (rows, columns) over x (row 0: `behind_m` behind the ego) and y (column 0: `half_width_m` to the right).
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import msgspec
import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.lane_ids import LaneCloud, LaneIds
from birdslam.perception import Segmentation

Points = Floats32  # (N, 1, 2), as OpenCV takes them: x and y
Grids = Floats32

ROAD, BOUNDARY = 0, 1  # the channels of a pair of grids


class LanesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grids of Sec. 3.2 and the extraction of lanes from them."""

    window_frames: int = 45  # segmented frames; 40 to 50 in the paper
    step_m: float = 0.4  # distance travelled between two of them
    step_rad: float = 0.05  # or rotation
    depth_m: float = 15.0  # max. distance of the points; a car's camera does not see the paper's 5 m
    lattice_m: float = 0.1  # lateral sampling, finer than a painted line
    behind_m: float = 8.0  # of the grid
    ahead_m: float = 24.0  # of the grid
    half_width_m: float = 16.0  # of the grid
    cell_m: float = 0.25  # side of a cell
    full_count: int = 2  # observations of a fully occupied cell
    neighbourhood_cells: int = 3  # m of the m x m cells around a cell
    neighbourhood_least: int = 3  # min. foreground cells among m x m, itself included
    least_occupancy: float = 0.5  # min. occupancy of a completed cell
    # Hough
    line_votes: int = 10  # min. cells on a line (Hough transform)
    line_least_m: float = 2.0  # shorter pieces are dropped
    line_gap_m: float = 4.0  # max. gap of a dashed line
    same_line_rad: float = 0.2  # max. angle between pieces of one lane
    bend_rad: float = 0.6  # max. angle between adjacent pieces of one lane
    same_line_m: float = 0.5  # max. distance of a piece from the other's line
    cell_reach_m: float = 1.0  # max. distance of a cell from its nearest piece
    least_cells: int = 8  # min. of a lane, and of its part that frames saw
    # Ids
    same_lane_m: float = 0.75  # max. distance of a lane from its known points
    remembered_m: float = 40.0  # radius around the ego in which lanes are stored

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of a grid."""
        return round((self.behind_m + self.ahead_m) / self.cell_m), round(2.0 * self.half_width_m / self.cell_m)


class Completion(Protocol):
    """A network that completes a pair of grids: (2, rows, columns) of 0..1 to the same."""

    def __call__(self, grids: Grids) -> Grids: ...


class AmodalLanes:
    """`add` each segmented frame, then call `lanes` for any later ego pose. Deterministic."""

    def __init__(
        self, config: LanesConfig, complete: Completion | None = None, yield_core: Callable[[], object] = lambda: None
    ) -> None:
        """`yield_core` is called between the parts of `lanes` (lane_mapper.LaneHead)."""
        self.config = config
        self.complete = complete
        self._yield_core = yield_core
        self.completion_failed = False  # in the last run: its output was not finite and is not used
        self._frames: deque[tuple[SE2, tuple[Points, Points]]] = deque(maxlen=config.window_frames)
        self.ids = LaneIds(config.same_lane_m, config.cell_m, config.remembered_m)

    def has_moved(self, T_world_ego: SE2) -> bool:
        """Whether the ego has moved since the last frame that was added."""
        if not self._frames:
            return True
        moved = self._frames[-1][0].between(T_world_ego)
        return math.hypot(moved.x_m, moved.y_m) >= self.config.step_m or abs(moved.yaw_rad) >= self.config.step_rad

    def add(self, T_world_ego: SE2, road_m: Floats, boundary_m: Floats) -> None:
        """Adds a frame's points of the road (N, 2) and of lane boundaries (M, 2) in its ego."""
        near = (points[points[:, 0] < self.config.depth_m] for points in (road_m, boundary_m))
        road, boundary = (points.astype(np.float32)[:, None] for points in near)
        self._frames.append((T_world_ego, (road, boundary)))

    def clear(self) -> None:
        """Drops points and lanes after a restart of the world frame."""
        self._frames.clear()
        self.ids.clear()

    def lanes(self, T_world_ego: SE2) -> tuple[LaneCloud, ...]:
        """The lanes around the ego at `T_world_ego`, each with its id."""
        grids = self.grids(T_world_ego)
        self._yield_core()
        completed = None if self.complete is None else self.complete(grids)
        self._yield_core()
        self.completion_failed = completed is not None and not np.isfinite(completed).all()
        if completed is None or self.completion_failed:
            return self.ids.assign(T_world_ego, segregate(grids, self.config))
        clouds = segregate(np.maximum(grids, completed), self.config)  # completion only adds
        seen = cv2.dilate(grids[BOUNDARY], np.ones((5, 5), dtype=np.uint8)) > 0.0
        known = [cloud for cloud in clouds if np.sum(seen[_cells_of(cloud, self.config)]) >= self.config.least_cells]
        return self.ids.assign(T_world_ego, known)

    def grids(self, T_world_ego: SE2) -> Grids:
        """(2, rows, columns) occupancy of 0..1 of road and lane boundary, accumulated and filtered."""
        config = self.config
        counts = np.stack([self._counts(T_world_ego, channel) for channel in (ROAD, BOUNDARY)])
        occupancy = np.minimum(counts / config.full_count, 1.0).astype(np.float32)
        for channel in (ROAD, BOUNDARY):
            occupancy[channel] *= dense(counts[channel] > 0, config)
        return occupancy

    def _counts(self, T_world_ego: SE2, channel: int) -> Grids:
        """(rows, columns) observations of a channel in each cell around the ego at `T_world_ego`."""
        T_ego_world = T_world_ego.inverse()
        clouds = [in_cells(seen[channel], T_ego_world @ T, self.config) for T, seen in self._frames]
        return count_cells(clouds, self.config)


@dataclass(frozen=True)
class LaneView:
    """The grids and lanes around one ego pose, for a picture (paper, Fig. 4). Grids: (2, rows, columns) of 0..1."""

    seen: Grids
    completed: Grids  # `seen` and what the network added
    lanes_seen: list[Floats]  # clouds (N, 2) in ego without the network
    lanes: list[Floats]  # with the network: the amodal lanes


def lane_view(amodal: AmodalLanes, T_world_ego: SE2) -> LaneView:
    """The intermediate results of `AmodalLanes.lanes`. Changes no state: no lane gets an id."""
    seen = amodal.grids(T_world_ego)
    added = seen if amodal.complete is None else amodal.complete(seen)
    completed = np.maximum(seen, added) if np.isfinite(added).all() else seen
    return LaneView(seen, completed, segregate(seen, amodal.config), segregate(completed, amodal.config))


def points_of(
    segmentation: Segmentation, camera: Camera, ground: GroundPlane, boxes_px: Floats, config: LanesConfig
) -> tuple[Floats, Floats]:
    """Points of road (N, 2) and of lane boundaries (M, 2) in the ego of the segmentation's frame, up to `depth_m`.

    The masks are sampled on a regular grid on the road (the inverse of Eq. 1), for a uniform density. Pixels in
    `boxes_px` (B, 4) are left out, since vehicles occlude the road.
    """
    x_m, y_m = _road_grid(config)
    # bev.ego_to_pixel for a grid: each camera coordinate is a sum of a row's and a column's part
    ahead, left, up = ground.R_ego_cam
    right, down, depth = (
        (a * x_m - c * ground.height_m)[:, None] + b * y_m for a, b, c in zip(ahead, left, up, strict=True)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        u = camera.fx_px * (right / depth) + camera.cx_px
        v = camera.fy_px * (down / depth) + camera.cy_px
    inside = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px) & (depth > 0.0)
    row, column = inside.nonzero()
    at = v[inside].astype(np.int64), u[inside].astype(np.int64)
    points = np.stack([x_m[row], y_m[column]], axis=-1)
    road, lane = (points[without_boxes(mask, boxes_px)[at]] for mask in (segmentation.road, segmentation.lane))
    return road, lane


def without_boxes(mask: Bools, boxes_px: Floats) -> Bools:
    """A copy of a mask (H, W), False in the pixels that the boxes (B, 4) cover."""
    out = mask.copy()
    first = np.maximum(np.ceil(boxes_px[:, :2]), 0.0).astype(np.int64)
    past = np.maximum(np.floor(boxes_px[:, 2:]) + 1.0, 0.0).astype(np.int64)
    for (u1, v1), (u2, v2) in zip(first.tolist(), past.tolist(), strict=True):
        out[v1:v2, u1:u2] = False
    return out


@functools.lru_cache(maxsize=4)
def _road_grid(config: LanesConfig) -> tuple[Floats, Floats]:
    """x (N,) of the rows and y (M,) of the columns at which masks are sampled."""
    x_m = np.arange(0.5 * config.cell_m, config.depth_m, config.cell_m)
    y_m = np.arange(-config.half_width_m, config.half_width_m, config.lattice_m)
    return x_m, y_m


def in_cells(points_m: Points, T_ego_then: SE2, config: LanesConfig) -> Points:
    """Points of an earlier ego frame as fractional (row, column) of the grid."""
    if not len(points_m):  # cv2.transform rejects empty arrays
        return points_m
    origin_m = _origin_m(config) + np.array([T_ego_then.x_m, T_ego_then.y_m])
    to_cells = np.column_stack([T_ego_then.rotation(), origin_m]) / config.cell_m
    return np.asarray(cv2.transform(points_m, to_cells), np.float32)


def count_cells(clouds: Sequence[Points], config: LanesConfig) -> Grids:
    """(rows, columns) number of points of the clouds (see `in_cells`) in each cell."""
    rows, columns = config.shape
    points = np.concatenate([np.zeros((0, 1, 2), np.float32), *clouds])
    if not len(points):
        return np.zeros((rows, columns), np.float32)
    return np.asarray(cv2.calcHist([points], [0, 1], None, [rows, columns], [0, rows, 0, columns]), np.float32)


def _cells_of(centres_m: Floats, config: LanesConfig) -> tuple[Ints, Ints]:
    """Rows and columns of cells, given their centres (N, 2) in ego."""
    row, column = np.floor((centres_m + _origin_m(config)) / config.cell_m).astype(np.int64).T
    return row, column


def _origin_m(config: LanesConfig) -> Floats:
    """(2,) position of the ego from the grid's first corner."""
    return np.array([config.behind_m, config.half_width_m])


def dense(cells: Bools, config: LanesConfig) -> Bools:
    """The cells with at least `neighbourhood_least` foreground cells in their m x m neighbourhood (Sec. 3.2)."""
    m = config.neighbourhood_cells
    counts = cv2.boxFilter(cells.astype(np.float32), -1, (m, m), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cells & (counts > config.neighbourhood_least - 0.5))


def cell_centres_m(cells: Bools, config: LanesConfig) -> Floats:
    """(N, 2) centres, in ego, of the cells that are set."""
    out: Floats = (np.argwhere(cells) + 0.5) * config.cell_m - _origin_m(config)
    return out


def segregate(grids: Grids, config: LanesConfig) -> list[Floats]:
    """The boundary's cells as one cloud (N, 2) in ego for each lane, from right to left.

    Opening the road removes specks, closing fills holes; a boundary lies on the road or beside it. Boundary lines are
    one cell wide, so they are closed only: `dense` has removed their specks. Line segments of the Hough transform that
    continue each other are one lane, straight or curved.
    """
    kernel = np.ones((3, 3), dtype=np.uint8)
    road, boundary = (np.asarray(grid >= config.least_occupancy).astype(np.uint8) for grid in grids)
    road = np.asarray(cv2.morphologyEx(cv2.morphologyEx(road, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel))
    beside = cv2.dilate(road, np.ones((7, 7), dtype=np.uint8)) > 0
    on_road = (cv2.morphologyEx(boundary, cv2.MORPH_CLOSE, kernel) > 0) & beside
    pieces = _line_pieces_m(on_road, config)
    cells = cell_centres_m(on_road, config)
    if not len(pieces) or not len(cells):
        return []
    along, aside_m = _along_and_aside_m(pieces, cells)
    distance = np.hypot(aside_m, np.maximum(np.abs(along) - 0.5 * _lengths_m(pieces), 0.0))  # (cells, pieces)
    piece = np.where(distance.min(axis=1) < config.cell_reach_m, distance.argmin(axis=1), -1)
    lane_of_piece = _merge_pieces(pieces, _adjacent(piece, on_road, len(pieces)), config)
    lane = np.where(piece >= 0, lane_of_piece[piece], -1)
    clouds = [cells[lane == k] for k in range(lane_of_piece.max() + 1)]
    clouds = [cloud for cloud in clouds if len(cloud) >= config.least_cells]
    return sorted(clouds, key=lambda cloud: float(np.median(cloud[:, 1])))


def _line_pieces_m(boundary: Bools, config: LanesConfig) -> Floats:
    """(P, 2, 2) ends, in ego, of line segments by the Hough transform of Sec. 3.2."""
    lines = cv2.HoughLinesP(
        boundary.astype(np.uint8) * np.uint8(255),
        rho=1.0,
        theta=math.pi / 120.0,
        threshold=config.line_votes,
        minLineLength=config.line_least_m / config.cell_m,
        maxLineGap=config.line_gap_m / config.cell_m,
    )
    if lines is None:
        return np.zeros((0, 2, 2))
    column_row = np.asarray(lines, dtype=np.float64).reshape(-1, 2, 2)
    out: Floats = (column_row[..., ::-1] + 0.5) * config.cell_m - _origin_m(config)
    return out


def _along_and_aside_m(pieces: Floats, points: Floats) -> tuple[Floats, Floats]:
    """(N, P) each: points (N, 2) relative to the middles of segments (P, 2, 2), along and across."""
    direction = pieces[:, 1] - pieces[:, 0]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None]
    gap = points[:, None, :] - pieces.mean(axis=1)[None]
    return ((gap * direction).sum(axis=2), gap[..., 0] * direction[:, 1] - gap[..., 1] * direction[:, 0])


def _lengths_m(pieces: Floats) -> Floats:
    out: Floats = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    return out


def _adjacent(piece: Ints, cells: Bools, count: int) -> Bools:
    """(P, P) whether two segments have adjacent cells; `piece` is the segment of each set cell, or -1."""
    grid = np.full(np.add(cells.shape, 2), -1)
    grid[1:-1, 1:-1][cells] = piece
    out = np.zeros((count, count), dtype=np.bool_)
    here = grid[1:-1, 1:-1]
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        there = grid[1 + row :, 1 + column :][: here.shape[0], : here.shape[1]]
        both = (here >= 0) & (there >= 0)
        out[here[both], there[both]] = True
    return out | out.T


def _merge_pieces(pieces: Floats, adjacent: Bools, config: LanesConfig) -> Ints:
    """(P,) the lane of each segment. Joins adjacent segments of a curve, and a segment that ends on the other's line.

    The gap along the line may be that of a dashed line. The limit of the angle keeps stop lines apart.
    """
    count = len(pieces)
    vector = pieces[:, 1] - pieces[:, 0]
    yaw = np.arctan2(vector[:, 1], vector[:, 0])
    turn = np.abs((yaw[:, None] - yaw[None] + 0.5 * math.pi) % math.pi - 0.5 * math.pi)
    along, aside_m = _along_and_aside_m(pieces, pieces.reshape(-1, 2))
    past = np.abs(along) - 0.5 * _lengths_m(pieces)
    meets = (np.abs(aside_m) < config.same_line_m) & (past < config.line_gap_m)
    joined = meets.reshape(count, 2, count).any(axis=1) & (turn < config.same_line_rad)
    joined |= adjacent & (turn < config.bend_rad)
    from scipy.sparse import coo_array  # loaded by lane_ids.py's import of scipy.spatial
    from scipy.sparse.csgraph import connected_components

    first, second = np.nonzero(joined)
    _, lane = connected_components(coo_array((np.ones(len(first)), (first, second)), (count, count)), directed=False)
    return np.asarray(lane, dtype=np.int64)
