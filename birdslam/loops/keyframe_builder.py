"""Builds keyframes of a drive every few metres from the frames around them, with the lane lines beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.features import Features
from birdslam.loops.foot import body_pose
from birdslam.loops.keyframe import LinePiece
from birdslam.loops.triangulation import Points, View, triangulate
from birdslam.trajectory import mount_pose
from birdslam.types import Attitude, Estimate, LaneLine

SPACING_M = 4.0  # between keyframes
MAX_POINTS = 150
MIN_POINTS = 25  # for recognition
REACH_M = 5.0  # max. distance of the frames that triangulate a keyframe's points
LOOK_M, LOOK_NS = 0.4, 500_000_000  # interval of processed frames, by distance or time
GRID_CELLS = 8, 4
NODE_AT_M = 6.0  # ahead of the ego, where a line is visible and most accurate
NODE_EVERY_M = 2.0
MIN_EXISTENCE = 0.5
HELD_M = 12.0  # max. distance of a node from its keyframe


@dataclass(frozen=True, eq=False)
class Look:
    """A frame with its features."""

    frame_id: int
    t_source_ns: int
    travelled_m: float
    T_odom_ego: SE2
    attitude: Attitude
    features: Features
    scale_rel: float = 0.0  # 1-sigma of odometry's scale, without the part of the camera's height
    unsure_m2: float = 0.0  # variance of odometry's known errors so far


@dataclass(frozen=True, eq=False)
class NewKeyframe:
    """A keyframe without a pose in the map."""

    look: Look
    points_m: Floats
    sigma_depth_rel: Floats
    descriptors: NDArray[np.uint8]
    lines: tuple[LinePiece, ...] = ()


class LineNodes:
    """Points of the lane lines NODE_AT_M ahead of the ego, in one epoch."""

    def __init__(self, drive: int) -> None:
        self._drive = drive
        self._nodes: list[tuple[float, LaneLine, tuple[float, float]]] = []  # distance, line, point in odometry
        self._next_m = 0.0

    def add(self, estimate: Estimate, travelled_m: float) -> None:
        """Adds the lines of a frame if one is due."""
        if estimate.lanes is None or not estimate.valid or travelled_m < self._next_m:
            return
        self._next_m = travelled_m + NODE_EVERY_M
        for line in estimate.lanes.lines:
            if line.existence >= MIN_EXISTENCE and line.seen_from_m < NODE_AT_M < line.seen_to_m:
                x_m, y_m = (estimate.T_world_ego @ np.array([[NODE_AT_M, line.y_m(NODE_AT_M)]]))[0]
                self._nodes.append((travelled_m + NODE_AT_M, line, (float(x_m), float(y_m))))

    def take(self, look: Look) -> tuple[LinePiece, ...]:
        """Returns and removes the lines up to half of the distance to the next keyframe."""
        until_m = look.travelled_m + 0.5 * SPACING_M
        taken = [node for node in self._nodes if look.travelled_m - HELD_M < node[0] <= until_m]
        self._nodes = [node for node in self._nodes if node[0] > until_m]
        back = look.T_odom_ego.inverse()
        pieces = []
        for number in sorted({line.line for _, line, _ in taken}):
            mine = [(line, point) for _, line, point in taken if line.line == number]
            newest = mine[-1][0]
            sigma_m = max(line.sigma_m(NODE_AT_M) for line, _ in mine)
            points_m = back @ np.array([point for _, point in mine])
            pieces.append(LinePiece(self._drive, number, newest.kind, newest.colour, points_m, sigma_m))
        return tuple(pieces)


class KeyframeBuilder:
    """Builds the keyframes of one epoch; poses are in its odometry frame."""

    def __init__(self, camera: Camera, drive: int = 0) -> None:
        self._camera = camera
        self._mount = mount_pose(camera.ground)
        self._window: list[Look] = []
        self.nodes = LineNodes(drive)
        self._next_m = 0.0  # distance travelled of the next keyframe
        self._open = False

    def add(self, look: Look) -> list[NewKeyframe]:
        """Adds a frame; returns the keyframes that it completes."""
        if not self._open:
            self._next_m, self._open = look.travelled_m, True
        if self._window and look.travelled_m - self._window[-1].travelled_m < LOOK_M:
            return []
        self._window.append(look)
        return self._due(look.travelled_m - REACH_M)

    def finish(self) -> list[NewKeyframe]:
        """Returns the keyframes at the end of the drive, from the frames before them only."""
        return self._due(math.inf)

    def _due(self, until_m: float) -> list[NewKeyframe]:
        out = []
        for look in self._window:
            if self._next_m <= look.travelled_m <= until_m:
                made = self._make(look)
                self._next_m = look.travelled_m + (SPACING_M if made is not None else 0.5 * SPACING_M)
                if made is not None:
                    out.append(made)
        oldest_m = min(self._next_m, until_m) - REACH_M
        self._window = [look for look in self._window if look.travelled_m >= oldest_m]
        return out

    def _make(self, look: Look) -> NewKeyframe | None:
        around = [o for o in self._window if o is not look and abs(o.travelled_m - look.travelled_m) <= REACH_M]
        others = around[:: max(1, -(-len(around) // 12))]  # at most a dozen
        points = triangulate(self._camera, self._view(look), [self._view(other) for other in others])
        kept = _spread(points, look.features.px[points.feature], (self._camera.width_px, self._camera.height_px))
        if len(kept) < MIN_POINTS:
            return None
        p_ego = points.p_cam_m[kept] @ self._mount[:3, :3].T + self._mount[:3, 3]
        seen = p_ego, points.sigma_depth_rel[kept], look.features.descriptors[points.feature[kept]]
        return NewKeyframe(look, *seen, self.nodes.take(look))

    def _view(self, look: Look) -> View:
        return View(look.features, body_pose(look.T_odom_ego, look.attitude, self._camera.height_m) @ self._mount)


def _spread(points: Points, px: Floats, size_px: tuple[int, int]) -> Ints:
    """Returns at most MAX_POINTS rows, best first and evenly over the cells of the image."""
    cells = np.floor(px / size_px * GRID_CELLS).astype(int) @ (1, GRID_CELLS[0])
    quality = np.minimum(points.frames, 8) - 20.0 * points.sigma_depth_rel - points.p_cam_m[:, 2] / 30.0
    order = np.lexsort((-quality, cells))
    rank = np.zeros(len(order), np.int64)  # of each point within its cell
    for cell in np.unique(cells):
        mine = order[cells[order] == cell]
        rank[mine] = np.arange(len(mine))
    return np.sort(np.lexsort((-quality, rank))[:MAX_POINTS])
