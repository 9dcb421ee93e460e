"""Localisation of one drive in a map, and mapping. Not real-time.

Frames as in REP-105: `T_map_odom` relates odometry's frame, which does not jump, to the map frame, with its own epoch.
Keyframes of a drive that is not localised yet are queued.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops, held
from birdslam.loops.drift import link_cov, moved, own_scale_rel
from birdslam.loops.features import FeatureExtractor
from birdslam.loops.keyframe import Keyframe, Link
from birdslam.loops.keyframe_builder import LOOK_M, LOOK_NS, KeyframeBuilder, Look, NewKeyframe
from birdslam.loops.localiser import Localisation, Localiser, shared
from birdslam.loops.map_pose import MapPose, MapState
from birdslam.loops.place_map import PlaceMap
from birdslam.types import Estimate

COVERED_M = 2.5  # no new keyframe within this distance of one that the drive was localised by
COVERED_INLIERS = 40
OWN_WAY_M = 60.0  # min. distance travelled since an own keyframe that can close a loop
JOINT_EVERY_M = 25.0  # interval of keyframes on known streets, which link odometry to the map
LOOP_EVERY_M = 8.0  # between two links to the map
CLOSE_EVERY_M = 50.0  # min. distance travelled between two optimizations of the map
FIRST_COV = np.diag([1e-6, 1e-6, 1e-8])


class MapSession:
    """`step` takes each frame with its estimate, in order; `finish` ends the drive."""

    def __init__(
        self, camera: Camera, place_map: PlaceMap, extend: bool, extract: FeatureExtractor | None = None
    ) -> None:
        self.map = place_map
        self._camera = camera
        self._extend = extend
        self._extract = extract or FeatureExtractor()
        self._new_map = not len(place_map)
        self._drive = place_map.drives
        self.localiser = Localiser(camera, place_map)
        self._builder = KeyframeBuilder(camera, self._drive)
        self._waiting: list[NewKeyframe] = []
        self._epoch: int | None = None
        self._last: Estimate | None = None
        self._travelled_m = 0.0
        self._looked_m, self._looked_ns = -math.inf, -(1 << 62)
        self._own: list[tuple[int, float]] = []  # rows of this drive's keyframes, distance travelled
        self._chain: tuple[int, SE2, float] | None = None  # the last keyframe: number, T_odom_keyframe, Look.unsure_m2
        self._linked_m, self._joint_m = -math.inf, -math.inf
        self._fixes: list[tuple[float, SE2, int, SE2, Floats]] = []
        self._open_loops, self._closed_m = 0, -math.inf  # loops since the last optimization, distance travelled there
        self._resumed: MapPose | None = None
        self.lost_keyframes = 0  # keyframes without a pose in the map

    def step(self, estimate: Estimate, image: NDArray[np.uint8] | None) -> Localisation:
        """Processes a frame; returns its localisation."""
        looked = image is not None and self.due(estimate)
        self._move(estimate)
        if self._extend:
            self._builder.nodes.add(estimate, self._travelled_m)
        if looked:
            assert image is not None
            self._look(estimate, image)
        if self._open_loops and self._travelled_m - self._closed_m >= CLOSE_EVERY_M:
            self._optimise()
        localiser = self.localiser
        fix = localiser.fix if looked else None
        lost = localiser.state is MapState.LOST
        return Localisation(
            estimate.frame_id,
            estimate.t_source_ns,
            localiser.state,
            None if lost else localiser.T_map_odom @ estimate.T_world_ego,  # type: ignore[operator]
            np.full((3, 3), np.inf) if lost else localiser.cov,
            localiser.attitude,
            0 if fix is None else fix.inliers,
            localiser.map_epoch,
        )

    def resume(self, pose: MapPose) -> None:
        """Continues from the last pose of another session of the same drive; call it before the first step."""
        self._resumed = pose

    def due(self, estimate: Estimate) -> bool:
        """Whether the image of the next frame is processed."""
        way_m = self._travelled_m + self._step_m(estimate) - self._looked_m
        return way_m >= LOOK_M or (way_m > 0.0 and estimate.t_source_ns - self._looked_ns >= LOOK_NS)

    def finish(self) -> None:
        """Adds the last keyframes, optimizes the map and learns its index."""
        if not self._extend:
            return
        self._take(self._builder.finish())
        self.lost_keyframes += len(self._waiting)
        self._waiting = []
        if self._own:
            self._optimise()
            self.map.learn()

    def _optimise(self) -> None:
        """Optimizes the map if it has loops; the ego moves with the newest keyframe."""
        self._open_loops, self._closed_m = 0, self._travelled_m
        if not any(link.loop for link in self.map.links):
            return
        newest = self.map.keyframes[-1]
        poses = close_loops(self.map.keyframes, self.map.links)
        self.map.links = held(self.map.links, poses)
        self.map.place(poses)
        if newest.drive == self._drive:
            self.localiser.shift(poses[newest.number][0] @ newest.T_map_keyframe.inverse())

    def _move(self, estimate: Estimate) -> None:
        if estimate.epoch != self._epoch:
            self._begin(estimate)
        self._travelled_m += self._step_m(estimate)
        self._last = estimate
        self.localiser.move(estimate)
        if self._new_map and self._extend and not len(self.map) and not estimate.valid:
            self._place_origin(estimate)

    def _step_m(self, estimate: Estimate) -> float:
        """Returns the distance from the previous frame, within one epoch of odometry."""
        if self._last is None or estimate.epoch != self._last.epoch:
            return 0.0
        step = self._last.T_world_ego.between(estimate.T_world_ego)
        return math.hypot(step.x_m, step.y_m)

    def _begin(self, estimate: Estimate) -> None:
        """Starts an epoch of odometry; the frame of a new map is that of its first drive."""
        if self._epoch is not None:
            self._take(self._builder.finish())
            self.lost_keyframes += len(self._waiting)
            self._waiting, self._chain = [], None
            self._builder = KeyframeBuilder(self._camera, self._drive)
            self.localiser.lose()
        elif self._resumed is not None and self._resumed.epoch == estimate.epoch:
            self._resume_at(self._resumed)
        elif self._new_map and self._extend:
            self._place_origin(estimate)
        self._epoch = estimate.epoch

    def _place_origin(self, estimate: Estimate) -> None:
        """Sets the origin of a new map at the current frame."""
        self.localiser.place(estimate.T_world_ego, estimate.T_world_ego, FIRST_COV)

    def _resume_at(self, pose: MapPose) -> None:
        """Continues from a pose of this epoch; an odometry link connects the last keyframe to the next one."""
        if pose.T_map_odom is None or pose.T_odom_ego is None or pose.cov is None:
            return
        since_fix_m = math.inf if pose.state is MapState.ODOMETRY_ONLY else 0.0
        cov = np.array(pose.cov).reshape(3, 3)
        self.localiser.place(pose.T_map_odom @ pose.T_odom_ego, pose.T_odom_ego, cov, since_fix_m)
        self.localiser.map_epoch = pose.map_epoch
        if len(self.map):
            last = self.map.keyframes[-1]
            self._chain = last.number, pose.T_map_odom.inverse() @ last.T_map_keyframe, 0.0

    def _look(self, estimate: Estimate, image: NDArray[np.uint8]) -> None:
        self._looked_m, self._looked_ns = self._travelled_m, estimate.t_source_ns
        features = self._extract(image)
        look = Look(
            estimate.frame_id,
            estimate.t_source_ns,
            self._travelled_m,
            estimate.T_world_ego,
            estimate.attitude,
            features,
            own_scale_rel(estimate.scale_sigma_rel, self._camera.scale_sigma_rel),
            self.localiser.steps.sum_m2,
        )
        was_lost = self.localiser.state is MapState.LOST
        if self.localiser.look(features, self._among()):
            self._remember_fix(look)
            if self.localiser.was_kidnapped:
                self._chain, self._fixes, self.localiser.was_kidnapped = None, [], False
            if was_lost and self._waiting:
                waiting, self._waiting = self._waiting, []
                self._take(waiting)
        if self._extend and estimate.valid:
            self._take(self._builder.add(look))

    def _among(self) -> Bools | None:
        """Returns the keyframes allowed for localisation: all but the drive's latest ones."""
        recent = [row for row, way_m in self._own if self._travelled_m - way_m < OWN_WAY_M]
        if not recent:
            return None
        out = np.ones(len(self.map), bool)
        out[recent] = False
        return out

    def _remember_fix(self, look: Look) -> None:
        """Stores the fix for a link of the pose graph."""
        fix = self.localiser.fix
        if fix is not None and self._travelled_m - self._linked_m >= LOOP_EVERY_M:
            self._linked_m = self._travelled_m
            cov = fix.cov + shared(fix)
            self._fixes.append((look.travelled_m, look.T_odom_ego, fix.keyframe.number, fix.in_odometry, cov))

    def _take(self, made: list[NewKeyframe]) -> None:
        for new in made:
            T_map_odom = self.localiser.T_map_odom
            if T_map_odom is None:
                self._waiting.append(new)
            else:
                self._add(new, T_map_odom @ new.look.T_odom_ego)

    def _add(self, new: NewKeyframe, T_map_keyframe: SE2) -> None:
        covered = self.map.near(T_map_keyframe, COVERED_M, self._among())
        fix = self.localiser.fix
        joint = bool(self._fixes) and new.look.travelled_m - self._joint_m > JOINT_EVERY_M
        if covered and fix is not None and fix.inliers >= COVERED_INLIERS and not joint:
            self._give_lines(covered[0], new, T_map_keyframe)
            return
        number = self.map.next_number
        cov = self._cov_at(new)
        self.map.add(
            Keyframe(
                number,
                self._drive,
                new.look.t_source_ns,
                T_map_keyframe,
                cov,
                new.look.attitude,
                new.points_m,
                new.sigma_depth_rel,
                new.descriptors,
                self._camera.height_m,
                lines=new.lines,
            )
        )
        self.map.drives = self._drive + 1
        self._own.append((len(self.map) - 1, new.look.travelled_m))
        self.localiser.own_way_m[len(self.map) - 1] = new.look.travelled_m
        if self._chain is not None:
            (last, T_odom_last, unsure_m2), scale_rel = self._chain, new.look.scale_rel
            step = T_odom_last.between(new.look.T_odom_ego)
            self.map.links.append(
                Link(last, number, step, link_cov(step, scale_rel, new.look.unsure_m2 - unsure_m2), scale_rel=scale_rel)
            )
        self._close(new, number)
        self._chain = number, new.look.T_odom_ego, new.look.unsure_m2

    def _give_lines(self, row: int, new: NewKeyframe, T_map_keyframe: SE2) -> None:
        """Adds the lines to the map's keyframe at this place, if it has none."""
        old = self.map.keyframes[row]
        if not old.lines:
            T_old_new = old.T_map_keyframe.between(T_map_keyframe)
            self.map.keyframes[row] = replace(old, lines=tuple(piece.seen_from(T_old_new) for piece in new.lines))

    def _cov_at(self, new: NewKeyframe) -> Floats:
        """Returns the covariance of a keyframe in the map, from the localiser's and the motion since."""
        assert self._last is not None
        step = self._last.T_world_ego.between(new.look.T_odom_ego)
        return moved(self.localiser.cov, step)

    def _close(self, new: NewKeyframe, number: int) -> None:
        """Adds links from the keyframe to the keyframes of nearby fixes."""
        left = []
        for way_m, T_odom_ego, seen, T_seen_ego, cov in self._fixes:
            step = T_odom_ego.between(new.look.T_odom_ego)
            if abs(way_m - new.look.travelled_m) < LOOP_EVERY_M:
                self.map.links.append(Link(seen, number, T_seen_ego @ step, moved(cov, step), loop=True))
                self._joint_m = new.look.travelled_m
                self._open_loops += 1
            elif way_m > new.look.travelled_m:
                left.append((way_m, T_odom_ego, seen, T_seen_ego, cov))
        self._fixes = left
