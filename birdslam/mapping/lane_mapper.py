"""Lanes in the front end: each segmentation's lane points and CP edges (paper, Sec. 3.2).

Finding lanes takes longer than a frame, so it runs beside the frames where it can, and at a rate of its own.
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
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.mapping.landmark_edges import StaticMapConfig
from birdslam.mapping.lane_edges import LaneEdgesConfig, Station, lane_stations
from birdslam.mapping.lane_ids import NO_LANE, cell_keys
from birdslam.mapping.lane_view import LaneView, lane_view
from birdslam.mapping.lanes import AmodalLanes, Completion, LanesConfig, points_of
from birdslam.perception import Segmentation
from birdslam.types import LandmarkEdge, LanePoint, Status

Floats = NDArray[np.float64]
Ids = NDArray[np.int64]
Aside = Callable[..., Future[Any]]  # (function, *arguments)

REMEMBERED_FRAMES = 64  # the pose of a segmentation that is older is not known any more


@dataclass(frozen=True)
class LaneHead:
    """How lanes are found, and how often: perceive's schedule has them beside the networks' heads.

    `complete` is the network that fills the grids where something hid the road; None leaves them as they were seen.
    `aside` runs a function beside the frames, so that none waits for it; None: the frame does. Lanes are found anew
    after `every` frames, times what `sparing` says at the time: a computer that is busy finds them less often.
    """

    complete: Completion | None = None
    aside: Aside | None = None
    every: int = 1
    sparing: Callable[[], int] = lambda: 1


@dataclass(frozen=True)
class LaneOutput:
    """What a frame gains, in its ego. `age`: frames since the one that lanes were last found in; None: never yet."""

    points: tuple[LanePoint, ...] = ()
    edges: tuple[LandmarkEdge, ...] = ()
    age: int | None = None
    status: tuple[Status, ...] = ()


@dataclass(frozen=True)
class _Found:
    """What a run found, in world: points (N, 2), their lanes (N,), and stations."""

    points_m: Floats
    lanes: Ids
    stations: list[Station]
    with_lanes: bool  # the lanes of many frames too, and not only what this one frame saw
    failed: bool  # their completion gave no usable numbers


@dataclass(frozen=True)
class _PastFrame:
    """What the back-projection of an earlier frame's segmentation needs to know of that frame."""

    frame_id: int
    T_world_ego: SE2
    ground: GroundPlane
    sigma_pitch_rad: float


def _run_at_once(run: Callable[..., Any], *arguments: Any) -> Future[Any]:
    done: Future[Any] = Future()
    done.set_result(run(*arguments))
    return done


class LaneMapper:
    """Lane points and lane edges of each segmentation, once, in the ego of the frame at hand.

    A segmentation may come frames after its image. It is back-projected with the pose and the ground plane of its own
    frame, which are kept until then. Every `LaneHead.every` frames the lanes that many segmentations show together are
    found (`lanes.AmodalLanes`); points of this one that lie on no known lane are lane points without an id.

    With `LaneHead.aside` what is found comes with a later frame, and a segmentation that comes meanwhile is skipped.
    Where lanes were due with it, the status LANES_CARRIED says so.
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
        self._aside = head.aside or _run_at_once
        self._amodal = AmodalLanes(lanes, head.complete)
        self._frames: deque[_PastFrame] = deque(maxlen=REMEMBERED_FRAMES)
        self._used_frame = -1
        self._running: Future[_Found] | None = None
        self._running_frame = -1
        self._outdated = False  # the run under way belongs to a world that has ended
        self._due_frame: int | None = None  # whose run finds lanes, or found them last
        self._found_frame: int | None = None  # whose run found them last
        self._stations: tuple[int, list[Station]] = (-1, [])  # the frame that saw them last

    def clear(self) -> None:
        """The world frame began anew."""
        self._frames.clear()
        self._due_frame = self._found_frame = None
        self._stations = (-1, [])
        self._outdated = self._running is not None
        if not self._outdated:
            self._amodal.clear()

    def view(self, T_world_ego: SE2) -> LaneView:
        """What the lanes around the ego are made of, for a picture; not while a run is under way aside."""
        return lane_view(self._amodal, T_world_ego)

    def map_lanes(
        self,
        frame_id: int,
        T_world_ego: SE2,
        ground: GroundPlane,
        sigma_pitch_rad: float,
        segmentation: Segmentation | None,
        segmented_frame: int,
        boxes_px: Floats,
    ) -> LaneOutput:
        """What the segmentation of `segmented_frame` adds, nothing where it was used before or the ego stands.

        `boxes_px` (N, 4) are the vehicles' latest boxes, under which no line is believed.
        """
        self._frames.append(_PastFrame(frame_id, T_world_ego, ground, sigma_pitch_rad))
        earlier = self._finished()
        status: tuple[Status, ...] = ()
        if segmentation is not None and segmented_frame != self._used_frame:
            every = self.head.every * self.head.sparing()
            due = self._due_frame is None or not 0 <= frame_id - self._due_frame < every
            then = next((f for f in self._frames if f.frame_id == segmented_frame), None)
            if self._running is not None:
                status = (Status.LANES_CARRIED,) if due else ()
            elif then is not None:
                self._used_frame = segmented_frame
                if self._amodal.is_news(then.T_world_ego):
                    self._due_frame = frame_id if due else self._due_frame
                    self._running_frame = frame_id
                    self._running = self._aside(self._gather, T_world_ego, then, segmentation, boxes_px, due)
        return self._output(earlier or self._finished(), frame_id, T_world_ego, status)

    def _finished(self) -> _Found | None:
        """What a run found that has ended."""
        if self._running is None or not self._running.done():
            return None
        found, self._running = self._running.result(), None
        if self._outdated:
            self._outdated = False
            self._amodal.clear()
            return None
        self._stations = self._running_frame, found.stations
        if found.with_lanes:
            self._found_frame = self._running_frame
        return found

    def _output(self, found: _Found | None, frame_id: int, T_world_ego: SE2, status: tuple[Status, ...]) -> LaneOutput:
        age = None if self._found_frame is None else frame_id - self._found_frame
        seen_frame, seen = self._stations
        carried = 0 <= frame_id - seen_frame <= self.edges.carried_frames
        edges = tuple(station.edge(frame_id, T_world_ego) for station in seen) if carried else ()
        if found is None:
            return LaneOutput(edges=edges, age=age, status=status)
        points = (T_world_ego.inverse() @ found.points_m).tolist()
        return LaneOutput(
            tuple(LanePoint(x, y, lane) for (x, y), lane in zip(points, found.lanes.tolist(), strict=True)),
            edges,
            age,
            (*status, Status.NETWORK_FAILED) if found.failed else status,
        )

    def _gather(
        self, T_world_ego: SE2, then: _PastFrame, segmentation: Segmentation, boxes_px: Floats, due: bool
    ) -> _Found:
        road_m, boundary_m = points_of(segmentation, self.camera, then.ground, boxes_px, self._amodal.config)
        on_world_m = then.T_world_ego @ boundary_m
        found = lane_stations(
            on_world_m,
            self._amodal.ids.of(on_world_m),  # as they were known before this frame
            then.T_world_ego,
            self.camera,
            then.ground,
            then.sigma_pitch_rad,
            self.config.sigma_height_rel,
            self.edges,
        )
        self._amodal.add(then.T_world_ego, road_m, boundary_m)
        points_m, lanes = self._lanes_m(T_world_ego) if due else (np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
        seen_m = then.T_world_ego @ self._points_m(segmentation, then.ground, boxes_px)
        seen_m = seen_m[self._amodal.ids.of(seen_m) == NO_LANE]
        if len(points_m):
            from scipy.spatial import cKDTree  # loaded by lane_ids.py

            seen_m = seen_m[cKDTree(points_m).query(seen_m)[0] > self._amodal.config.same_lane_m]
        seen_m = seen_m[: self.config.max_lane_points - len(points_m)]
        all_lanes = np.concatenate([lanes, np.full(len(seen_m), NO_LANE)])
        failed = due and self._amodal.completion_failed
        return _Found(np.concatenate([points_m, seen_m]), all_lanes, found, due, failed)

    def _lanes_m(self, T_world_ego: SE2) -> tuple[Floats, Ids]:
        """(N, 2) points, in world, of the lanes ahead, and their lanes (N,): the middle of what lies in each cell.

        Where there are too many they are thinned evenly, so that they reach as far.
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
        """(N, 2) in the ego of the segmentation's frame, one for each cell, nearest first."""
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
