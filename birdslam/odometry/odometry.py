"""Ego-motion of one forward camera in metres, image by image.

    track the corners (corners/feature_tracks.py) -> relative pose among the landmarks (relative_pose.py)
    -> bundle adjustment over the keyframes (keyframes.py) -> metric scale from the road (metric_scale.py) -> Motion

The paper takes this from an off-the-shelf SLAM and scales it by road points and a moving median (Sec. 3.1,
scale-unambiguous ego-motion initialisation). A standing car holds its pose exactly: the image that the car stopped in
stays the one that all later ones are compared with until they differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.below_plane import BeyondRoad, BeyondRoadConfig
from birdslam.odometry.corners.feature_tracks import FeatureConfig, FeatureTracker, Tracks
from birdslam.odometry.corners.initialisation import StartSearch, StartSearchConfig
from birdslam.odometry.corners.keyframes import KeyframeConfig, KeyframeWindow
from birdslam.odometry.corners.prediction import corners_of_unknown_depth_px
from birdslam.odometry.corners.resection import Corners, Fitting, Located, pose_beside_glass
from birdslam.odometry.corners.sliding_window import common
from birdslam.odometry.corners.two_view import first_pose
from birdslam.odometry.metric_scale import MetricScale, RoadView
from birdslam.odometry.motion import Motion, MotionConfig, planar, step_cov
from birdslam.odometry.motion_model import STILL, LastMotion
from birdslam.odometry.motion_records import MotionRecords
from birdslam.odometry.obstruction.fixed_corners import StandingCorners, StandingCornersConfig
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.kalman_filter import RoadScaleConfig
from birdslam.odometry.road.moving_median import MedianScale
from birdslam.odometry.road.points import is_night, on_road, outside
from birdslam.odometry.road.scale import RoadScale
from birdslam.odometry.road.vanishing_point import LinesDirection
from birdslam.odometry.speed.constant_velocity import HeldSpeed, HeldSpeedConfig, worst_sigma_m
from birdslam.odometry.speed.dead_reckoning import DRIVES_M, moves_sideways
from birdslam.odometry.speed.scale import CarStep
from birdslam.odometry.speed.zero_velocity import StandstillConfig, near_displacement_px, stands
from birdslam.types import SpeedReading, Status

__all__ = ["Motion", "Odometry", "OdometryConfig", "Tracks"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

_MIN_INTERVAL_S = 0.004
_WAY_SIGMA_REL = 0.3  # a way known so well says by how much the road's image has moved
_DRIVES_MPS = 3.0  # from one image to the next a car does not stop from this
_TWO_VIEW_INFORMATION = np.diag([1e4] * 3 + [6e4] * 3)  # of a step that two images alone show: 1 cm, 0.25 deg
_NO_TRACKS = np.zeros(0, np.int64), np.zeros((0, 2))
_STRATEGIES: dict[str, type[RoadScale] | type[MedianScale]] = {"kalman": RoadScale, "paper": MedianScale}


class OdometryConfig(KeyframeConfig, frozen=True, forbid_unknown_fields=True):
    """One setting for every camera, road and frame rate."""

    features: FeatureConfig = FeatureConfig()
    road: RoadScaleConfig = RoadScaleConfig()
    motion: MotionConfig = MotionConfig()
    start: StartSearchConfig = StartSearchConfig()
    # where the window does not show the pose
    two_view_px: Positive = 0.7  # outliers' limit of the pose from two images, where the window does not show it
    min_fitting: Count = 18  # landmarks that must agree before a pose counts as measured
    min_fitting_fraction: Positive = 0.35  # and so large a part of those in sight
    max_speed_mps: Positive = 70.0  # a faster motion is no measurement
    max_coast_s: Positive = 1.0  # after that the window begins anew
    standstill: StandstillConfig = StandstillConfig()
    standing_corners: StandingCornersConfig = StandingCornersConfig()
    held_speed: HeldSpeedConfig = HeldSpeedConfig()
    beyond_road: BeyondRoadConfig = BeyondRoadConfig()


class Odometry:
    """From images of one undistorted, calibrated camera to metric motion, image by image.

    `track` needs only the image and can run beside the networks; `estimate` then takes what they saw. Deterministic;
    raises ValueError for an image of another size, never for what the image shows.
    """

    def __init__(self, camera: Camera, config: OdometryConfig | None = None) -> None:
        self.camera = camera
        self.config = config if config is not None else OdometryConfig()
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._tracker = FeatureTracker(camera.width_px, camera.height_px, self.config.features)
        self._search = StartSearch(camera, RoadAligner(camera, self.config.road.align), self.config.start)
        self.reset()

    def reset(self) -> None:
        """Forgets everything but the camera; track ids go on counting."""
        self._tracker.reset()
        self._scale: MetricScale = _STRATEGIES[self.config.road.mode](self.camera, self.config.road)
        self._window = self._new_window()
        self._pose = STILL  # of the base image, in the window's frame
        self._base_frame: int | None = None  # the last image whose motion was measured
        self._base_t_ns = 0
        self._base_seen = True  # False: no image shows where the base was, the car's own speed alone led there
        self._last = LastMotion()
        self._records = MotionRecords(self.config.motion, self.config.start.camera_ahead_m, self._scale, self._last)
        self._held = HeldSpeed(self.config.held_speed)
        self._glass = StandingCorners(self.camera, self.config.standing_corners)
        self._beyond = BeyondRoad(self.camera, self.config.beyond_road)
        self._obstructed = False  # corners on the glass were left out of the newest motion
        self._guess: Pose | None = None  # of the step to the present image, where it had to be searched for
        self._road_tracks: tuple[Ints, Floats] = _NO_TRACKS

    @property
    def road_tracks(self) -> tuple[Ints, Floats]:
        """(ids (N,), px (N, 2)): followed corners of the present image that lie on the road (paper, Sec. 3.1)."""
        return self._road_tracks

    @property
    def road_fit(self) -> RoadFit | None:
        """What the road's image alone said of the last motion, where it was of use."""
        return self._scale.fit

    @property
    def road_lines(self) -> LinesDirection | None:
        """Where the road's lines lead in the newest image, where they were looked at and of use."""
        return self._scale.lines

    # --- feature tracking ---

    def track(self, image: NDArray[np.uint8]) -> Tracks:
        """Follows the corners into an image, (H, W) grey or (H, W, 3) BGR uint8, undistorted."""
        self._guess = None
        return self._tracker.track(image, self._predict_px if self._last.known else None, self._search_px)

    def _search_px(self, past: NDArray[np.uint8], present: NDArray[np.uint8], base: Tracks) -> list[Floats]:
        """Where the base's corners are by the motions that are searched for."""
        turned, self._guess = self._search.guesses(past, present)
        return [self._expected_px(base.px, step) for step in (turned, self._guess)]

    def _predict_px(self, base: Tracks) -> Floats:
        step = self._last.over(self._last.interval_s)
        pose = self._pose @ step
        out = self._expected_px(base.px, step)
        at = np.searchsorted(self._window.ids, base.ids)
        at = np.minimum(at, max(len(self._window.ids) - 1, 0))
        if len(self._window.ids):
            known = self._window.ids[at] == base.ids
            px = self.camera.to_px(self._window.predict_xy(pose)[at])
            known &= np.isfinite(px).all(axis=1)
            out[known] = px[known]
        return out

    def _expected_px(self, px: Floats, step: Pose) -> Floats:
        return corners_of_unknown_depth_px(self.camera, self._scale.ground, px, step)

    # --- motion ---

    def estimate(
        self,
        tracks: Tracks,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: Bools | None = None,
        speeds: Sequence[SpeedReading] = (),
    ) -> Motion | None:
        """The motion since the last measured image; None for the very first image, and before one could be used.

        `vehicle_boxes_px` (N, 4) is x1, y1, x2, y2; `road_mask` (H, W) may be some images old; `speeds` are the car's
        own that had come by this image, in any order, those of earlier images again or not.
        """
        self._scale.hear(speeds, t_source_ns)
        boxes_px = np.asarray(vehicle_boxes_px, dtype=np.float64).reshape(-1, 4)
        blind = [Status.CAMERA_DARK] * tracks.dark + [Status.CAMERA_FROZEN] * tracks.frozen
        if self._base_frame is None:
            if not blind:
                self._begin(tracks, frame_id, t_source_ns, boxes_px)
            elif self._scale.car_step(t_source_ns - round(_MIN_INTERVAL_S * 1e9), t_source_ns) is not None:
                self._begin_unseen(frame_id, t_source_ns)
            return None
        dt_s = (t_source_ns - self._base_t_ns) * 1e-9
        if dt_s < _MIN_INTERVAL_S:  # a clock that stands or steps back must not make a speed
            dt_s = self._last.interval_s
        car = self._scale.car_step(t_source_ns - round(dt_s * 1e9), t_source_ns)
        if blind:
            motion = self._coast(frame_id, dt_s, blind, car)
            if car is not None and (dt_s > self.config.max_coast_s or not self._base_seen):
                self._begin_unseen(frame_id, t_source_ns)
            return motion
        if not self._base_seen:
            motion = self._coast(frame_id, dt_s, [], car)
            self._begin(tracks, frame_id, t_source_ns, boxes_px)
            self._scale.turned_unseen()
            return motion

        cfg = self.config
        corners, located = self._relative_pose(tracks, boxes_px, dt_s, car)
        sideways = False
        if located is not None and self._drives(car):
            shown = planar(self._pose.between(located[0]), self._scale.ground)
            sideways = moves_sideways(shown, cfg.start.camera_ahead_m)
        if located is None or sideways:
            motion = self._coast(frame_id, dt_s, [Status.LOW_TEXTURE], car)
            if sideways or dt_s > cfg.max_coast_s or len(corners.displacement_px) < cfg.min_fitting:
                # Nothing links this image to the base any more: the window begins anew here, at the coasted pose.
                self._begin(tracks, frame_id, t_source_ns, boxes_px)
                self._scale.turned_unseen()
            return motion
        pose, info = located
        if is_night(tracks.image):
            info = info / cfg.motion.night_inflation
        near_px = near_displacement_px(self.camera, self._scale.ground, self._tracker.base, tracks, boxes_px)
        if self._stands(self._pose.between(pose), corners, near_px, dt_s, car):
            # The pose is held, so this frame is as good a start of the next motion as the one that the car stopped in.
            motion = self._stand(frame_id)
        else:
            pose, info, held_m = self._hold_speed(pose, info, dt_s)
            self._window.extend(frame_id, pose, corners.ids, corners.xy, held_m)
            if not self._scale.unknown and not self._glass.present:
                self._beyond.judge(self._window, pose, self._scale.ground)
            pose = self._window.refine()
            if np.isfinite(held_m):
                self._scale.length_held(held_m / max(float(np.linalg.norm(pose.p - self._pose.p)), held_m))
            interval_ns = (t_source_ns - round(dt_s * 1e9), t_source_ns)
            cov6 = step_cov(cfg.motion, info)
            step = self._scale_to_metres(pose, cov6, tracks, boxes_px, road_mask, near_px, interval_ns)
            motion = self._move(frame_id, step, cov6, dt_s)
            self._tracker.accept(tracks)
        self._base_frame, self._base_t_ns = frame_id, t_source_ns
        self._road_tracks = self._tracks_on_road(tracks, boxes_px, road_mask)
        return motion

    def _begin(self, tracks: Tracks, frame_id: int, t_source_ns: int, boxes_px: Floats) -> None:
        """A new window that holds this image alone."""
        self._tracker.accept(tracks)
        self._window = self._new_window()
        self._pose = STILL
        static = outside(tracks.px, boxes_px, is_night(tracks.image))
        self._window.append(frame_id, self._pose, tracks.ids[static], self.camera.to_xy(tracks.px[static]))
        self._base_frame, self._base_t_ns, self._base_seen = frame_id, t_source_ns, True
        self._scale.restart(tracks.image, self._pose, 0.3)

    def _begin_unseen(self, frame_id: int, t_source_ns: int) -> None:
        """What the car's own speed led to is the base: images have shown nothing for too long to come back to them."""
        self._tracker.leave_base()
        self._window, self._pose = self._new_window(), STILL
        self._base_frame, self._base_t_ns, self._base_seen = frame_id, t_source_ns, False

    def _new_window(self) -> KeyframeWindow:
        return KeyframeWindow(self._focal_px, self.config)

    # --- relative pose ---

    def _relative_pose(
        self, tracks: Tracks, boxes_px: Floats, dt_s: float, car: CarStep | None
    ) -> tuple[Corners, Located | None]:
        """The corners in use, and the present image's pose by them in the window's frame; None where it is unknown."""
        every = self._static_corners(tracks, boxes_px, dt_s)
        guesses, fitting = self._guesses(dt_s), self._fitting(dt_s)
        corners, located = pose_beside_glass(self._window, every, self._pose, guesses, fitting)
        self._obstructed = corners is not every
        return corners, located if located is not None else self._two_view_pose(corners, dt_s, car)

    def _static_corners(self, tracks: Tracks, boxes_px: Floats, dt_s: float) -> Corners:
        driven_m = self._last.speed_mps * dt_s if self._scale.sigma_rel < _WAY_SIGMA_REL else 0.0
        static, base = outside(tracks.px, boxes_px, is_night(tracks.image)), self._tracker.base
        ids, px = tracks.ids[static], tracks.px[static]
        stands = self._glass.see(ids, px, self._scale.ground, driven_m)
        good = self._beyond.without(ids)
        ids, px, stands = ids[good], px[good], stands[good]
        a, b = common(base.ids, ids)
        displacement: Floats = np.sqrt(((px[b] - base.px[a]) ** 2).sum(axis=1))
        return Corners(ids, self.camera.to_xy(px), displacement, stands & self._glass.present)

    def _guesses(self, dt_s: float) -> list[Pose]:
        searched = [] if self._guess is None else [self._pose @ self._guess]
        return [*searched, self._pose @ self._last.over(dt_s), self._pose]

    def _fitting(self, dt_s: float) -> Fitting:
        cfg = self.config
        return Fitting(cfg.min_fitting, cfg.min_fitting_fraction, cfg.max_speed_mps * dt_s + 0.1)

    def _two_view_pose(self, corners: Corners, dt_s: float, car: CarStep | None) -> Located | None:
        """Starts the window anew from the base image and this one."""
        cfg, displacement_px = self.config, corners.displacement_px
        base = self._tracker.base
        a, b = common(base.ids, corners.ids)
        if len(a) < cfg.min_fitting:
            return None
        xy_a, xy_b = self.camera.to_xy(base.px[a]), corners.xy[b]
        still = float(np.median(displacement_px)) < cfg.standstill.still_px
        if still and float(np.quantile(displacement_px, 0.8)) < 1.5:
            return self._pose, _TWO_VIEW_INFORMATION
        guess = self._guess if self._guess is not None else self._last.over(dt_s)
        found = first_pose(xy_a, xy_b, guess, self._focal_px, cfg.two_view_px)
        if found is None or found[1].sum() < max(cfg.min_fitting, cfg.min_fitting_fraction * len(a)):
            return None
        step, _ = found
        length = driven_m = self._last.speed_mps * dt_s
        if driven_m <= 0.05:
            length = 0.5
        if self._guess is not None:
            length = float(np.linalg.norm(self._guess.p))
        if car is not None and abs(car.forward_m) > DRIVES_M:
            length = abs(car.forward_m)
        frame = self._base_frame if self._base_frame is not None else 0
        self._window = self._new_window()
        self._window.append(frame, self._pose, base.ids[a], xy_a)
        self._scale.restart(base.image, self._pose, 0.2 if driven_m > 0.05 else 1.0)
        return self._pose @ Pose(step.R, step.p * length), _TWO_VIEW_INFORMATION

    # --- metric scale ---

    def _scale_to_metres(
        self,
        pose: Pose,
        cov6: Floats,
        tracks: Tracks,
        boxes_px: Floats,
        road_mask: Bools | None,
        near_px: float | None,
        interval_ns: tuple[int, int],
    ) -> Pose:
        """T_base_present in metres, as the images and the car's own speed have it; the window is rescaled to metres."""
        step = self._pose.between(pose)
        sigma = np.sqrt(np.diag(cov6))
        view = RoadView(
            tracks.image,
            pose,
            boxes_px,
            road_mask,
            self._window,
            near_px or 0.0,
            interval_ns,
            sigma_across_m=float(np.hypot(*sigma[:2])) / np.sqrt(2.0),
            sigma_rotation_rad=float(np.linalg.norm(sigma[3:])) / np.sqrt(3.0),
        )
        factor = self._scale.measure_scale(step, view)
        self._window.rescale(factor)
        self._pose = pose
        return Pose(step.R, step.p * (factor * self._scale.motion_factor))

    # --- moving, standing, coasting ---

    def _stands(self, step: Pose, corners: Corners, near_px: float | None, dt_s: float, car: CarStep | None) -> bool:
        if len(corners.displacement_px) < self.config.min_fitting:
            return False
        speed_mps = self._last.speed_mps
        if car is not None:
            speed_mps = abs(car.forward_m) / dt_s
            if car.drives(self.config.standstill.length_m) and (near_px is None or car.agreed):
                return False
        return stands(self.config.standstill, step, corners.displacement_px, near_px, speed_mps, dt_s)

    def _drives(self, car: CarStep | None) -> bool:
        """Whether the car is known to drive: it says so itself, or it has just done so, in metres that are known."""
        if car is not None:
            return car.proven and car.drives(DRIVES_M)
        return not self._scale.unknown and self._last.speed_mps > _DRIVES_MPS

    def _hold_speed(self, pose: Pose, info: Floats, dt_s: float) -> tuple[Pose, Floats, float]:
        """The pose, its information (6, 6), and 1-sigma of its place where the last speed had to give it, else inf."""
        stated = info / self.config.motion.covariance_inflation
        held = None
        if self._last.known:
            held = self._held.hold(self._pose, pose, self._pose @ self._last.over(dt_s), stated, dt_s)
        if held is None:
            self._held.settle(worst_sigma_m(stated + np.eye(6) * 1e-3), dt_s)
            return pose, info, np.inf
        pose, sigma_m = held
        self._held.settle(sigma_m, dt_s)
        tie = np.diag([self.config.motion.covariance_inflation / sigma_m**2] * 3 + [0.0] * 3)
        return pose, info + tie, sigma_m

    def _move(self, frame_id: int, step: Pose, cov6: Floats, dt_s: float) -> Motion:
        self._last.measured(step, dt_s)
        return self._records.measured(self._frames(frame_id), step, cov6, self._obstructed)

    def _stand(self, frame_id: int) -> Motion:
        self._last.stood()
        self._held.settle(0.0, 1.0)
        return self._records.standing(self._frames(frame_id))

    def _coast(self, frame_id: int, dt_s: float, status: list[Status], car: CarStep | None) -> Motion:
        """The base image stays."""
        self._road_tracks = _NO_TRACKS  # those of the last measured image would say that the car has not moved since
        return self._records.coasted(self._frames(frame_id), dt_s, status, car)

    def _frames(self, frame_id: int) -> tuple[int, int]:
        """From which image to which a motion leads."""
        return self._base_frame if self._base_frame is not None else frame_id, frame_id

    def _tracks_on_road(self, tracks: Tracks, boxes_px: Floats, road_mask: Bools | None) -> tuple[Ints, Floats]:
        """The corners followed into this image that lie on the road: the paper's static map points."""
        half_width_m = self.config.road.align.half_width_m
        keep = (tracks.age > 0) & on_road(tracks.px, self.camera, self._scale.ground, boxes_px, road_mask, half_width_m)
        return tracks.ids[keep], tracks.px[keep]
