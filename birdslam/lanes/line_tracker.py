"""Tracks the lines of a drive: from the points of each image to lines with persistent ids.

The first image is searched for the common shape of its lines (`parallel_search`). Later images correct the predicted
lines of the filter; points on no known line initialize new lines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.lanes.borders import border_points
from birdslam.lanes.curves import basis
from birdslam.lanes.line_filter import VERTICAL, LineFilter, Support, Tilt
from birdslam.lanes.paint import LinePoints, double_line_share, edge_points, paint_points
from birdslam.lanes.parallel_search import MAX_SEARCH_M, Peak, Shape, find_lines, find_shape
from birdslam.lanes.road_view import LATTICE_M, RoadView, nearest_visible_m, road_view
from birdslam.lanes.topology import AT_M, MAX_LANE_M, MAX_STRIP_M
from birdslam.lanes.tracked_lines import LEFT_EDGE, PAINT, RIGHT_EDGE, Track, TrackedLines, existence_of
from birdslam.perception import Segmentation
from birdslam.types import LaneLine

MIN_STEP_M = 0.8  # min. distance travelled between two updates; images from one place have common errors
STATIONARY_UPDATES = 4  # max. number of updates of a stationary car
MIN_PAINT_M, MIN_EDGE_M = 2.4, 8.0  # evidence of a new line
CERTAIN_M = 5.0  # evidence that confirms a line in one image
MIN_SPACING_M = 0.45  # min. distance from a known line
EDGE_WEIGHT_RATIO = 0.3  # of an edge's points in the search, since side roads disturb a mask's border
MAX_LINES = 9
IN_VIEW_M = 8.0  # visible length of a line in which paint would be detected
CONFIRMED, MAX_SCORE = 3.0, 8.0
MIN_SEEN_PAINT_M = 2.0  # of paint, for a detection of the line
SAME_M = 0.3  # max. distance of two tracks of one line, from 5 to 20 m
MIN_END_M = -2.0  # end of a line behind the ego at which it is dropped
NEAR_M, FAR_M = 5.0, 25.0  # range in which a line is tested
# Lines closer than MIN_LANE_WIDTH_M bound no lane: the score of one without paint decreases faster by this factor
MIN_LANE_WIDTH_M, CONTESTED_COST_RATIO = 1.5, 3.0
MIN_EXISTENCE, MIN_IMAGES = 0.4, 4.0  # a line with a lower existence after MIN_IMAGES is dropped
RESTART_M = 10.0  # distance travelled assumed for the first image
# The lines are lost if they explain less than LOST_RATIO of the paint, and a new search BETTER_RATIO times as much
LOST_M, LOST_RATIO, BETTER_RATIO = 5.0, 0.5, 1.5
PROFILE_M = 4.0, 22.0  # range in which paint and gaps are resolved


class LineTracker:
    """State: the filter, in the ego's frame at `T_world_filter`, and its lines' tracks."""

    def __init__(
        self, camera: Camera, certain_m: float = CERTAIN_M, yield_core: Callable[[], object] = lambda: None
    ) -> None:
        """`certain_m`: evidence that confirms a line in its first image.

        `yield_core` is called between the parts of an update (lane_mapper.LaneHead).
        """
        self.camera = camera
        self._yield_core = yield_core
        self._confirmation_m = certain_m
        self._next = 0
        self.clear()

    def clear(self) -> None:
        """Drops all lines; ids are not reused."""
        self._filter = LineFilter()
        self._tracks: list[Track] = []
        self._T_world_filter: SE2 | None = None
        self._stationary_updates = 0
        self.tilt = Tilt()  # of the road in the last image against its ground
        self._road_from_m = 0.0
        self._height_m, self._sigma_roll_rad = self.camera.height_m, self.camera.tilt_sigma_rad  # of the last image

    def update(
        self,
        T_world_ego: SE2,
        ground: GroundPlane,
        sigma_tilt_rad: tuple[float, float],
        image: NDArray[np.uint8],
        segmentation: Segmentation,
        boxes_px: Floats,
        search_tilt: bool = False,
        bonnet_px: Floats | None = None,
    ) -> None:
        """Updates the lines from one image, its masks, the `ground` under its camera and the vehicles' boxes (B, 4).

        `bonnet_px` (N, 2) is the edge of the ego's bonnet, if it is in view. `sigma_tilt_rad` is the 1-sigma of the
        ground's pitch and roll. `search_tilt`: estimate the pitch from this image alone, with that prior.
        """
        sigma_pitch_rad, self._sigma_roll_rad = sigma_tilt_rad
        self._height_m = ground.height_m
        travelled_m = self._advance(T_world_ego)
        if travelled_m is None:
            return
        view = road_view(self.camera, ground, image, segmentation, boxes_px, bonnet_px)
        self._road_from_m = nearest_visible_m(self.camera, ground, bonnet_px)
        self._yield_core()
        paint = paint_points(view)
        self._yield_core()
        first_tilt_rad = 0.0
        if not len(self._filter):
            shape, found = self._search(view, paint, sigma_pitch_rad if search_tilt else 0.0)
            first_tilt_rad = self._restart_filter(shape, found)
        if not len(self._filter):
            return
        points, of, seen = self._correct(view, paint, sigma_pitch_rad, travelled_m, first_tilt_rad, search_tilt)
        explained_m = _measure_explained_m(points, seen)
        if self._is_lost(view, points, explained_m):
            self._yield_core()
            shape, found = self._search(view, paint, 0.0)
            if sum(peak.evidence_m for _, peak in found) > BETTER_RATIO * explained_m:
                self._restart_filter(shape, found)
                points, of, seen = self._correct(view, paint, sigma_pitch_rad, RESTART_M, 0.0, search_tilt)
        if not self._filter.valid_lines().all():
            self._drop_invalid_lines()
            return
        self._yield_core()
        self._update_scores(view, points, seen)
        self._add_lines(points, of, seen, ground.height_m)
        self._drop_lines()

    def _advance(self, T_world_ego: SE2) -> float | None:
        """Moves the filter to the ego. Returns the distance since the last update, None if it is too short."""
        if self._T_world_filter is None:
            self._T_world_filter = T_world_ego
            return RESTART_M
        step = self._T_world_filter.between(T_world_ego)
        distance = float(np.hypot(step.x_m, step.y_m))
        if distance < MIN_STEP_M:
            self._stationary_updates += 1
            return None if self._stationary_updates > STATIONARY_UPDATES else MIN_STEP_M
        self._stationary_updates = 0
        self._filter.predict(step)
        self._T_world_filter = T_world_ego
        self._drop_invalid_lines()
        for track in self._tracks:
            track.seen_from_m -= step.x_m
            track.seen_to_m -= step.x_m
        return distance

    def _drop_invalid_lines(self) -> None:
        """Drops lines with an implausible state."""
        kept = np.flatnonzero(self._filter.valid_lines())
        if len(kept) < len(self._tracks):
            self._filter.keep(kept)
            self._tracks = [self._tracks[k] for k in kept.tolist()]

    def _search(
        self, view: RoadView, paint: LinePoints, sigma_tilt_rad: float
    ) -> tuple[Shape | None, list[tuple[int, Peak]]]:
        """Returns the lines of the first image with their classes, and their common shape."""
        left, right = edge_points(view, np.zeros(len(view.x_m)))
        edges = (replace(edge, weight=EDGE_WEIGHT_RATIO * edge.weight) for edge in (left, right))
        shape = find_shape(_join(paint, *edges), self._height_m, sigma_tilt_rad)
        if shape is None:
            return None, []
        curve = np.array([0.0, shape.heading, shape.curvature_per_m, 0.0])
        found = self._find(PAINT, paint, shape, curve)
        if found:  # paint gives the heading more precisely than a mask
            curve[1] = np.average([p.heading for _, p in found], weights=[p.evidence_m for _, p in found])
            lines = np.tile(curve, (len(found), 1))
            lines[:, 0], lines[:, 1] = np.array([(p.offset_m, p.heading) for _, p in found]).T
            left, right = self._borders(view, lines, Tilt(shape.tilt_rad), left, right)
        found += self._find(LEFT_EDGE, left, shape, curve) + self._find(RIGHT_EDGE, right, shape, curve)
        return shape, found

    def _find(self, kind: int, points: LinePoints, shape: Shape, curve: Floats) -> list[tuple[int, Peak]]:
        min_m, most = (MIN_PAINT_M, MAX_LINES - 2) if kind == PAINT else (MIN_EDGE_M, 1)
        turned = points.tilted(self._height_m, shape.tilt_rad)
        return [(kind, peak) for peak in find_lines(turned, curve, min_m, MIN_SPACING_M, most)]

    def _borders(
        self, view: RoadView, paint: Floats, tilt: Tilt, left: LinePoints, right: LinePoints
    ) -> tuple[LinePoints, LinePoints]:
        """The edges' points; where the ego's lane has `paint` (n, 4) on one side only, those of its other border."""
        y_m = paint @ basis(np.array([AT_M]))[0]
        near = sorted(np.flatnonzero(np.abs(y_m) < MAX_STRIP_M), key=lambda k: abs(y_m[k]))
        bounds = [next((k for k in near if side * y_m[k] > 0.0), None) for side in (1, -1)]
        if None not in bounds and abs(y_m[bounds[0]] - y_m[bounds[1]]) < MAX_LANE_M:
            return left, right
        if near and near[0] == bounds[0]:  # of two that are too far apart the nearer is the ego's
            right = border_points(view, *self._in_rows(view, paint[near[0]], tilt), -1, right)
        elif near:
            left = border_points(view, *self._in_rows(view, paint[near[0]], tilt), 1, left)
        return left, right

    def _in_rows(self, view: RoadView, curve: Floats, tilt: Tilt) -> tuple[Floats, Floats]:
        """A line's y in each row of the view, and metres of the view per metre of the road."""
        on_road_m, _ = tilt.applied(view.x_m, np.zeros(len(view.x_m)), self._height_m)
        stretch = view.x_m / on_road_m
        return (basis(on_road_m) @ curve) * stretch, stretch

    def _restart_filter(self, shape: Shape | None, found: list[tuple[int, Peak]]) -> float:
        """Restarts the filter with these lines; returns their tilt."""
        self._tracks = [Track(kind, score=1.0) for kind, _ in found]
        if shape is None:
            self._filter = LineFilter()
            return 0.0
        self._filter.restart(
            np.array([peak.offset_m for _, peak in found]),
            np.array([peak.heading for _, peak in found]),
            shape.curvature_per_m,
            np.array([kind != PAINT for kind, _ in found], dtype=bool),
        )
        return shape.tilt_rad

    def _correct(
        self,
        view: RoadView,
        paint: LinePoints,
        sigma_pitch_rad: float,
        travelled_m: float,
        first_tilt_rad: float,
        level: bool,
    ) -> tuple[LinePoints, Ints, list[Support]]:
        """Corrects the filter by one image. Returns its points, their classes and the support of each line."""
        points, of = self._with_edges(view, paint, Tilt(first_tilt_rad, float(self._filter.common[VERTICAL])))
        classes = np.array([track.kind for track in self._tracks])
        seen, self.tilt = self._filter.update(
            points, of, classes, self._height_m, sigma_pitch_rad, travelled_m, first_tilt_rad, level
        )
        return points, of, seen

    def _is_lost(self, view: RoadView, points: LinePoints, explained_m: float) -> bool:
        """Whether most paint and edges by a network lie on none of the lines, though these are in view.

        Where vehicles hide all of them, the paint beside is another line's and says nothing of theirs.
        """
        near_m = float(points.weight[points.masked & (points.x_m < MAX_SEARCH_M)].sum())
        if near_m <= LOST_M or explained_m >= LOST_RATIO * near_m:
            return False
        there = (view.x_m > NEAR_M) & (view.x_m < MAX_SEARCH_M)
        painted = [k for k, track in enumerate(self._tracks) if track.kind == PAINT]
        in_view_m = [view.row_m[there & self._visible_rows(view, k)].sum() for k in painted]
        return not painted or max(in_view_m) > IN_VIEW_M

    def _with_edges(self, view: RoadView, paint: LinePoints, tilt: Tilt) -> tuple[LinePoints, Ints]:
        """All points of the image, and the class of each; edges are looked for from the way ahead."""
        shape = self._filter.curves[self._reference()].copy()
        shape[0] = 0.0
        left, right = edge_points(view, basis(view.x_m) @ shape)
        painted = self._filter.curves[[track.kind == PAINT for track in self._tracks]]
        left, right = self._borders(view, painted, tilt, left, right)
        of = np.repeat([PAINT, LEFT_EDGE, RIGHT_EDGE], [len(paint), len(left), len(right)])
        return _join(paint, left, right), of

    def _reference(self) -> int:
        """Returns the line with the smallest covariance."""
        return int(np.argmin([self._filter.across_sigma_m(k, np.array([15.0]))[0] for k in range(len(self._tracks))]))

    def _update_scores(self, view: RoadView, points: LinePoints, seen: list[Support]) -> None:
        """Updates the scores of the lines, their ranges and their share of paint."""
        contested = self._find_contested(points, seen)
        for k, (track, support) in enumerate(zip(self._tracks, seen, strict=True)):
            x = view.x_m
            clear = self._visible_rows(view, k)
            visible_m = float(view.row_m[clear & (x > NEAR_M) & (x < FAR_M)].sum())
            mine = points.of(support.points)
            support_m = _length_m(mine)
            track.evidence_m += support_m
            if support_m >= MIN_SEEN_PAINT_M:
                track.score = min(track.score + (1.0 if mine.masked.mean() > 0.3 else 0.5), MAX_SCORE)
                track.seen_from_m = (
                    min(track.seen_from_m, float(mine.x_m.min())) if track.looks else float(mine.x_m.min())
                )
                track.seen_to_m = max(track.seen_to_m, float(np.quantile(mine.x_m, 0.98)))
            elif visible_m > IN_VIEW_M:
                track.score -= CONTESTED_COST_RATIO if k in contested else 1.0
            near = (x > PROFILE_M[0]) & (x < PROFILE_M[1]) & clear
            length_m = float(view.row_m[near].sum())
            if length_m > 6.0 and track.kind == PAINT:
                profile = (mine.x_m > PROFILE_M[0]) & (mine.x_m < PROFILE_M[1])
                rows_seen = len(np.unique(mine.x_m[profile]))
                share = min(1.0, rows_seen / max(1, int(near.sum())))
                track.looks = min(track.looks + 1.0, 8.0)
                track.painted += (share - track.painted) / track.looks
                yellow = mine.yellow[profile & np.isfinite(mine.yellow)]
                if len(yellow):
                    track.coloured = min(track.coloured + 1.0, 8.0)
                    track.yellow += (float(np.median(yellow)) - track.yellow) / track.coloured
                double = double_line_share(view, mine.of(profile))
                if double is not None:
                    track.resolved = min(track.resolved + 1.0, 8.0)
                    track.double += (double - track.double) / track.resolved
            elif track.kind != PAINT:
                track.looks += 1.0

    def _visible_rows(self, view: RoadView, k: int) -> Bools:
        """(R,) whether a line is visible in each row of the view."""
        y_m, _ = self._in_rows(view, self._filter.curves[k], self.tilt)
        column = np.round((y_m - view.y_m[0]) / LATTICE_M).astype(np.int64)
        rows, at = np.arange(len(y_m)), np.clip(column, 0, len(view.y_m) - 1)
        out: Bools = (column == at) & ~view.outside[rows, at] & ~view.hidden[rows, at]
        return out

    def _find_contested(self, points: LinePoints, seen: list[Support]) -> set[int]:
        """Returns the lines near a confirmed, visible painted line: lines of one road neither meet nor cross."""
        ys = self._filter.curves @ basis(np.arange(NEAR_M, FAR_M, 2.0)).T
        there = [
            j
            for j, (track, support) in enumerate(zip(self._tracks, seen, strict=True))
            if track.kind == PAINT and track.line >= 0 and _length_m(points.of(support.points)) >= MIN_SEEN_PAINT_M
        ]
        return {
            k
            for k, track in enumerate(self._tracks)
            if track.kind == PAINT and any(j != k and np.abs(ys[j] - ys[k]).min() < MIN_LANE_WIDTH_M for j in there)
        }

    def _add_lines(self, points: LinePoints, of: Ints, seen: list[Support], height_m: float) -> None:
        """Adds lines from points on no known line."""
        free = np.ones(len(points), bool)
        for support in seen:
            free[support.points] = False
        like = self._reference()
        curve = self._filter.curves[like]
        at = basis(np.array([10.0]))[0]
        turned = points.tilted(height_m, self.tilt.tangent_rad, self.tilt.vertical_per_m)
        for kind, min_m in ((PAINT, MIN_PAINT_M), (LEFT_EDGE, MIN_EDGE_M), (RIGHT_EDGE, MIN_EDGE_M)):
            if kind != PAINT and any(track.kind == kind for track in self._tracks):
                continue
            mine = turned.of(free & (of == kind))
            for peak in find_lines(mine, curve, min_m, MIN_SPACING_M, 3 if kind == PAINT else 1):
                there = at @ np.array([peak.offset_m, peak.heading, curve[2], curve[3]])
                known = self._filter.curves @ at
                taken = [
                    abs(there - y) < MIN_SPACING_M for y, t in zip(known, self._tracks, strict=True) if t.kind == kind
                ]
                if any(taken) or len(self._tracks) >= MAX_LINES:
                    continue
                self._filter.add(peak.offset_m, peak.heading, like, kind != PAINT)
                self._tracks.append(Track(kind, score=1.0))

    def _drop_lines(self) -> None:
        """Drops lines that are no longer seen, end behind the ego, or coincide with another."""
        kept: list[int] = []
        x = np.array([5.0, 12.0, 20.0])
        ys = self._filter.curves @ basis(x).T
        for k in sorted(range(len(self._tracks)), key=lambda k: -self._tracks[k].score):
            track = self._tracks[k]
            if track.looks >= MIN_IMAGES and existence_of(track) < MIN_EXISTENCE:
                continue
            if track.score <= 0.0 or (track.looks and track.seen_to_m < MIN_END_M):
                continue
            if any(self._tracks[j].kind == track.kind and np.all(np.abs(ys[j] - ys[k]) < SAME_M) for j in kept):
                continue
            kept.append(k)
        kept.sort()
        self._filter.keep(np.array(kept, dtype=np.int64))
        self._tracks = [self._tracks[k] for k in kept]
        for track in self._tracks:
            if track.line < 0 and (track.score >= CONFIRMED or track.evidence_m >= self._confirmation_m):
                track.line, self._next = self._next, self._next + 1

    def lines(self) -> TrackedLines:
        """Returns a copy of the confirmed lines after the last update."""
        sure = [k for k, track in enumerate(self._tracks) if track.line >= 0]
        return TrackedLines(
            self._T_world_filter or SE2(),
            tuple(msgspec.structs.replace(self._tracks[k]) for k in sure),
            self._filter.curves[sure].copy(),
            np.array([self._filter.block(k) for k in sure]).reshape(-1, 4, 4),
            self.tilt,
            self._height_m,
            self._sigma_roll_rad,
            self._road_from_m,
            self._filter.vertical,
        )


def _measure_explained_m(points: LinePoints, seen: list[Support]) -> float:
    """Metres of a network's paint and edges that lie on lines."""
    mine = np.concatenate([np.zeros(0, np.int64), *(support.points for support in seen)])
    return float(points.weight[mine][points.masked[mine] & (points.x_m[mine] < MAX_SEARCH_M)].sum())


def _length_m(points: LinePoints) -> float:
    return float(np.minimum(points.weight, 1.0).sum())


def _join(*parts: LinePoints) -> LinePoints:
    return LinePoints(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(LinePoints)))


def find_lines_in_image(
    camera: Camera, image: NDArray[np.uint8], segmentation: Segmentation, boxes_px: Floats
) -> tuple[tuple[LaneLine, ...], GroundPlane]:
    """The lines of a single image, and the ground under its camera with the pitch that makes them parallel."""
    tracker = LineTracker(camera, certain_m=MIN_PAINT_M)  # there will be no other
    tracker.update(SE2(), camera.ground, (camera.tilt_sigma_rad,) * 2, image, segmentation, boxes_px, search_tilt=True)
    ground = GroundPlane(camera.height_m, camera.pitch_rad + tracker.tilt.pitch_rad, camera.roll_rad)
    return tracker.lines().at(SE2()), ground
