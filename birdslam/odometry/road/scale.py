"""Metric scale by a Kalman filter over alignments of the road's image.

The paper uses a moving median over road points of known depth (Sec. 3.1; `moving_median.py`). An alignment of two
images (`alignment.py`) observes only a combination of scale, pitch, roll and curvature, so `kalman_filter.py` replaces
the median.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.metric_scale import RoadView
from birdslam.odometry.motion import planar
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.kalman_filter import RoadFilter
from birdslam.odometry.road.keyframe_images import RoadFrame, RoadKeyframe, RoadKeyframes
from birdslam.odometry.road.mount_change import MountChangeDetector
from birdslam.odometry.road.obstructions import RoadObstructions
from birdslam.odometry.road.road_image import RoadImage
from birdslam.odometry.road.scale_confirmation import MIN_INFORMATIVE_RATIO, ScaleConfirmation
from birdslam.odometry.road.scale_search import LengthSearch, agrees, best_alignment, scale_from_landmarks
from birdslam.odometry.road.vanishing_point import VanishingPoint, VanishingPointDetector
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.scale import CarMotion, SpeedScale
from birdslam.types import SpeedReading, SpeedSource, Status

_MIN_STEP_M = 0.1  # of a motion whose rotation gives the curvature of the path
# Factor on the minimum correlation if the landmarks agree, whose errors are independent, or other lengths are unlikely
_AGREED_CORRELATION_SHARE = 0.5
_MAX_BEND_PER_M = 0.2  # no car turns more tightly


class RoadScale:
    """A `metric_scale.MetricScale`: aligns the image with a keyframe image and updates the filter.

    Poses are in the window frame. The caller and this class multiply all lengths, about the current camera, by the
    factor that `measure_scale` returns. A doubtful scale starts a search over all lengths.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.camera, self.config = camera, config
        self._aligner = RoadAligner(camera, config.align)
        self._filter = RoadFilter(camera, config)
        self._car = SpeedScale(config, self._filter)
        self._mount_change = MountChangeDetector(camera, config.mount_change)
        self._obstructions = RoadObstructions(self._aligner, config)
        self._vanishing_points = VanishingPointDetector(camera, config.vanishing_point)
        self._keyframes = RoadKeyframes(config.keyframes)
        self._confirmation = ScaleConfirmation(config)
        self._has_fixed_corners = False  # corners are fixed to the windscreen
        self._is_informative = False  # the newest alignment is informative about the length
        self._has_been_known = False  # a scale was known once, and with it the tilt of the mount
        self._since_m = 0.0  # travelled since the last alignment
        self._is_scale_predicted = False  # the velocity prior gave a motion since the last accepted alignment
        self._is_direction_predicted = False  # and gave the newest motion, with its direction
        self.fit: RoadFit | None = None  # accepted alignment of the newest image, without its prior
        self.vanishing_point: VanishingPoint | None = None  # accepted vanishing point of the newest image

    @property
    def bonnet_px(self) -> NDArray[np.float64] | None:
        """(W, 2) upper edge of the car's own bonnet in the image; None if none is visible."""
        return self._obstructions.bonnet_px

    @property
    def ground(self) -> GroundPlane:
        """The current camera over the road; the height is the calibrated one, which defines the scale."""
        pitch_rad, roll_rad = self._filter.chord[0]
        return GroundPlane(self.camera.height_m, float(pitch_rad), float(roll_rad))

    @property
    def sigma_rel(self) -> float:
        """Relative 1-sigma of the scale; a dirty windscreen adds a systematic error."""
        systematic = (
            self.config.sigma_on_glass_rel if self._has_fixed_corners or self._obstructions.has_fixed_pattern else 0.0
        )
        return float(np.hypot(np.sqrt(self._filter.cov[0, 0]), systematic))

    @property
    def is_unknown(self) -> bool:
        """Whether the scale is too uncertain to drive by."""
        return self.sigma_rel > self.config.invalid_sigma_rel

    @property
    def tilt_cov(self) -> NDArray[np.float64]:
        """(2, 2) covariance of the ground's pitch and roll."""
        return self._filter.chord[1]

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """Restarts with a new window at this image, whose scale has a 1-sigma of `sigma_rel`."""
        image = self._aligner.image(grey)
        self._obstructions.initialise(grey)
        self._keyframes.clear()
        if not self._obstructions.has_fixed_pattern:
            self._keyframes.insert(RoadFrame(image, image), pose, 0.0)
        if not self._confirmation.is_initialised:
            sigma_rel = 1.0
        self._filter.reset_scale(sigma_rel)
        if sigma_rel > self.config.doubt_sigma_rel:
            self._confirmation.reset()
        self._car.restart()

    def add_predicted_motion(self, sigma_rel: float) -> None:
        """Raises the 1-sigma of the scale to `sigma_rel`, after a motion whose length the velocity prior gave."""
        self._filter.inflate_scale(sigma_rel)
        self._is_scale_predicted = self._is_direction_predicted = True

    def reset_tilt(self) -> None:
        """Resets the tilt to the prior of the mount, after a rotation that was not observed."""
        self._filter.reset_tilt()

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Adds the readings of the car's own speed that arrived by the frame of this time."""
        self._car.add_readings(readings, t_source_ns)

    def car_motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """The car's motion by its own speed; None without trusted readings."""
        return self._car.motion(from_ns, to_ns)

    @property
    def motion_factor(self) -> float:
        """Factor on the newest motion only, beside that on all lengths; corrects it by the car's own speed."""
        return self._car.motion_factor

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """Returns the factor on all lengths, from the road and the car's own speed.

        `step` is T_prev_curr, in the current scale.
        """
        by_road = self._measure_road(step, view)
        self._car.rescale(by_road)
        travelled_m = by_road * float(np.linalg.norm(step.p))
        forward_m = float(planar(Pose(step.R, step.p * by_road), self.ground).log()[0])
        by_car = self._car.update(*view.interval_ns, forward_m, travelled_m, self._confirmation.is_known)
        if by_car != 1.0:
            self._car.rescale(by_car)
            self._keyframes.rescale(view.pose.p, by_car)
        return by_road * by_car

    def _measure_road(self, step: Pose, view: RoadView) -> float:
        """Returns the factor on all lengths from the road alone."""
        self.fit, self._is_informative, self._has_fixed_corners = None, False, view.has_fixed_corners
        travelled_m = float(np.linalg.norm(step.p))
        self._filter.predict(step.R, travelled_m)
        if not self._is_direction_predicted:
            self._filter.update_travel(step.R.T @ step.p, travelled_m, view.sigma_across_m)
        self._is_direction_predicted = False
        self._update_vanishing_point(step, view, travelled_m)
        self._since_m += travelled_m

        self._update_bonnet(view, travelled_m)
        frame, pose = self._obstructions.correct(view.grey, travelled_m), view.pose
        factor = float(np.exp(np.clip(self._filter.pending_log, -0.1, 0.1)))
        self._filter.pending_log = 0.0
        keyframe = self._keyframe(pose)
        if keyframe is not None:
            T = keyframe.pose.between(pose)
            share = self._readout_share(T, travelled_m, view)
            if not self._has_been_known and not self._confirmation.is_initialised and self.is_unknown:
                self._filter.initialise_pitch(T.R.T @ T.p, view.sigma_across_m)
            bend_per_m = _bend_per_m(step.R, travelled_m)
            wide = self._obstructions.has_fixed_pattern
            px = self._aligner.samples(self._tilt, view.boxes_px, view.road_mask, bend_per_m, wide)
            px = self._obstructions.exclude_bonnet(px)
            if len(px) >= self.config.align.min_samples:
                unit = self._landmark_scale(view.window)
                T_m, road = Pose(T.R, T.p * (unit or factor)), self._filter.prediction[0]
                if self._obstructions.detect_pattern_change(keyframe, frame, px, T_m, road, view.flow_px):
                    self._keyframes.clear()  # they differ from the next images in the correction for a pattern
                    return factor
                by_landmarks = None if unit is None else unit / factor
                if self._car.scale_factor is not None:
                    by_landmarks = self._car.scale_factor / factor
                T = Pose(T.R, T.p * factor)
                factor *= self._align_and_update(keyframe.corrected, frame.corrected, T, px, by_landmarks, view, share)
        is_measured = self._is_informative and self._confirmation.is_known
        self._mount_change.update(self._filter.tilt, factor * travelled_m, is_measured)
        self._insert_keyframe(frame, pose, factor)
        return factor

    def _readout_share(self, T_past_present: Pose, travelled_m: float, view: RoadView) -> float:
        """The camera's readout time as a fraction of the time between two images, at a constant speed."""
        begin_ns, end_ns = view.interval_ns
        step_s, length = 1e-9 * (end_ns - begin_ns), float(np.linalg.norm(T_past_present.p))
        return self.camera.readout_s * travelled_m / (step_s * length) if step_s * length > 0.0 else 0.0

    def _update_vanishing_point(self, step: Pose, view: RoadView, travelled_m: float) -> None:
        """Updates the tilt with the vanishing point of the road's lines, if one is detected."""
        self.vanishing_point = None
        if travelled_m < _MIN_STEP_M:
            return
        right, _, ahead = step.R.T @ step.p
        found = self._vanishing_points.detect(
            view.grey,
            view.boxes_px,
            float(self._filter.tilt[0]),
            float(np.arctan2(right, ahead)),
            _bend_per_m(step.R, travelled_m),
            travelled_m,
        )
        if found is not None and self._filter.update_vanishing_point(found):
            self.vanishing_point = found

    def _update_bonnet(self, view: RoadView, travelled_m: float) -> None:
        """Resets scale and tilt when a bonnet appears or disappears: they may come from it instead of the road."""
        driven_m = travelled_m if self._confirmation.is_initialised else None
        if self._obstructions.detect_bonnet_change(view.grey, driven_m, view.flow_px):
            self._filter.reset_scale(1.0)
            self._filter.reset_tilt()
            self._confirmation.reset()

    def _landmark_scale(self, window: SlidingWindow) -> float | None:
        """Metres per scale of the window, from landmarks on the road; None unless the scale is doubtful."""
        if not (self._is_doubtful() or self._confirmation.is_contradicted):
            return None
        return scale_from_landmarks(self.camera, self._tilt, window)

    def _insert_keyframe(self, frame: RoadFrame, pose: Pose, factor: float) -> None:
        """Keeps the image for later alignments if it is far enough from the last one."""
        cfg = self.config
        if factor != 1.0:
            self._keyframes.rescale(pose.p, factor)
        if self._is_scale_predicted:  # earlier ones show no road, or their distance is too uncertain
            self._keyframes.insert(frame, pose, cfg.min_baseline_m, alone=True)
        else:
            self._keyframes.insert(frame, pose, 0.5 * cfg.min_baseline_m)

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """Sources of the metric scale."""
        road = (SpeedSource.ROAD,) if self._sees_road() else ()
        car = (SpeedSource.CAR,) if self._car.is_measuring else ()
        return road + car or (SpeedSource.CARRIED,)

    def car_status(self) -> list[Status]:
        """Faults of the car's own speed; empty before the first reading."""
        return self._car.status()

    def _sees_road(self) -> bool:
        seen = self._filter.carried_m <= self.config.carried_after_m and not self._is_scale_predicted
        return seen and self._confirmation.is_initialised

    def status(self) -> list[Status]:
        """Faults of the scale, the ground plane and the mount."""
        out: list[Status] = []
        if not self._sees_road() and not self._car.is_measuring:
            out.append(Status.SCALE_CARRIED)
        if self.is_unknown or self._confirmation.is_outweighed:
            out.append(Status.SCALE_INVALID)
        if self._confirmation.is_violated:
            out.append(Status.GROUND_VIOLATED)
        if self._obstructions.is_obstructed:
            out.append(Status.VIEW_OBSTRUCTED)
        if self._mount_change.has_drifted:
            out.append(Status.CALIBRATION_DRIFT)
        return out

    @property
    def _tilt(self) -> tuple[float, float]:
        ground = self.ground
        return ground.pitch_rad, ground.roll_rad

    def _is_doubtful(self) -> bool:
        return self.sigma_rel > self.config.doubt_sigma_rel or self._confirmation.is_doubted

    def _keyframe(self, pose: Pose) -> RoadKeyframe | None:
        """The keyframe image to align with: the one with the baseline nearest to the target."""
        if self._is_doubtful():
            # Baselines are unknown: try the oldest image, then the newest, and so on
            return self._keyframes.candidate(self._confirmation.uninformative)
        return self._keyframes.at_baseline(pose, self.config.target_baseline_m, self.config.min_baseline_m)

    def _align_and_update(
        self,
        past: RoadImage,
        present: RoadImage,
        T: Pose,
        px: NDArray[np.int64],
        by_landmarks: float | None,
        view: RoadView,
        readout_share: float,
    ) -> float:
        """Returns the factor on T_past_present, 1 if the alignment is rejected.

        `by_landmarks` is that factor from the landmarks on the road; None if it is unknown or not needed.
        """
        cfg, filter_, confirmation = self.config, self._filter, self._confirmation
        length = float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        new, self._since_m = min(1.0, self._since_m / length), 0.0
        sigma_motion = (view.sigma_rotation_rad, view.sigma_across_m / length)
        search = None
        if self._is_doubtful():
            # A larger lead over a confirmed scale: the shadow of a car ahead correlates with a standstill
            lead = 0.02 if not confirmation.is_initialised else 0.1
            search = LengthSearch(self._tilt, lead, cfg.sigma_unseen_rad if confirmation.is_doubted else 0.0)
        found = best_alignment(
            self._aligner, filter_, past, present, T, px, by_landmarks, sigma_motion, search, readout_share
        )
        if found is None:
            return 1.0
        fit, searched, prior_cov = found
        known = confirmation.is_known or self._car.is_measuring
        min_correlation = cfg.min_correlation
        is_distinct = fit.length_information > cfg.doubt_sigma_rel**-2  # other lengths are far less likely
        log_length = float(np.log(searched)) + float(fit.state[0])
        is_confirmed = (searched != 1.0 and confirmation.was_found_before(log_length)) or agrees(
            log_length, by_landmarks
        )
        if is_distinct or is_confirmed:
            min_correlation *= _AGREED_CORRELATION_SHARE
        if searched == 1.0:
            is_expected = not known or filter_.innovation(fit)[2] < cfg.max_innovation_sigma
        else:
            is_expected = is_confirmed or confirmation.is_plausible(log_length)
        if fit.correlation < min_correlation or not is_expected:
            confirmation.reject(new, log_length if searched != 1.0 else None)
            return 1.0
        mean_information = confirmation.update_mean_information(fit.length_information)
        if not agrees(float(np.log(searched)) + filter_.length(fit)[0], by_landmarks):
            fit = fit.with_max_information(min(fit.length_information, mean_information))
        self.fit = fit
        filter_.cov = prior_cov
        information = filter_.information(fit)
        confirmation.add_accepted(information)
        self._is_informative = information >= MIN_INFORMATIVE_RATIO
        if self._is_informative:
            self._is_scale_predicted = False
        factor = searched * filter_.update_alignment(fit, min(1.0, filter_.unaligned_m / length))
        if abs(np.log(factor)) > cfg.doubt_sigma_rel:
            self._car.add_contradiction(float(np.log(factor)))
        confirmation.confirm(information, float(np.log(factor)))
        self._has_been_known = self._has_been_known or confirmation.is_known
        if not confirmation.is_known and not self._car.is_measuring:
            filter_.cov[0, 0] = max(filter_.cov[0, 0], (1.1 * cfg.doubt_sigma_rel) ** 2)
        return factor


def _bend_per_m(R_prev_curr: NDArray[np.float64], travelled_m: float) -> float:
    """Curvature of the path, to the right."""
    turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
    return float(np.clip(turned_rad / max(travelled_m, _MIN_STEP_M), -_MAX_BEND_PER_M, _MAX_BEND_PER_M))
