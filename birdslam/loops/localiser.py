"""Localises the ego in a map frame by frame: recognition, confirmation, tracking, loss.

A recognised place must be confirmed by two further frames. Then a Kalman filter corrects odometry's prediction by each
frame's fix. The errors of the map are common to all fixes; they are added to the reported covariance (a consider state,
Schmidt 1966).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import MIN_SCALE_REL, Steps, drift_after, is_exact, moved
from birdslam.loops.features import Features
from birdslam.loops.map_pose import MapState
from birdslam.loops.place_map import PlaceMap
from birdslam.loops.verification import Fix, locate
from birdslam.types import Attitude, Estimate

CANDIDATES = 6  # places verified geometrically per frame
LOOK_UP_EVERY_M = 4.0  # interval of queries of the index on a road that is not in the map
FOUND_INLIERS, FOUND_PLACES = 25, 7  # minimum for a frame without a prediction
FOUND_RATIO = 0.3  # min. inlier ratio of its matches
KEPT_INLIERS, KEPT_PLACES = 18, 6  # minimum for a frame with a prediction
ENOUGH_INLIERS = 40  # with fewer inliers farther keyframes are matched too
CONFIRMATIONS = 2  # required further frames
KIDNAPPED_CONFIRMATIONS = 12  # if they contradict odometry since the last fix
MAX_HYPOTHESES = 4
HYPOTHESIS_M = 30.0  # max. distance travelled without a confirmation
CHI2_GATE = 16.27  # three degrees of freedom, 99.9 %
FOLLOWED_M = 30.0  # max. distance travelled since the last fix for tracking
FOLLOW_M = 12.0  # max. distance of matched keyframes
SEARCH_PX, MAX_SEARCH_PX = 25.0, 120.0
MAX_DISTANCE_M, MIN_STEP_M = 1e5, 0.1
# Common error of fixes by one keyframe, per metre of distance along its axis and across: its points were triangulated
# along its axis, so that their common depth error appears from the side
ALONG_REL, ASIDE_REL = 0.006, 0.02
SHARED_YAW_RAD, ASIDE_YAW_RAD_PER_M = 0.0003, 0.0007
SAME_POINTS_M = 2.0  # distance travelled within which fixes see the same points and count as one
MISSED_REL = 0.1  # 1-sigma of the distance since the last fix, if a predicted frame did not match the map


@dataclass(frozen=True, eq=False)
class Localisation:
    """The localisation of one frame."""

    frame_id: int
    t_source_ns: int
    state: MapState
    T_map_ego: SE2 | None  # None: lost
    cov: Floats  # (3, 3) of the tangent at the pose; infinite where lost
    attitude: Attitude  # of the ego in the map's frame, by the last fix
    inliers: int = 0  # of this frame's fix; 0: predicted by odometry
    map_epoch: int = 0  # increased when T_map_odom jumps


@dataclass(eq=False)
class _Hypothesis:
    """An unconfirmed pose of the ego."""

    T_map_odom: SE2
    cov: Floats
    travelled_m: float
    confirmed: int = 0
    kidnapped: bool = False  # contradicts odometry since the last fix


class Localiser:
    """Localises frames with odometry in one map."""

    def __init__(self, camera: Camera, place_map: PlaceMap) -> None:
        self._camera = camera
        self.map = place_map
        self.map_epoch = 0
        self.fix: Fix | None = None  # of the newest frame
        self.attitude = Attitude()  # in the map's frame, by the last fix
        self.travelled_m = 0.0
        self._T_odom_ego: SE2 | None = None
        self.steps = Steps()
        self._scale_rel = 0.0  # odometry's 1-sigma of its scale
        self._T_map_ego: SE2 | None = None
        self._cov: Floats = np.zeros((3, 3))
        self._shared: Floats = np.zeros((3, 3))
        self._hypotheses: list[_Hypothesis] = []
        self.since_fix_m = math.inf
        self._missed = False  # whether a frame since the last fix did not match the map
        self.own_way_m: dict[int, float] = {}  # rows of this drive's keyframes -> distance travelled
        self.was_kidnapped = False  # the newest fix contradicted odometry
        self._looked_up_m = -math.inf  # distance travelled at the last query of the index

    @property
    def T_map_odom(self) -> SE2 | None:
        """The transform between the frames of REP-105; None when lost."""
        if self._T_map_ego is None or self._T_odom_ego is None:
            return None
        return self._T_map_ego @ self._T_odom_ego.inverse()

    @property
    def cov(self) -> Floats:
        """Covariance (3, 3) of the pose in the map, including the common errors of fixes."""
        scale_rel = max(MISSED_REL if self._missed else MIN_SCALE_REL, self._scale_rel)
        scale_m = scale_rel * min(self.since_fix_m, MAX_DISTANCE_M)
        return self._cov + self._shared + np.diag([scale_m**2, scale_m**2, 0.0])

    @property
    def state(self) -> MapState:
        if self._T_map_ego is None:
            return MapState.LOST
        exact = self.since_fix_m < math.inf and is_exact(self.cov)
        return MapState.LOCALISED if exact else MapState.ODOMETRY_ONLY

    def place(self, T_map_ego: SE2, T_odom_ego: SE2, cov: Floats, since_fix_m: float = math.inf) -> None:
        """Sets a known pose: the origin of a new map, or the last pose of another process."""
        self._T_map_ego, self._T_odom_ego, self._cov = T_map_ego, T_odom_ego, cov
        self.since_fix_m = since_fix_m

    def shift(self, T_new_old: SE2) -> None:
        """Applies a correction of the map: a pose T becomes T_new_old @ T."""
        if self._T_map_ego is not None:
            self._T_map_ego = T_new_old @ self._T_map_ego
        for hypothesis in self._hypotheses:
            hypothesis.T_map_odom = T_new_old @ hypothesis.T_map_odom
        self.map_epoch += 1

    def lose(self) -> None:
        """Resets the localiser after a restart of odometry."""
        self._T_map_ego, self._T_odom_ego = None, None
        self.steps = Steps()
        self._hypotheses.clear()
        self.since_fix_m = math.inf

    def move(self, estimate: Estimate) -> None:
        """Predicts the pose by odometry, with its reported uncertainty."""
        T_odom_ego, scale_rel = estimate.T_world_ego, estimate.scale_sigma_rel
        error_m, self._scale_rel = self.steps.add(estimate), scale_rel
        if self._T_odom_ego is not None:
            step = self._T_odom_ego.between(T_odom_ego)
            way_m = math.hypot(step.x_m, step.y_m)
            self.travelled_m += way_m
            self.since_fix_m += way_m
            if self._T_map_ego is not None:
                self._T_map_ego = self._T_map_ego @ step
                self._cov = moved(self._cov, step, estimate.valid, scale_rel, error_m)
            for hypothesis in self._hypotheses:
                hypothesis.cov = moved(hypothesis.cov, step, estimate.valid, scale_rel, error_m)
        self._T_odom_ego = T_odom_ego

    def look(self, features: Features, among: Bools | None = None) -> bool:
        """Corrects the predicted pose by a frame; `among`: allowed keyframes. Returns whether there was a fix."""
        self.fix = None
        if self._T_odom_ego is None or not len(self.map):
            return False
        fix = None
        if self._T_map_ego is not None and self.since_fix_m < FOLLOWED_M:
            fix = self._follow(features, self._T_map_ego, self.cov, among)
            if fix is not None and self.state is MapState.LOCALISED:
                self._correct(fix)
                return True
            if fix is None:
                self._missed = bool(self.map.near(self._T_map_ego, FOLLOW_M, among))
        return self._recognise(features, among, fix)

    def _follow(self, features: Features, guess: SE2, cov: Floats, among: Bools | None) -> Fix | None:
        """Returns a fix near the predicted pose if it passes the tests of inliers and chi-square."""
        rows = self.map.near(guess, FOLLOW_M, among)
        if not rows:
            return None
        sigma_rad = math.sqrt(cov[2, 2]) + math.sqrt(max(cov[0, 0], cov[1, 1])) / 10.0  # of a point 10 m away
        radius_px = min(SEARCH_PX + 3.0 * sigma_rad * self._camera.fx_px, MAX_SEARCH_PX)
        T_keyframe_ego = self.map.keyframes[rows[0]].T_map_keyframe.between(guess)
        fix = None
        for far in (False, True):
            found = locate(self._camera, features, self.map.around(rows[0], among, far), T_keyframe_ego, radius_px)
            fix = found if fix is None or (found is not None and found.inliers > fix.inliers) else fix
            if fix is not None and fix.inliers >= ENOUGH_INLIERS:
                break
        if fix is None or fix.inliers < KEPT_INLIERS or fix.places < KEPT_PLACES:
            return None
        error = guess.between(fix.T_map_ego).log()
        total = cov + fix.cov + shared(fix)
        return fix if float(error @ np.linalg.solve(total, error)) < CHI2_GATE else None

    def _correct(self, fix: Fix) -> None:
        assert self._T_map_ego is not None
        error = self._T_map_ego.between(fix.T_map_ego).log()
        fixes = max(SAME_POINTS_M / max(self.since_fix_m, MIN_STEP_M), 1.0)
        gain = self._cov @ np.linalg.inv(self._cov + fixes * fix.cov)
        self._T_map_ego = self._T_map_ego @ SE2.exp(gain @ error)
        self._cov = (np.eye(3) - gain) @ self._cov
        self._cov = 0.5 * (self._cov + self._cov.T)
        self._shared = shared(fix)
        self.attitude = fix.attitude_in_map(self._camera)
        self.fix, self.since_fix_m, self._missed = fix, 0.0, False

    def _recognise(self, features: Features, among: Bools | None, foreseen: Fix | None) -> bool:
        """Confirms hypotheses, or creates new ones by place recognition.

        `foreseen`: the fix near odometry's prediction. When not localised it must pass the same tests as without a
        prediction, since a wrong prediction may lead to a wrong fix.
        """
        assert self._T_odom_ego is not None
        self._hypotheses = [h for h in self._hypotheses if self.travelled_m - h.travelled_m < HYPOTHESIS_M]
        for hypothesis in sorted(self._hypotheses, key=lambda h: -h.confirmed):
            fix = self._follow(features, hypothesis.T_map_odom @ self._T_odom_ego, hypothesis.cov, among)
            if fix is None:
                continue
            hypothesis.confirmed += 1
            enough = KIDNAPPED_CONFIRMATIONS if hypothesis.kidnapped else CONFIRMATIONS
            hypothesis.T_map_odom = fix.T_map_ego @ self._T_odom_ego.inverse()
            hypothesis.cov = fix.cov + shared(fix)
            if hypothesis.confirmed >= enough:
                self.was_kidnapped = hypothesis.kidnapped
                self._accept(fix)
                return True
            return False
        if foreseen is not None and is_place(foreseen):
            self._add_hypothesis(foreseen, kidnapped=False)
            return False
        unknown = self._T_map_ego is not None and not self._missed  # not in the map, as all of a new map
        if unknown and self.travelled_m - self._looked_up_m < LOOK_UP_EVERY_M:
            return False
        self._looked_up_m = self.travelled_m
        for row in self.map.index().look_up(features.descriptors, CANDIDATES, among):
            found = locate(self._camera, features, self.map.around(row, among), None)
            if found is None or not is_place(found):
                continue
            kidnapped = self._contradicts(found, row)
            if kidnapped and row in self.own_way_m:  # a similar street of the same drive
                continue
            self._add_hypothesis(found, kidnapped)
            break
        return False

    def _add_hypothesis(self, fix: Fix, kidnapped: bool) -> None:
        assert self._T_odom_ego is not None
        T_map_odom, cov = fix.T_map_ego @ self._T_odom_ego.inverse(), fix.cov + shared(fix)
        new = _Hypothesis(T_map_odom, cov, self.travelled_m, kidnapped=kidnapped)
        self._hypotheses = [*self._hypotheses, new][-MAX_HYPOTHESES:]

    def _contradicts(self, fix: Fix, row: int) -> bool:
        """Tests a fix by chi-square against the drift since the drive's own keyframe, or since the last fix."""
        if self._T_map_ego is None:
            return False
        way_m = self.travelled_m - self.own_way_m[row] if row in self.own_way_m else self.since_fix_m
        if not math.isfinite(way_m):
            return False
        error = self._T_map_ego.between(fix.T_map_ego).log()
        return float(error @ np.linalg.solve(drift_after(way_m) + fix.cov, error)) > CHI2_GATE

    def _accept(self, fix: Fix) -> None:
        self._T_map_ego, self._cov = fix.T_map_ego, fix.cov
        self._shared = shared(fix)
        self.attitude = fix.attitude_in_map(self._camera)
        self.fix, self.since_fix_m, self._missed = fix, 0.0, False
        self.map_epoch += 1
        self._hypotheses.clear()


def is_place(fix: Fix) -> bool:
    """Whether a fix without a prediction is plausible."""
    return fix.inliers >= FOUND_INLIERS and fix.places >= FOUND_PLACES and fix.inliers >= FOUND_RATIO * fix.matches


def shared(fix: Fix) -> Floats:
    """Returns the covariance (3, 3) of the error common to all fixes here."""
    x_m, y_m = fix.T_keyframe_ego.x_m, fix.T_keyframe_ego.y_m
    variance_m2 = (ALONG_REL * x_m) ** 2 + (ASIDE_REL * y_m) ** 2
    return np.diag([variance_m2, variance_m2, SHARED_YAW_RAD**2 + (ASIDE_YAW_RAD_PER_M * y_m) ** 2])
