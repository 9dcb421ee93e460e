"""Metric visual odometry of one forward camera.

    feature tracks (corners/feature_tracks.py) -> resection against the landmarks (corners/resection.py)
    -> bundle adjustment over the keyframes (corners/keyframes.py) -> metric scale (metric_scale.py) -> Motion

The paper uses an off-the-shelf SLAM scaled by road points under a moving median (Sec. 3.1, scale-unambiguous
ego-motion initialisation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose, rotation_log
from birdslam.geometry.rolling_shutter import RollingShutter
from birdslam.odometry.corners.feature_tracks import FeatureTracker, Tracks, predict_corners_px
from birdslam.odometry.corners.initialisation import MotionInitialiser
from birdslam.odometry.corners.keyframes import KeyframeWindow
from birdslam.odometry.corners.resection import InlierLimits, PoseEstimate, pose_without_fixed_corners
from birdslam.odometry.corners.selection import Corners, CornerSelector
from birdslam.odometry.corners.sliding_window import match_ids
from birdslam.odometry.corners.two_view import initial_two_view
from birdslam.odometry.metric_scale import MetricScale, RoadView
from birdslam.odometry.motion import Motion, planar, step_cov, uneven_cov, violates_nonholonomic
from birdslam.odometry.motion_model import NO_MOTION, MotionModel
from birdslam.odometry.motion_records import MotionRecords
from birdslam.odometry.odometry_config import OdometryConfig
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.moving_median import MovingMedianScale
from birdslam.odometry.road.points import is_night, on_road, outside
from birdslam.odometry.road.scale import RoadScale
from birdslam.odometry.road.vanishing_point import VanishingPoint
from birdslam.odometry.speed.constant_velocity import ConstantVelocityPrior
from birdslam.odometry.speed.scale import MIN_MOVING_M, CarMotion
from birdslam.odometry.speed.standstill import StandstillDetector
from birdslam.odometry.speed.zero_velocity import near_road_flow_px
from birdslam.odometry.working_resolution import WorkingResolution
from birdslam.types import SpeedReading, Status

__all__ = ["Motion", "Odometry", "OdometryConfig", "Tracks"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_MIN_INTERVAL_S = 0.004
_MAX_SCALE_SIGMA_REL = 0.3  # of a scale by which fixed corners are detected
_MIN_MOVING_MPS = 3.0  # a car at this speed does not stop before the next image
_MAX_PREDICTED_SIGMA_REL = 0.1  # of a step by the velocity prior, relative to the other steps of the window
_TWO_VIEW_INFORMATION = np.diag([1e4] * 3 + [6e4] * 3)  # of a two-view pose: 1 cm, 0.25 deg
_NO_TRACKS = np.zeros(0, np.int64), np.zeros((0, 2))
_STRATEGIES: dict[str, type[RoadScale] | type[MovingMedianScale]] = {"kalman": RoadScale, "paper": MovingMedianScale}


class Odometry:
    """Estimates the metric motion between images of one undistorted, calibrated camera.

    `track` needs only the image and can run in parallel to the networks, whose results `estimate` takes. Deterministic.
    Raises ValueError for an image of another size, never for its content. Zero-velocity update: while the car is
    stationary the pose is kept, and the image in which it stopped stays the reference.
    """

    def __init__(self, camera: Camera, config: OdometryConfig | None = None) -> None:
        self._resolution = WorkingResolution(camera)
        self.camera = camera = self._resolution.camera
        self.config = config if config is not None else OdometryConfig()
        self._focal_px = 0.5 * (camera.fx_px + camera.fy_px)
        self._shutter = RollingShutter(camera)
        self._tracker = FeatureTracker(camera.width_px, camera.height_px, self.config.features)
        self._initialiser = MotionInitialiser(camera, RoadAligner(camera, self.config.road.align), self.config.start)
        self.reset()

    def reset(self) -> None:
        """Resets all state but the camera and the counter of track ids."""
        cfg = self.config
        self._tracker.reset()
        self._scale: MetricScale = _STRATEGIES[cfg.road.mode](self.camera, cfg.road)
        self._window = KeyframeWindow(self._focal_px, cfg)
        self._pose = NO_MOTION  # of the reference image, in the window frame
        self._reference_frame: int | None = None  # the last frame with a measured motion
        self._reference_t_ns = 0
        self._has_reference_image = True  # False: its pose is by the car's own speed alone
        self._model = MotionModel()
        self._records = MotionRecords(
            cfg.motion, cfg.start.camera_ahead_m, self._scale, self._model, cfg.road.invalid_sigma_rel
        )
        self._velocity_prior = ConstantVelocityPrior(cfg.constant_velocity, cfg.start.camera_ahead_m)
        self._selector = CornerSelector(self.camera, cfg.fixed_corners, cfg.below_plane)
        self._standstill = StandstillDetector(self.camera, cfg.zero_velocity, cfg.stillness, cfg.min_fitting)
        self._has_excluded_corners = False  # fixed corners were excluded from the newest motion
        self._fixed_count = 0  # count of fixed corners in the newest image
        self._initial_step: Pose | None = None  # the step to the current image by the initialiser
        self._road_tracks: tuple[Ints, Floats] = _NO_TRACKS

    @property
    def road_tracks(self) -> tuple[Ints, Floats]:
        """(ids (N,), px (N, 2)) of the tracked corners of the current image that lie on the road (paper, Sec. 3.1)."""
        ids, px = self._road_tracks
        return ids, self._resolution.original_px(px)

    @property
    def bonnet_px(self) -> Floats | None:
        """(N, 2) upper edge of the car's own bonnet in the image, from left to right; None if none is visible."""
        px = self._scale.bonnet_px
        return None if px is None else self._resolution.original_px(px)

    @property
    def road_fit(self) -> RoadFit | None:
        """The last motion's alignment of the road without its prior; None if it was rejected."""
        return self._scale.fit

    @property
    def vanishing_point(self) -> VanishingPoint | None:
        """The vanishing point of the road's lines in the newest image; None if none was accepted."""
        return self._scale.vanishing_point

    # --- feature tracking ---

    def track(self, image: NDArray[np.uint8]) -> Tracks:
        """Tracks the corners into an undistorted image, (H, W) grey or (H, W, 3) BGR uint8."""
        self._initial_step = None
        image = self._resolution.image(image)
        return self._tracker.track(image, self._predict_px if self._model.known else None, self._predict_px_by_search)

    def _predict_px_by_search(
        self, past: NDArray[np.uint8], present: NDArray[np.uint8], reference: Tracks
    ) -> list[Floats]:
        """The reference's corners predicted by the initialiser's motions."""
        turned, self._initial_step = self._initialiser.guesses(past, present)
        return [
            predict_corners_px(self.camera, self._scale.ground, reference.px, s) for s in (turned, self._initial_step)
        ]

    def _predict_px(self, reference: Tracks) -> Floats:
        step = self._model.predict(self._model.interval_s)
        default_px = predict_corners_px(self.camera, self._scale.ground, reference.px, step)
        pose = self._pose @ step
        px = self._window.predict_px(self.camera, pose, reference.ids, default_px)
        if not self._shutter.readout_s:
            return px
        xy = self.camera.to_xy(px)
        xy = self._shutter.as_read(xy, self._inverse_depths(reference.ids, xy, pose), self._model.rate)
        return self.camera.to_px(xy)

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
        """The motion since the last measured image; None up to the first usable image.

        `vehicle_boxes_px` (N, 4) is x1, y1, x2, y2; `road_mask` (H, W) may be a few images old. `speeds` are readings
        of the car's own speed that arrived by this image, in any order; repeated readings are ignored.
        """
        self._scale.add_readings(speeds, t_source_ns)
        boxes_px = self._resolution.boxes_px(np.asarray(vehicle_boxes_px, dtype=np.float64).reshape(-1, 4))
        road_mask = self._resolution.mask(road_mask)
        no_image = [Status.CAMERA_DARK] * tracks.dark + [Status.CAMERA_FROZEN] * tracks.frozen
        if self._reference_frame is None:
            if not no_image:
                self._start_window(tracks, frame_id, t_source_ns, boxes_px)
            elif self._scale.car_motion(t_source_ns - round(_MIN_INTERVAL_S * 1e9), t_source_ns) is not None:
                self._start_window_without_image(frame_id, t_source_ns)
            return None
        dt_s = (t_source_ns - self._reference_t_ns) * 1e-9
        if dt_s < _MIN_INTERVAL_S:  # a clock that stops or steps back must not affect the velocity
            dt_s = self._model.interval_s
        interval_ns = (t_source_ns - round(dt_s * 1e9), t_source_ns)
        car = self._scale.car_motion(*interval_ns)
        if no_image:
            motion = self._coast(frame_id, dt_s, no_image, car)
            if car is not None and (dt_s > self.config.max_coast_s or not self._has_reference_image):
                self._start_window_without_image(frame_id, t_source_ns)
            return motion
        if not self._has_reference_image:
            motion = self._coast(frame_id, dt_s, [], car)
            self._start_window(tracks, frame_id, t_source_ns, boxes_px)
            self._scale.reset_tilt()
            return motion

        cfg = self.config
        self._standstill.near_road.update(tracks.image, t_source_ns, boxes_px)
        corners, pose_estimate = self._estimate_pose(tracks, boxes_px, dt_s, car)
        fixed_ids = corners.ids[corners.fixed]
        flow_px = near_road_flow_px(
            self.camera, self._scale.ground, self._tracker.reference, tracks, boxes_px, fixed_ids
        )
        speed_mps = self._model.speed_mps
        stationary = pose_estimate is not None and self._standstill.is_stationary(
            self._pose.between(pose_estimate[0]), corners.displacement_px, flow_px, speed_mps, dt_s, car
        )
        if (stationary or self._seems_still(corners)) and self._standstill.needs_proof(
            stationary, self._scale.is_unknown, self._selector.obstructed, speed_mps, dt_s, car
        ):
            if not self._standstill.near_road.is_proven:
                return self._coast_unproven(tracks, frame_id, t_source_ns, boxes_px, dt_s, car)
            stationary, pose_estimate = True, (self._pose, _TWO_VIEW_INFORMATION)
        is_slipping = False
        if pose_estimate is not None and self._is_moving(car):
            step = planar(self._pose.between(pose_estimate[0]), self._scale.ground)
            is_slipping = violates_nonholonomic(step, cfg.start.camera_ahead_m)
        if pose_estimate is None or is_slipping:
            motion = self._coast(frame_id, dt_s, [Status.LOW_TEXTURE], car)
            if is_slipping or dt_s > cfg.max_coast_s or len(corners.displacement_px) < cfg.min_fitting:
                # The image has no link to the reference: the window restarts at the coasted pose
                self._start_window(tracks, frame_id, t_source_ns, boxes_px)
                self._scale.reset_tilt()
            return motion
        pose, info = pose_estimate
        if is_night(tracks.image):
            info = info / cfg.motion.night_inflation
        if stationary:
            motion = self._update_zero_velocity(frame_id, dt_s)
        else:
            was_uncertain = self._velocity_prior.sigma_rel > cfg.road.invalid_sigma_rel
            pose, info, predicted_sigma_m = self._apply_velocity_prior(pose, info, dt_s)
            if was_uncertain and not self._velocity_prior.is_active:
                # The window's landmarks were triangulated at an uncertain predicted speed
                pose, info = self._restart_by_two_views(corners, dt_s, car) or (pose, info)
            # Errors of predicted steps are correlated, which the scale's sigma states; their ratios are more certain
            relative_sigma_m = min(
                predicted_sigma_m, _MAX_PREDICTED_SIGMA_REL * float(np.linalg.norm(pose.p - self._pose.p))
            )
            self._window.extend(
                frame_id,
                pose,
                corners.ids,
                corners.xy,
                relative_sigma_m if np.isfinite(predicted_sigma_m) else np.inf,
            )
            if not self._scale.is_unknown:
                self._selector.reject_below_plane(self._window, pose, self._scale.ground)
            pose = self._window.refine()
            if np.isfinite(predicted_sigma_m):
                step_length = float(np.linalg.norm(pose.p - self._pose.p))
                self._scale.add_predicted_motion(predicted_sigma_m / max(step_length, predicted_sigma_m))
            cov6 = step_cov(cfg.motion, info)
            metric_step = self._scale_to_metres(pose, cov6, tracks, boxes_px, road_mask, flow_px, interval_ns)
            if self._shutter.readout_s and self._model.known:
                change_radps = rotation_log(metric_step.R) / dt_s - self._model.rate[1]
                cov6 = uneven_cov(cov6, self._shutter.readout_s, change_radps)
            motion = self._update_motion(frame_id, metric_step, cov6, dt_s, corners.displacement_px)
            self._tracker.accept(tracks)
        self._reference_frame, self._reference_t_ns = frame_id, t_source_ns
        self._road_tracks = self._tracks_on_road(tracks, boxes_px, road_mask)
        return motion

    def _start_window(self, tracks: Tracks, frame_id: int, t_source_ns: int, boxes_px: Floats) -> None:
        """Starts a new window with this image."""
        self._tracker.accept(tracks)
        self._window, self._pose = KeyframeWindow(self._focal_px, self.config), NO_MOTION
        static = outside(tracks.px, boxes_px, is_night(tracks.image))
        ids, xy = tracks.ids[static], self.camera.to_xy(tracks.px[static])
        self._window.append(frame_id, self._pose, ids, self._at_middle(ids, xy, self._pose))
        self._reference_frame, self._reference_t_ns, self._has_reference_image = frame_id, t_source_ns, True
        self._scale.restart(tracks.image, self._pose, 0.3)

    def _start_window_without_image(self, frame_id: int, t_source_ns: int) -> None:
        """Starts an empty window at the pose by the car's own speed, after too long without usable images."""
        self._tracker.drop_reference()
        self._window, self._pose = KeyframeWindow(self._focal_px, self.config), NO_MOTION
        self._reference_frame, self._reference_t_ns, self._has_reference_image = frame_id, t_source_ns, False

    # --- relative pose ---

    def _estimate_pose(
        self, tracks: Tracks, boxes_px: Floats, dt_s: float, car: CarMotion | None
    ) -> tuple[Corners, PoseEstimate | None]:
        """The corners used, and the current image's pose in the window frame; None if it is unknown."""
        cfg, scale = self.config, self._scale
        driven_m = self._model.speed_mps * dt_s if scale.sigma_rel < _MAX_SCALE_SIGMA_REL else None
        selected = self._selector.select(tracks, self._tracker.reference, boxes_px, scale.ground, driven_m)
        predicted = self._pose @ self._model.predict(dt_s)
        selected = replace(selected, xy=self._at_middle(selected.ids, selected.xy, predicted))
        searched = [] if self._initial_step is None else [self._pose @ self._initial_step]
        guesses = [*searched, predicted, self._pose]
        limits = InlierLimits(cfg.min_fitting, cfg.min_fitting_fraction, cfg.max_speed_mps * dt_s + 0.1)
        corners, pose_estimate = pose_without_fixed_corners(self._window, selected, self._pose, guesses, limits)
        self._has_excluded_corners = corners is not selected
        self._fixed_count = int(selected.fixed.sum())
        return corners, pose_estimate if pose_estimate is not None else self._restart_by_two_views(corners, dt_s, car)

    def _restart_by_two_views(self, corners: Corners, dt_s: float, car: CarMotion | None) -> PoseEstimate | None:
        """Restarts the window from the reference image and the current one."""
        cfg, reference = self.config, self._tracker.reference
        a, b = match_ids(reference.ids, corners.ids)
        if len(a) < cfg.min_fitting:
            return None
        xy_a, xy_b = self.camera.to_xy(reference.px[a]), corners.xy[b]
        xy_a = self._at_middle(reference.ids[a], xy_a, self._pose)
        if self._seems_still(corners):
            return self._pose, _TWO_VIEW_INFORMATION
        guess = self._initial_step if self._initial_step is not None else self._model.predict(dt_s)
        found = initial_two_view(xy_a, xy_b, guess, self._focal_px, cfg.two_view_px)
        if found is None or found[1].sum() < max(cfg.min_fitting, cfg.min_fitting_fraction * len(a)):
            return None
        step, _ = found
        length = driven_m = self._model.speed_mps * dt_s
        if driven_m <= 0.05:
            length = 0.5
        if self._initial_step is not None:
            length = float(np.linalg.norm(self._initial_step.p))
        if car is not None and abs(car.forward_m) > MIN_MOVING_M:
            length = abs(car.forward_m)
        frame = self._reference_frame if self._reference_frame is not None else 0
        self._window = KeyframeWindow(self._focal_px, cfg)
        self._window.append(frame, self._pose, reference.ids[a], xy_a)
        self._scale.restart(reference.image, self._pose, 0.2 if driven_m > 0.05 else 1.0)
        return self._pose @ Pose(step.R, step.p * length), _TWO_VIEW_INFORMATION

    # --- rolling shutter ---

    def _at_middle(self, ids: Ints, xy: Floats, pose: Pose) -> Floats:
        """(N, 2) corners `xy` of a camera at `pose`, corrected to the readout time of the middle row."""
        if not (self._shutter.readout_s and self._model.known):
            return xy
        return self._shutter.at_middle(xy, self._inverse_depths(ids, xy, pose), self._model.rate)

    def _inverse_depths(self, ids: Ints, xy: Floats, pose: Pose) -> Floats:
        """(N,) inverse depths of corners in a camera at `pose`: of the landmarks, else of the road, else 0."""
        ground = self._scale.ground
        below = -(np.column_stack([xy, np.ones(len(xy))]) @ ground.normal_cam)
        return self._window.inverse_depths_of(pose, ids, np.maximum(below, 0.0) / ground.height_m)

    # --- metric scale ---

    def _scale_to_metres(
        self,
        pose: Pose,
        cov6: Floats,
        tracks: Tracks,
        boxes_px: Floats,
        road_mask: Bools | None,
        flow_px: float | None,
        interval_ns: tuple[int, int],
    ) -> Pose:
        """T_reference_current in metres, by the road and the car's own speed; rescales the window to metres."""
        step = self._pose.between(pose)
        sigma = np.sqrt(np.diag(cov6))
        view = RoadView(
            tracks.image,
            pose,
            boxes_px,
            road_mask,
            self._window,
            flow_px or 0.0,
            interval_ns,
            sigma_across_m=float(np.hypot(*sigma[:2])) / np.sqrt(2.0),
            sigma_rotation_rad=float(np.linalg.norm(sigma[3:])) / np.sqrt(3.0),
            has_fixed_corners=self._selector.obstructed,
        )
        factor = self._scale.measure_scale(step, view)
        self._window.rescale(factor)
        self._velocity_prior.rescale(factor)
        self._pose = pose
        return Pose(step.R, step.p * (factor * self._scale.motion_factor))

    # --- moving, stationary, coasting ---

    def _seems_still(self, corners: Corners) -> bool:
        return self._standstill.has_still_corners(corners.displacement_px, self._fixed_count)

    def _coast_unproven(
        self, tracks: Tracks, frame_id: int, t_source_ns: int, boxes_px: Floats, dt_s: float, car: CarMotion | None
    ) -> Motion:
        """Coasts, since the unmoved corners may be on the windscreen. Restarts the window after too long."""
        obstructed = self._selector.obstructed or self._standstill.near_road.is_contradicted
        motion = self._coast(frame_id, dt_s, [Status.VIEW_OBSTRUCTED] * obstructed, car)
        if self._standstill.is_prior_expired(dt_s):
            self._start_window(tracks, frame_id, t_source_ns, boxes_px)
            self._scale.reset_tilt()
        return motion

    def _is_moving(self, car: CarMotion | None) -> bool:
        """Whether the car is certain to move, by its own speed or by its last motion at a known scale."""
        if car is not None:
            return car.is_proven and car.is_moving(MIN_MOVING_M)
        return not self._scale.is_unknown and self._model.speed_mps > _MIN_MOVING_MPS

    def _apply_velocity_prior(self, pose: Pose, info: Floats, dt_s: float) -> tuple[Pose, Floats, float]:
        """The pose, its information (6, 6), and 1-sigma of its position by the velocity prior (inf if not used)."""
        inflation = self.config.motion.covariance_inflation
        fused = self._velocity_prior.fuse(self._pose, pose, info / inflation, dt_s, self._scale.ground)
        if fused is None:
            return pose, info, np.inf
        pose, sigma_m = fused
        return pose, info + np.diag([inflation / sigma_m**2] * 3 + [0.0] * 3), sigma_m

    def _update_motion(self, frame_id: int, step: Pose, cov6: Floats, dt_s: float, displacement_px: Floats) -> Motion:
        length_m = float(np.linalg.norm(step.p))
        over_s, earlier_m = self._standstill.add_motion(displacement_px, length_m, dt_s)
        self._model.update(step, dt_s, over_s)
        self._velocity_prior.update(planar(step, self._scale.ground), over_s)
        return self._records.measured(self._frames(frame_id), step, cov6, self._has_excluded_corners, dt_s, earlier_m)

    def _update_zero_velocity(self, frame_id: int, dt_s: float) -> Motion:
        unseen_m = self._standstill.add_unmoved(dt_s)
        if not unseen_m:
            self._model.stop()
            self._velocity_prior.stop()
        return self._records.stationary(self._frames(frame_id), unseen_m)

    def _coast(self, frame_id: int, dt_s: float, status: list[Status], car: CarMotion | None) -> Motion:
        """Coasts to the current image; the reference image stays."""
        self._road_tracks = _NO_TRACKS  # tracks of the last measured image would state zero motion
        return self._records.coasted(self._frames(frame_id), dt_s, status, car)

    def _frames(self, frame_id: int) -> tuple[int, int]:
        """Start and end frame of the current motion."""
        return self._reference_frame if self._reference_frame is not None else frame_id, frame_id

    def _tracks_on_road(self, tracks: Tracks, boxes_px: Floats, road_mask: Bools | None) -> tuple[Ints, Floats]:
        """The tracked corners on the road: the paper's static map points."""
        half_width_m = self.config.road.align.half_width_m
        keep = (tracks.age > 0) & on_road(tracks.px, self.camera, self._scale.ground, boxes_px, road_mask, half_width_m)
        return tracks.ids[keep], tracks.px[keep]
