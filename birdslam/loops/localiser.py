"""Where the ego is in a map, frame by frame: recognised, confirmed, followed, lost.

A place is believed once two further frames, looked at where odometry says that they are, confirm it. From then on each
frame's fix corrects what odometry foresees, in a Kalman filter of the map's motion against odometry; fixes of one map
share its errors, so those are added to what is reported and not averaged away (a consider state, Schmidt 1966).
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

CANDIDATES = 6  # places that are verified by geometry in one frame
RARE_M = 4.0  # of way, from one look-up among all places to the next, for who is on a way that the map does not know
FOUND_INLIERS, FOUND_PLACES = 25, 7  # of a frame that nothing was known of
FOUND_SHARE = 0.3  # of its matches that must fit
KEPT_INLIERS, KEPT_PLACES = 18, 6  # of a frame that was foreseen
ENOUGH_INLIERS = 40  # with fewer, farther keyframes are looked at too
CONFIRMATIONS = 2  # further frames that must say the same
KIDNAPPED_CONFIRMATIONS = 12  # where odometry since the last fix contradicts them: it was cut, or the place is another
HYPOTHESES = 4
HYPOTHESIS_M = 30.0  # after so much way without confirmation one is given up
CHI2_GATE = 16.27  # of three degrees of freedom, 99.9 %
FOLLOWED_M = 30.0  # of way since the last fix, along which the ego is looked for where odometry says
FOLLOW_M = 12.0  # keyframes within it are looked for
SEARCH_PX, MAX_SEARCH_PX = 25.0, 120.0
MAX_DISTANCE_M, MIN_STEP_M = 1e5, 0.1
# What fixes by one keyframe share, by how far the ego is from it along its axis and aside: its points were seen along
# the way only, and what their depths have in common shows from aside. That the car tilts is no such error (foot.py),
# nor that all metres of the map are too long
ALONG_REL, ASIDE_REL = 0.006, 0.02
SHARED_YAW_RAD, ASIDE_YAW_RAD_PER_M = 0.0003, 0.0007
SAME_POINTS_M = 2.0  # of way, along which fixes see the same points: all of them together tell as much as one
# Of the way since the last fix where a frame was looked for and not found: an odometry that is right would have been
MISSED_REL = 0.1


@dataclass(frozen=True, eq=False)
class Localisation:
    """Of one frame."""

    frame_id: int
    t_source_ns: int
    state: MapState
    T_map_ego: SE2 | None  # None: lost
    cov: Floats  # (3, 3) of the tangent at the pose; infinite where lost
    attitude: Attitude  # of the ego in the map's frame, by the last fix
    inliers: int = 0  # of this frame's own fix; 0: carried by odometry
    map_epoch: int = 0  # raised where T_map_odom jumped


@dataclass(eq=False)
class _Hypothesis:
    """A place that the ego may be at, still to be confirmed."""

    T_map_odom: SE2
    cov: Floats
    travelled_m: float
    confirmed: int = 0
    kidnapped: bool = False  # it contradicts what odometry says since the last fix


class Localiser:
    """In one map; poses in odometry come with each frame."""

    def __init__(self, camera: Camera, place_map: PlaceMap) -> None:
        self._camera = camera
        self.map = place_map
        self.map_epoch = 0
        self.fix: Fix | None = None  # of the newest frame
        self.attitude = Attitude()  # in the map's frame, by the last fix
        self.travelled_m = 0.0
        self._T_odom_ego: SE2 | None = None
        self.steps = Steps()
        self._scale_rel = 0.0  # 1-sigma of odometry's metres, by its own word
        self._T_map_ego: SE2 | None = None
        self._cov: Floats = np.zeros((3, 3))
        self._shared: Floats = np.zeros((3, 3))
        self._hypotheses: list[_Hypothesis] = []
        self.since_fix_m = math.inf
        self._missed = False  # since the last fix a frame was looked for in the map, and not found
        self.own_way_m: dict[int, float] = {}  # rows of keyframes that this very drive made: the way at each
        self.was_kidnapped = False  # the newest fix contradicted odometry
        self._looked_up_m = -math.inf  # the way at which a place was last looked up among all of the map

    @property
    def T_map_odom(self) -> SE2 | None:
        """Joins the two frames (REP-105); None where lost."""
        if self._T_map_ego is None or self._T_odom_ego is None:
            return None
        return self._T_map_ego @ self._T_odom_ego.inverse()

    @property
    def cov(self) -> Floats:
        """(3, 3) of the pose in the map, with what fixes share."""
        scale_rel = max(MISSED_REL if self._missed else MIN_SCALE_REL, self._scale_rel)  # all along the way
        scale_m = scale_rel * min(self.since_fix_m, MAX_DISTANCE_M)
        return self._cov + self._shared + np.diag([scale_m**2, scale_m**2, 0.0])

    @property
    def state(self) -> MapState:
        if self._T_map_ego is None:
            return MapState.LOST
        exact = self.since_fix_m < math.inf and is_exact(self.cov)
        return MapState.LOCALISED if exact else MapState.ODOMETRY_ONLY

    def place(self, T_map_ego: SE2, T_odom_ego: SE2, cov: Floats, since_fix_m: float = math.inf) -> None:
        """Begins at a known pose: of a new map its origin, or where another process had come to."""
        self._T_map_ego, self._T_odom_ego, self._cov = T_map_ego, T_odom_ego, cov
        self.since_fix_m = since_fix_m

    def shift(self, T_new_old: SE2) -> None:
        """The map was optimised: what lay at T lies at T_new_old @ T now."""
        if self._T_map_ego is not None:
            self._T_map_ego = T_new_old @ self._T_map_ego
        for hypothesis in self._hypotheses:
            hypothesis.T_map_odom = T_new_old @ hypothesis.T_map_odom
        self.map_epoch += 1

    def lose(self) -> None:
        """Odometry restarted: nothing is known any more."""
        self._T_map_ego, self._T_odom_ego = None, None
        self.steps = Steps()
        self._hypotheses.clear()
        self.since_fix_m = math.inf

    def move(self, estimate: Estimate) -> None:
        """By odometry, as sure as it says that it is."""
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
        """Corrects the pose by a frame at the pose that it has moved to; `among`: keyframes that may be used.

        Says whether a fix came of it.
        """
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
        """A fix where the ego is thought to be, if it is one by inliers and by chi-square."""
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
        """Confirms hypotheses, or makes new ones of places that look alike.

        `foreseen` is where odometry says: who is not localised any more has to find as much as who was lost, since a
        fix from a wrong guess may be a wrong one.
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
                self._believe(fix)
                return True
            return False
        if foreseen is not None and is_place(foreseen):
            self._suppose(foreseen, kidnapped=False)
            return False
        unknown = self._T_map_ego is not None and not self._missed  # a street that the map lacks, as of a new map all
        if unknown and self.travelled_m - self._looked_up_m < RARE_M:
            return False
        self._looked_up_m = self.travelled_m
        for row in self.map.index().look_up(features.descriptors, CANDIDATES, among):
            found = locate(self._camera, features, self.map.around(row, among), None)
            if found is None or not is_place(found):
                continue
            kidnapped = self._contradicts(found, row)
            if kidnapped and row in self.own_way_m:  # a street that looks like an earlier one
                continue
            self._suppose(found, kidnapped)
            break
        return False

    def _suppose(self, fix: Fix, kidnapped: bool) -> None:
        assert self._T_odom_ego is not None
        T_map_odom, cov = fix.T_map_ego @ self._T_odom_ego.inverse(), fix.cov + shared(fix)
        new = _Hypothesis(T_map_odom, cov, self.travelled_m, kidnapped=kidnapped)
        self._hypotheses = [*self._hypotheses, new][-HYPOTHESES:]

    def _contradicts(self, fix: Fix, row: int) -> bool:
        """Chi-square against the drift: since the drive passed there itself, or since the last fix."""
        if self._T_map_ego is None:
            return False
        way_m = self.travelled_m - self.own_way_m[row] if row in self.own_way_m else self.since_fix_m
        if not math.isfinite(way_m):
            return False
        error = self._T_map_ego.between(fix.T_map_ego).log()
        return float(error @ np.linalg.solve(drift_after(way_m) + fix.cov, error)) > CHI2_GATE

    def _believe(self, fix: Fix) -> None:
        self._T_map_ego, self._cov = fix.T_map_ego, fix.cov
        self._shared = shared(fix)
        self.attitude = fix.attitude_in_map(self._camera)
        self.fix, self.since_fix_m, self._missed = fix, 0.0, False
        self.map_epoch += 1
        self._hypotheses.clear()


def is_place(fix: Fix) -> bool:
    """Whether a frame of which nothing was known may be where the fix says."""
    return fix.inliers >= FOUND_INLIERS and fix.places >= FOUND_PLACES and fix.inliers >= FOUND_SHARE * fix.matches


def shared(fix: Fix) -> Floats:
    """(3, 3) covariance of what further fixes here will be wrong by as well."""
    x_m, y_m = fix.T_keyframe_ego.x_m, fix.T_keyframe_ego.y_m
    variance_m2 = (ALONG_REL * x_m) ** 2 + (ASIDE_REL * y_m) ** 2
    return np.diag([variance_m2, variance_m2, SHARED_YAW_RAD**2 + (ASIDE_YAW_RAD_PER_M * y_m) ** 2])
