"""Amodal lanes (paper, Sec. 3.2): what many frames saw of the road, completed where something stood in the way.

Near points of road and lane boundaries, gathered over a window of frames with the odometry, fill two occupancy grids in
the ego of the newest frame. Lone cells are dropped, a network (ENet) completes the grids, opening and closing clean
them, and the Hough transform segregates the boundary's cells into lanes, which keep their ids (lane_ids.py).
`AmodalLanes.lanes` takes these steps.

A grid is (rows, columns) over x (row 0 is `behind_m` behind the ego) and y (column 0 is `half_width_m` to the right).
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.mapping.lane_ids import LaneCloud, LaneIds
from birdslam.perception import Segmentation

Floats = NDArray[np.float64]
Points = NDArray[np.float32]  # (N, 1, 2), as OpenCV takes them: x and y
Grids = NDArray[np.float32]
Bools = NDArray[np.bool_]

ROAD, BOUNDARY = 0, 1  # the channels of a pair of grids


class LanesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grids of Sec. 3.2 and what makes a lane of their cells."""

    window_frames: int = 45  # segmented frames; the paper has 40 to 50
    step_m: float = 0.4  # between two of them: a car that stands, or a faster camera, has nothing new to say
    step_rad: float = 0.05  # or a turn by this
    depth_m: float = 15.0  # nearer points are kept; the paper's 5 m end before a car's camera sees the road
    lattice_m: float = 0.1  # sideways: finer than a painted line is wide
    behind_m: float = 8.0  # of the grid
    ahead_m: float = 24.0  # of the grid
    half_width_m: float = 16.0  # of the grid
    cell_m: float = 0.25  # side of a cell
    full_count: int = 2  # sightings that make a cell certain
    neighbourhood_cells: int = 3  # m of the m x m cells around a cell
    neighbourhood_least: int = 3  # foreground cells among m x m, the cell itself included
    least_occupancy: float = 0.5  # of a completed cell
    # Hough
    line_votes: int = 10  # of the Hough transform: cells on a line
    line_least_m: float = 2.0  # shorter pieces are dropped
    line_gap_m: float = 4.0  # a dashed line's
    same_line_rad: float = 0.2  # pieces of one lane differ by less
    bend_rad: float = 0.6  # and where they touch, by less than this
    same_line_m: float = 0.5  # and lie so near to each other's line
    cell_reach_m: float = 1.0  # a cell belongs to the nearest piece, no farther away than this
    least_cells: int = 8  # of a lane, and of it near what was seen: what no frame saw a piece of is a guess
    # Ids
    same_lane_m: float = 0.75  # a lane seen again lies so near to where it was
    remembered_m: float = 40.0  # around the ego

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of a grid."""
        return round((self.behind_m + self.ahead_m) / self.cell_m), round(2.0 * self.half_width_m / self.cell_m)


class Completion(Protocol):
    """The network that completes a pair of grids: (2, rows, columns) of 0..1 in, the same out."""

    def __call__(self, grids: Grids) -> Grids: ...


class AmodalLanes:
    """`add` for each segmented frame, then `lanes` in the ego of any later pose. Deterministic."""

    def __init__(self, config: LanesConfig, complete: Completion | None = None) -> None:
        self.config = config
        self.complete = complete
        self.completion_failed = False  # the last time: its output was not finite, and the grids stayed as seen
        self._frames: deque[tuple[SE2, tuple[Points, Points]]] = deque(maxlen=config.window_frames)
        self.ids = LaneIds(config.same_lane_m, config.cell_m, config.remembered_m)

    def is_news(self, T_world_ego: SE2) -> bool:
        """Whether the ego has moved on since the frame that was added last."""
        if not self._frames:
            return True
        moved = self._frames[-1][0].between(T_world_ego)
        return math.hypot(moved.x_m, moved.y_m) >= self.config.step_m or abs(moved.yaw_rad) >= self.config.step_rad

    def add(self, T_world_ego: SE2, road_m: Floats, boundary_m: Floats) -> None:
        """What one frame saw: points of the road (N, 2) and of lane boundaries (M, 2) in its ego."""
        near = (points[points[:, 0] < self.config.depth_m] for points in (road_m, boundary_m))
        road, boundary = (points.astype(np.float32)[:, None] for points in near)
        self._frames.append((T_world_ego, (road, boundary)))

    def clear(self) -> None:
        """The world frame began anew: what was gathered has no place in it, and no lane keeps its id."""
        self._frames.clear()
        self.ids.forget()

    def lanes(self, T_world_ego: SE2) -> tuple[LaneCloud, ...]:
        """The lanes around the ego at `T_world_ego`, each with its id."""
        grids = self.grids(T_world_ego)
        completed = None if self.complete is None else self.complete(grids)
        self.completion_failed = completed is not None and not np.isfinite(completed).all()
        if completed is None or self.completion_failed:
            return self.ids.name(T_world_ego, segregate(grids, self.config))
        clouds = segregate(np.maximum(grids, completed), self.config)  # what was seen stays
        seen = cv2.dilate(grids[BOUNDARY], np.ones((5, 5), dtype=np.uint8)) > 0.0
        known = [cloud for cloud in clouds if np.sum(seen[_cells_of(cloud, self.config)]) >= self.config.least_cells]
        return self.ids.name(T_world_ego, known)

    def grids(self, T_world_ego: SE2) -> Grids:
        """(2, rows, columns) occupancy of 0..1 of road and lane boundary, gathered and filtered."""
        config = self.config
        counts = np.stack([self._counts(T_world_ego, channel) for channel in (ROAD, BOUNDARY)])
        occupancy = np.minimum(counts / config.full_count, 1.0).astype(np.float32)
        for channel in (ROAD, BOUNDARY):
            occupancy[channel] *= dense(counts[channel] > 0, config)
        return occupancy

    def _counts(self, T_world_ego: SE2, channel: int) -> Grids:
        """(rows, columns) how often the frames saw a channel in each cell around the ego at `T_world_ego`."""
        T_ego_world = T_world_ego.inverse()
        clouds = [in_cells(seen[channel], T_ego_world @ T, self.config) for T, seen in self._frames]
        return count_cells(clouds, self.config)


def points_of(
    segmentation: Segmentation, camera: Camera, ground: GroundPlane, boxes_px: Floats, config: LanesConfig
) -> tuple[Floats, Floats]:
    """Points of road (N, 2) and of lane boundaries (M, 2) in the ego of the segmentation's frame, up to `depth_m`.

    Each point of a lattice on the road is looked up in the masks (the inverse of Eq. 1), so that near and far road has
    as many points. What `boxes_px` (B, 4) cover is left out: a vehicle hides the road there.
    """
    x_m, y_m = _lattice(config)
    # As bev.ego_to_pixel, but that of a lattice each coordinate in the camera is a sum over its rows and columns
    ahead, aside, up = ground.R_ego_cam
    right, down, depth = (
        (a * x_m - c * ground.height_m)[:, None] + b * y_m for a, b, c in zip(ahead, aside, up, strict=True)
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
    """A copy of a mask (H, W) that is False in every pixel (u, v) that a box x1, y1, x2, y2 of (B, 4) covers."""
    out = mask.copy()
    first = np.maximum(np.ceil(boxes_px[:, :2]), 0.0).astype(np.int64)
    past = np.maximum(np.floor(boxes_px[:, 2:]) + 1.0, 0.0).astype(np.int64)
    for (u1, v1), (u2, v2) in zip(first.tolist(), past.tolist(), strict=True):
        out[v1:v2, u1:u2] = False
    return out


@functools.lru_cache(maxsize=4)
def _lattice(config: LanesConfig) -> tuple[Floats, Floats]:
    """The rows' x (N,) and the columns' y (M,) of the points of the road that are looked up."""
    x_m = np.arange(0.5 * config.cell_m, config.depth_m, config.cell_m)
    y_m = np.arange(-config.half_width_m, config.half_width_m, config.lattice_m)
    return x_m, y_m


def in_cells(points_m: Points, T_ego_then: SE2, config: LanesConfig) -> Points:
    """Points of an earlier frame's ego in cells of the grid: (row, column) of each, with its fraction."""
    if not len(points_m):  # OpenCV transforms at least one
        return points_m
    origin_m = _origin_m(config) + np.array([T_ego_then.x_m, T_ego_then.y_m])
    to_cells = np.column_stack([T_ego_then.rotation(), origin_m]) / config.cell_m
    return np.asarray(cv2.transform(points_m, to_cells), np.float32)


def count_cells(clouds: Sequence[Points], config: LanesConfig) -> Grids:
    """(rows, columns) how many points of all clouds, as `in_cells` gives them, lie in each cell."""
    rows, columns = config.shape
    points = np.concatenate([np.zeros((0, 1, 2), np.float32), *clouds])
    if not len(points):
        return np.zeros((rows, columns), np.float32)
    return np.asarray(cv2.calcHist([points], [0, 1], None, [rows, columns], [0, rows, 0, columns]), np.float32)


def _cells_of(centres_m: Floats, config: LanesConfig) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows and columns of cells by their centres (N, 2) in ego."""
    row, column = np.floor((centres_m + _origin_m(config)) / config.cell_m).astype(np.int64).T
    return row, column


def _origin_m(config: LanesConfig) -> Floats:
    """(2,) the ego from the grid's first corner."""
    return np.array([config.behind_m, config.half_width_m])


def dense(cells: Bools, config: LanesConfig) -> Bools:
    """The cells that have at least `neighbourhood_least` foreground cells in their m x m neighbourhood (Sec. 3.2)."""
    m = config.neighbourhood_cells
    counts = cv2.boxFilter(cells.astype(np.float32), -1, (m, m), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cells & (counts > config.neighbourhood_least - 0.5))


def cell_centres_m(cells: Bools, config: LanesConfig) -> Floats:
    """(N, 2) centres, in ego, of the cells that are set."""
    out: Floats = (np.argwhere(cells) + 0.5) * config.cell_m - _origin_m(config)
    return out


def segregate(grids: Grids, config: LanesConfig) -> list[Floats]:
    """The boundary's cells as one cloud (N, 2) in ego for each lane, from the right to the left.

    Opening the road drops specks, closing it fills holes; a boundary lies on the road or beside it. The boundary's
    lines are one cell wide, so they are closed and never opened: `dense` has dropped their specks. Pieces of line from
    the Hough transform that continue each other are one lane, straight or bent.
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
    along, aside = _along_and_aside_m(pieces, cells)
    distance = np.hypot(aside, np.maximum(np.abs(along) - 0.5 * _lengths_m(pieces), 0.0))  # (cells, pieces)
    piece = np.where(distance.min(axis=1) < config.cell_reach_m, distance.argmin(axis=1), -1)
    lane_of_piece = _join(pieces, _touching(piece, on_road, len(pieces)), config)
    lane = np.where(piece >= 0, lane_of_piece[piece], -1)
    clouds = [cells[lane == k] for k in range(lane_of_piece.max() + 1)]
    clouds = [cloud for cloud in clouds if len(cloud) >= config.least_cells]
    return sorted(clouds, key=lambda cloud: float(np.median(cloud[:, 1])))


def _line_pieces_m(boundary: Bools, config: LanesConfig) -> Floats:
    """(P, 2, 2) ends, in ego, of straight pieces: the Hough transform of Sec. 3.2."""
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
    """(N, P) of points (N, 2) against pieces (P, 2, 2): along each from its middle, and aside."""
    direction = pieces[:, 1] - pieces[:, 0]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None]
    gap = points[:, None, :] - pieces.mean(axis=1)[None]
    return (
        (gap * direction).sum(axis=2),
        gap[..., 0] * direction[:, 1] - gap[..., 1] * direction[:, 0],
    )


def _lengths_m(pieces: Floats) -> Floats:
    out: Floats = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    return out


def _touching(piece: NDArray[np.int64], cells: Bools, count: int) -> Bools:
    """(P, P) which pieces have cells beside each other; `piece` is that of each cell that is set, or -1."""
    grid = np.full(np.add(cells.shape, 2), -1)
    grid[1:-1, 1:-1][cells] = piece
    out = np.zeros((count, count), dtype=np.bool_)
    here = grid[1:-1, 1:-1]
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        there = grid[1 + row :, 1 + column :][: here.shape[0], : here.shape[1]]
        both = (here >= 0) & (there >= 0)
        out[here[both], there[both]] = True
    return out | out.T


def _join(pieces: Floats, touching: Bools, config: LanesConfig) -> NDArray[np.int64]:
    """(P,) the lane that each piece belongs to: pieces that touch in a bend, or of which one ends on the other's line.

    An end that lies past the other piece may do so by a dashed line's gap. A stop line touches too, but turns too much.
    """
    count = len(pieces)
    vector = pieces[:, 1] - pieces[:, 0]
    yaw = np.arctan2(vector[:, 1], vector[:, 0])
    turn = np.abs((yaw[:, None] - yaw[None] + 0.5 * math.pi) % math.pi - 0.5 * math.pi)
    along, aside = _along_and_aside_m(pieces, pieces.reshape(-1, 2))
    past = np.abs(along) - 0.5 * _lengths_m(pieces)
    meets = (np.abs(aside) < config.same_line_m) & (past < config.line_gap_m)
    joined = meets.reshape(count, 2, count).any(axis=1) & (turn < config.same_line_rad)
    joined |= touching & (turn < config.bend_rad)
    from scipy.sparse import coo_array  # loaded by lane_ids.py's import of scipy.spatial
    from scipy.sparse.csgraph import connected_components

    first, second = np.nonzero(joined)
    _, lane = connected_components(coo_array((np.ones(len(first)), (first, second)), (count, count)), directed=False)
    return np.asarray(lane, dtype=np.int64)
