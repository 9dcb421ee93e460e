"""The static features of the road plane: landmarks from feature tracks, points of lane lines from a segmentation.

Both are back-projected by Eq. 1 (paper, static map initialization).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from birdslam import bev
from birdslam.camera import Camera, GroundPlane
from birdslam.lanes import AmodalLanes, Completion, LanesConfig, cell_keys, points_of
from birdslam.perception import Segmentation
from birdslam.se2 import SE2
from birdslam.types import LandmarkEdge, LanePoint

Floats = NDArray[np.float64]
Ids = NDArray[np.int64]
Aside = Callable[..., Future[Any]]  # (function, *arguments)

NO_LANE = LanePoint(0.0, 0.0).lane
REMEMBERED_FRAMES = 64  # a segmentation that is older than that is no news


class StaticMapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which points of the road become landmarks and lane points."""

    max_landmarks: int = 40
    landmark_range_m: float = 20.0  # the paper's depth threshold T
    sigma_landmark_px: float = 1.0
    sigma_height_rel: float = 0.02
    max_lane_points: int = 64
    lane_range_m: float = 20.0
    lane_cell_m: float = 0.5  # one point for each cell
    attitude_memory_m: float = 1000.0  # roads are level on average: tilt is forgotten over this distance


def landmark_edges(
    ids: NDArray[np.int64],
    px: NDArray[np.float64],
    frame_id: int,
    camera: Camera,
    ground: GroundPlane,
    sigma_pitch_rad: float,
    config: StaticMapConfig,
) -> tuple[LandmarkEdge, ...]:
    """CP edges of feature tracks (N,) at pixels (N, 2) that lie on the road: the nearest ones."""
    points = bev.pixel_to_ego(camera, ground, px)  # Eq. 1
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero(points[:, 0] < config.landmark_range_m)
    near = near[np.argsort(points[near, 0], kind="stable")][: config.max_landmarks]
    covs = bev.road_point_cov(
        camera, ground, px[near], config.sigma_landmark_px, sigma_pitch_rad, config.sigma_height_rel
    )
    return tuple(
        LandmarkEdge(
            landmark=int(ids[i]),
            frame=frame_id,
            x_m=float(points[i, 0]),
            y_m=float(points[i, 1]),
            cov=tuple(cov.ravel().tolist()),
        )
        for i, cov in zip(near, covs, strict=True)
        if np.isfinite(cov).all()
    )


def _at_once(run: Callable[..., Any], *arguments: Any) -> Future[Any]:
    done: Future[Any] = Future()
    done.set_result(run(*arguments))
    return done


class LaneMapper:
    """Lane points of each segmentation, once, in the ego of the frame at hand.

    A segmentation may come frames after its image. It is back-projected with the pose and the ground plane of its own
    frame, which are kept until then. The lanes that many of them show together come first (`lanes.AmodalLanes`); where
    there is none, what this one saw stands for itself.

    With `aside`, which runs a function elsewhere, a frame does not wait for this: the points come with a later frame,
    in its ego, and a segmentation that comes meanwhile adds nothing.
    """

    def __init__(
        self,
        camera: Camera,
        config: StaticMapConfig,
        lanes: LanesConfig = LanesConfig(),  # noqa: B008
        complete: Completion | None = None,
        aside: Aside | None = None,
    ) -> None:
        self.camera = camera
        self.config = config
        self._aside = aside or _at_once
        self._running: Future[tuple[Floats, Ids]] | None = None
        self._running_at = (-1, SE2())  # the frame that its points are in the ego of, and that ego
        self._outdated = False  # the run under way belongs to a world of before
        self._amodal = AmodalLanes(lanes, complete)
        self._frames: deque[tuple[int, SE2, GroundPlane]] = deque(maxlen=REMEMBERED_FRAMES)
        self._used_frame = -1

    def clear(self) -> None:
        """The world frame began anew."""
        self._frames.clear()
        self._outdated = self._running is not None
        if not self._outdated:
            self._amodal.clear()

    def step(
        self,
        frame_id: int,
        T_world_ego: SE2,
        ground: GroundPlane,
        segmentation: Segmentation | None,
        segmented_frame: int,
        boxes_px: NDArray[np.float64],
    ) -> tuple[LanePoint, ...]:
        """What the segmentation of `segmented_frame` adds, nothing where it was used before or the ego stands.

        `boxes_px` (N, 4) are the vehicles' latest boxes, under which no line is believed.
        """
        self._frames.append((frame_id, T_world_ego, ground))
        earlier = self._finished(frame_id, T_world_ego)
        if segmentation is not None and segmented_frame != self._used_frame and self._running is None:
            then = next((f for f in self._frames if f[0] == segmented_frame), None)
            if then is not None:
                self._used_frame = segmented_frame
                if self._amodal.is_news(then[1]):
                    self._running_at = frame_id, T_world_ego
                    self._running = self._aside(self._gather, T_world_ego, *then[1:], segmentation, boxes_px)
        return earlier or self._finished(frame_id, T_world_ego)

    def _finished(self, frame_id: int, T_world_ego: SE2) -> tuple[LanePoint, ...]:
        """What a run gave that has ended, in the ego of the frame at hand."""
        if self._running is None or not self._running.done():
            return ()
        (points, lanes), self._running = self._running.result(), None
        if self._outdated:
            self._outdated = False
            self._amodal.clear()
            return ()
        run_frame, T_world_run = self._running_at
        if run_frame != frame_id:
            points = T_world_ego.between(T_world_run) @ points
        return tuple(LanePoint(x, y, lane) for (x, y), lane in zip(points.tolist(), lanes.tolist(), strict=True))

    def _gather(
        self,
        T_world_ego: SE2,
        T_world_then: SE2,
        ground_then: GroundPlane,
        segmentation: Segmentation,
        boxes_px: Floats,
    ) -> tuple[Floats, Ids]:
        """(N, 2) points in ego and their lanes (N,), for those that belong to none what a LanePoint has then."""
        self._amodal.add(
            T_world_then, *points_of(segmentation, self.camera, ground_then, boxes_px, self._amodal.config)
        )
        points, lanes = self._lanes_m(T_world_ego)
        seen = T_world_ego.between(T_world_then) @ self._points_m(segmentation, ground_then, boxes_px)
        if len(points):
            seen = seen[cKDTree(points).query(seen)[0] > self._amodal.config.same_lane_m]
        seen = seen[: self.config.max_lane_points - len(points)]
        return np.concatenate([points, seen]), np.concatenate([lanes, np.full(len(seen), NO_LANE)])

    def _lanes_m(self, T_world_ego: SE2) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(N, 2) points of the lanes ahead, in ego, and their lanes (N,): the middle of what lies in each cell.

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
        return points[kept], lanes[kept]

    def _points_m(
        self, segmentation: Segmentation, ground: GroundPlane, boxes_px: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 2) in the ego of the segmentation's frame, one for each cell, nearest first."""
        config = self.config
        lane = segmentation.lane.copy()
        for x1, y1, x2, y2 in boxes_px:
            lane[max(0, math.floor(y1)) : math.ceil(y2), max(0, math.floor(x1)) : math.ceil(x2)] = False
        rows, columns = np.nonzero(lane)
        points = bev.pixel_to_ego(self.camera, ground, np.column_stack([columns, rows]).astype(np.float64))
        with np.errstate(invalid="ignore"):
            points = points[points[:, 0] < config.lane_range_m]
        _, first = np.unique(cell_keys(points, config.lane_cell_m), return_index=True)
        first = first[np.argsort(points[first, 0], kind="stable")][: config.max_lane_points]
        out: NDArray[np.float64] = points[first]
        return out
