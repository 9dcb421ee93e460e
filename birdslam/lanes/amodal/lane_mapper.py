"""Lanes in the front end: lane points and CP edges from each segmentation (paper, Sec. 3.2).

Detection takes longer than a frame, so it runs at its own rate and, if possible, in the background.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane, VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.landmark_edges import StaticMapConfig
from birdslam.lanes.amodal.lane_edges import LaneEdgesConfig, Station, lane_stations
from birdslam.lanes.amodal.lane_ids import NO_LANE, cell_keys
from birdslam.lanes.amodal.lanes import AmodalLanes, Completion, LanesConfig, LaneView, lane_view, points_of
from birdslam.lanes.ego_lane import EgoLane
from birdslam.lanes.line_tracker import LineTracker
from birdslam.lanes.tracked_lines import TrackedLines
from birdslam.perception import Segmentation
from birdslam.types import LandmarkEdge, LanePoint, Lanes, Status

Ids = Ints
Submit = Callable[..., Future[Any]]  # (function, *arguments), as of an executor

MAX_FRAMES = 64  # number of stored poses, for late segmentations
MAX_IMAGES = 8  # number of stored images: lines are detected in the image of a segmentation


@dataclass(frozen=True)
class LaneHead:
    """How and how often lanes are detected.

    `complete`: network that completes occluded parts of the grids, or None. `submit` runs a function in the
    background; None: within the frame. Lanes are detected every `every * slowdown()` frames; the latter is above 1 on a
    busy computer. Detection in the background calls `yield_core` about every 2 ms, since frames need the same
    interpreter.
    """

    complete: Completion | None = None
    submit: Submit | None = None
    every: int = 1
    slowdown: Callable[[], int] = lambda: 1
    yield_core: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class LaneOutput:
    """Lane points and edges of a frame in its ego. `age`: frames since the last detection, None before the first."""

    points: tuple[LanePoint, ...] = ()
    edges: tuple[LandmarkEdge, ...] = ()
    age: int | None = None
    status: tuple[Status, ...] = ()
    lanes: Lanes | None = None


@dataclass(frozen=True)
class _LaneResult:
    """Result of a run in world: points (N, 2), their lanes (N,), and stations."""

    points_m: Floats
    lanes: Ids
    stations: list[Station]
    with_lanes: bool  # lanes were detected from many frames, not only this frame's points
    failed: bool  # the output of the completion network was not finite
    lines: TrackedLines | None  # None: not due, or the image of the segmentation is not stored any more
    seen_ns: int  # source time of that image


@dataclass(frozen=True)
class _PastFrame:
    """Pose and ground of an earlier frame, for the back-projection of its segmentation."""

    frame_id: int
    T_world_ego: SE2
    ground: GroundPlane
    sigma_tilt_rad: tuple[float, float]  # of the pitch and the roll
    t_source_ns: int = 0


def _run_now(run: Callable[..., Any], *arguments: Any) -> Future[Any]:
    done: Future[Any] = Future()
    done.set_result(run(*arguments))
    return done


class LaneMapper:
    """Lane points and edges of each segmentation in the ego of the current frame.

    A segmentation may be some frames late; it is back-projected with the pose and ground of its own frame. Every
    `LaneHead.every` frames `lanes.AmodalLanes` detects the lanes of many segmentations; points of this one on no known
    lane become lane points without an id. With `LaneHead.submit` the result comes with a later frame; segmentations in
    between are skipped, with the status LANES_CARRIED if lanes were due.
    """

    def __init__(
        self,
        camera: Camera,
        config: StaticMapConfig,
        lanes: LanesConfig = LanesConfig(),  # noqa: B008
        edges: LaneEdgesConfig = LaneEdgesConfig(),  # noqa: B008
        head: LaneHead = LaneHead(),
    ) -> None:
        self.camera = camera
        self.config = config
        self.edges = edges
        self.head = head
        self._submit = head.submit or _run_now
        self._amodal = AmodalLanes(lanes, head.complete, head.yield_core)
        self._tracker, self._ego_lane = LineTracker(camera, yield_core=head.yield_core), EgoLane()
        self._lines: tuple[int, TrackedLines] | None = None  # (source time of their image, lines)
        self._frames: deque[_PastFrame] = deque(maxlen=MAX_FRAMES)
        self._images: deque[tuple[int, NDArray[np.uint8]]] = deque(maxlen=MAX_IMAGES)
        self._used_frame = -1
        self._run: Future[_LaneResult] | None = None
        self._run_frame = -1
        self._run_outdated = False  # the current run belongs to an earlier epoch
        self._position_lost = False  # since the last run
        self._lanes_due_frame: int | None = None  # frame of the last run that detects lanes
        self._lanes_frame: int | None = None  # frame of the last finished one
        self._stations: tuple[int, list[Station]] = (-1, [])  # (frame, stations)

    def clear(self) -> None:
        """Drops all lanes after a restart of the world frame."""
        self._frames.clear()
        self._lanes_due_frame = self._lanes_frame = None
        self._stations = (-1, [])
        self._lines = None
        self._ego_lane.clear()
        self._run_outdated = self._run is not None
        if not self._run_outdated:
            self._clear_maps()

    def forget_position(self) -> None:
        """The motion to this frame has no scale: restarts with the next segmentation."""
        self._position_lost = True

    def _clear_maps(self) -> None:
        self._amodal.clear()
        self._tracker.clear()

    @property
    def vertical(self) -> VerticalCurvature | None:
        """Vertical curvature of the road ahead from the last lines."""
        return None if self._lines is None else self._lines[1].vertical

    def view(self, T_world_ego: SE2) -> LaneView:
        """The grids and lanes around the ego, for a picture; not during a run in the background."""
        return lane_view(self._amodal, T_world_ego)

    def map_lanes(
        self,
        frame_id: int,
        T_world_ego: SE2,
        ground: GroundPlane,
        sigma_tilt_rad: tuple[float, float],
        segmentation: Segmentation | None,
        segmented_frame: int,
        boxes_px: Floats,
        image: NDArray[np.uint8] | None = None,
        t_source_ns: int = 0,
        bonnet_px: Floats | None = None,
    ) -> LaneOutput:
        """Lane points and edges of the segmentation of `segmented_frame`, if it is new and the ego has moved.

        `sigma_tilt_rad`: 1-sigma of the pitch and roll of `ground`. `boxes_px` (N, 4): the vehicles' latest boxes,
        which are masked out. `bonnet_px` (N, 2): edge of the ego's bonnet. `image`: (H, W) grey or (H, W, 3) BGR, kept
        until its segmentation comes.
        """
        self._frames.append(_PastFrame(frame_id, T_world_ego, ground, sigma_tilt_rad, t_source_ns))
        if image is not None:
            self._images.append((frame_id, image))
        earlier = self._take_result()
        status: tuple[Status, ...] = ()
        if segmentation is not None and segmented_frame != self._used_frame:
            every = self.head.every * self.head.slowdown()
            due = self._lanes_due_frame is None or not 0 <= frame_id - self._lanes_due_frame < every
            then = next((f for f in self._frames if f.frame_id == segmented_frame), None)
            if self._run is not None:
                status = (Status.LANES_CARRIED,) if due else ()
            elif then is not None:
                self._used_frame = segmented_frame
                if self._amodal.has_moved(then.T_world_ego):
                    self._lanes_due_frame = frame_id if due else self._lanes_due_frame
                    self._run_frame = frame_id
                    seen = next((kept for kept_id, kept in self._images if kept_id == segmented_frame), None)
                    road = segmentation if bonnet_px is None else segmentation.above(bonnet_px)
                    run = (
                        T_world_ego,
                        then,
                        road,
                        boxes_px,
                        bonnet_px,
                        due,
                        seen if due else None,
                        self._position_lost,
                    )
                    self._position_lost = False
                    self._run = self._submit(self._detect_lanes, *run)
        found = earlier or self._take_result()
        return self._output(found, frame_id, T_world_ego, status, self._lanes_at(T_world_ego, t_source_ns))

    def _lanes_at(self, T_world_ego: SE2, t_source_ns: int) -> Lanes | None:
        """The lanes between the last lines, predicted by the ego's motion since; None before the first."""
        if self._lines is None:
            return None
        seen_ns, lines = self._lines
        age_ns = max(0, t_source_ns - seen_ns)
        return self._ego_lane.lanes(lines.at(T_world_ego), age_ns, lines.tilt, lines.road_from_m)

    def _take_result(self) -> _LaneResult | None:
        """The result of a finished run."""
        if self._run is None or not self._run.done():
            return None
        found, self._run = self._run.result(), None
        if self._run_outdated:
            self._run_outdated = False
            self._clear_maps()
            return None
        self._stations = self._run_frame, found.stations
        if found.lines is not None:
            self._lines = found.seen_ns, found.lines
        if found.with_lanes:
            self._lanes_frame = self._run_frame
        return found

    def _output(
        self,
        found: _LaneResult | None,
        frame_id: int,
        T_world_ego: SE2,
        status: tuple[Status, ...],
        lanes: Lanes | None,
    ) -> LaneOutput:
        age = None if self._lanes_frame is None else frame_id - self._lanes_frame
        seen_frame, seen = self._stations
        carried = 0 <= frame_id - seen_frame <= self.edges.carried_frames
        edges = tuple(station.edge(frame_id, T_world_ego) for station in seen) if carried else ()
        if found is None:
            return LaneOutput(edges=edges, age=age, status=status, lanes=lanes)
        points = (T_world_ego.inverse() @ found.points_m).tolist()
        return LaneOutput(
            tuple(LanePoint(x, y, lane) for (x, y), lane in zip(points, found.lanes.tolist(), strict=True)),
            edges,
            age,
            (*status, Status.NETWORK_FAILED) if found.failed else status,
            lanes,
        )

    def _detect_lanes(
        self,
        T_world_ego: SE2,
        then: _PastFrame,
        segmentation: Segmentation,
        boxes_px: Floats,
        bonnet_px: Floats | None,
        due: bool,
        image: NDArray[np.uint8] | None,
        restart: bool,
    ) -> _LaneResult:
        if restart:
            self._clear_maps()
        lines = None
        if image is not None:
            self._tracker.update(
                then.T_world_ego,
                then.ground,
                then.sigma_tilt_rad,
                image,
                segmentation,
                boxes_px,
                bonnet_px=bonnet_px,
            )
            lines = self._tracker.lines()
            self.head.yield_core()
        road_m, boundary_m = points_of(segmentation, self.camera, then.ground, boxes_px, self._amodal.config)
        on_world_m = then.T_world_ego @ boundary_m
        found = lane_stations(
            on_world_m,
            self._amodal.ids.lookup(on_world_m),  # lanes known before this frame
            then.T_world_ego,
            self.camera,
            then.ground,
            then.sigma_tilt_rad[0],
            self.config.sigma_height_rel,
            self.edges,
        )
        self._amodal.add(then.T_world_ego, road_m, boundary_m)
        self.head.yield_core()
        points_m, lanes = self._lanes_m(T_world_ego) if due else (np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
        self.head.yield_core()
        seen_m = then.T_world_ego @ self._points_m(segmentation, then.ground, boxes_px)
        seen_m = seen_m[self._amodal.ids.lookup(seen_m) == NO_LANE]
        if len(points_m):
            from scipy.spatial import cKDTree  # loaded by lane_ids.py

            seen_m = seen_m[cKDTree(points_m).query(seen_m)[0] > self._amodal.config.same_lane_m]
        seen_m = seen_m[: self.config.max_lane_points - len(points_m)]
        all_lanes = np.concatenate([lanes, np.full(len(seen_m), NO_LANE)])
        failed = due and self._amodal.completion_failed
        points_m = np.concatenate([points_m, seen_m])
        return _LaneResult(points_m, all_lanes, found, due, failed, lines, then.t_source_ns)

    def _lanes_m(self, T_world_ego: SE2) -> tuple[Floats, Ids]:
        """(N, 2) points of the lanes ahead in world, the mean of each cell, and their lanes (N,).

        Above `max_lane_points` they are thinned evenly.
        """
        config = self.config
        clouds = self._amodal.lanes(T_world_ego)
        if not clouds:
            return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
        points = np.concatenate([cloud.points_m for cloud in clouds])
        lanes = np.repeat([cloud.lane for cloud in clouds], [len(cloud.points_m) for cloud in clouds])
        ahead = (points[:, 0] >= 0.0) & (points[:, 0] < config.lane_range_m)
        points, lanes = points[ahead], lanes[ahead]
        cells = np.column_stack([np.floor(points / config.lane_cell_m).astype(np.int64), lanes])
        cells, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        sums = np.zeros((len(cells), 2))
        np.add.at(sums, inverse.reshape(-1), points)
        points, lanes = sums / counts[:, None], cells[:, 2]
        kept = np.argsort(points[:, 0], kind="stable")
        if len(kept) > config.max_lane_points:
            kept = kept[np.linspace(0, len(kept) - 1, config.max_lane_points).astype(np.int64)]
        return T_world_ego @ points[kept], lanes[kept]

    def _points_m(self, segmentation: Segmentation, ground: GroundPlane, boxes_px: Floats) -> Floats:
        """(N, 2) lane points in the ego of the segmentation's frame, one per cell, nearest first."""
        config = self.config
        lane = segmentation.lane.copy()
        for x1, y1, x2, y2 in boxes_px:
            lane[max(0, math.floor(y1)) : math.ceil(y2), max(0, math.floor(x1)) : math.ceil(x2)] = False
        if not lane.any():
            return np.zeros((0, 2))
        px = cv2.findNonZero(lane.view(np.uint8)).reshape(-1, 2)  # columns and rows
        points = bev.pixel_to_ego(self.camera, ground, px.astype(np.float64))
        with np.errstate(invalid="ignore"):
            points = points[points[:, 0] < config.lane_range_m]
        _, first = np.unique(cell_keys(points, config.lane_cell_m), return_index=True)
        first = first[np.argsort(points[first, 0], kind="stable")][: config.max_lane_points]
        out: Floats = points[first]
        return out
