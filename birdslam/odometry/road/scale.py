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
from birdslam.odometry.metric_scale import RoadView
from birdslam.odometry.motion import planar
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.kalman_filter import RoadFilter
from birdslam.odometry.road.keyframe_images import RoadFrame, RoadKeyframe, RoadKeyframes
from birdslam.odometry.road.mount_change import MountChangeDetector
from birdslam.odometry.road.obstructions import RoadObstructions
from birdslam.odometry.road.road_image import RoadImage
from birdslam.odometry.road.scale_likelihood import landmark_log_likelihood, road_log_likelihood
from birdslam.odometry.road.scale_posterior import MODE_HALF_WIDTH_LOG, P_WRONG, ScalePosterior
from birdslam.odometry.road.vanishing_point import VanishingPoint, VanishingPointDetector
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.scale import CarMotion, SpeedScale
from birdslam.types import SpeedReading, SpeedSource, Status

_MIN_STEP_M = 0.1  # of a motion whose rotation gives the curvature of the path
# Factor on the minimum correlation if other lengths are far less likely
_DISTINCT_CORRELATION_RATIO = 0.5
_MAX_BEND_PER_M = 0.2  # no car turns more tightly
_UNKNOWN_SIGMA_REL = 0.5  # of a scale, above which it is no prior
_MIN_MODE_PROBABILITY = 0.5  # of a mode, to choose baselines by it
_MIN_KEPT_PROBABILITY = 0.8  # of a scale in doubt
_NEGLIGIBLE = 1e-6  # ratio of a cell's probability to the largest
_MIN_FLOW_PX = 2.0  # of the near road between two keyframes, while their distance is unknown
_FOUND_SIGMA_REL = 0.1  # of a found scale, at least: the alignments that follow measure the same road
_CAR_SIGMA_LOG = 0.1  # of the scale by the car's own speed
_MIN_INFORMATIVE_RATIO = 0.5  # of an alignment's information about the length (`RoadFilter.information`)
_MEAN_COUNT = 5  # time constant of the mean information


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
        self._posterior = ScalePosterior()
        self._is_searching = True  # the scale is unknown or in doubt: the posterior has it, not the filter
        self._is_initialised = False  # the posterior has found a scale since the last reset
        self._tries = 0  # images that the search has used
        self._flow_px = 0.0  # of the near road since the last keyframe of the search
        self._rejected = 0.0  # consecutive rejected alignments, each by the new fraction of its path
        self._mean_information, self._comparisons = 0.0, 0  # about the length, and its number of alignments
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
        in_doubt = self._is_searching and self._is_initialised and not self._car.is_measuring
        if in_doubt and self._posterior.at_present().probability < _MIN_KEPT_PROBABILITY:
            return True
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
        if not self._is_initialised:
            sigma_rel = 1.0
        self._filter.reset_scale(sigma_rel)
        if sigma_rel > self.config.doubt_sigma_rel:
            self._start_search(sigma_rel)
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
        by_car = self._car.update(*view.interval_ns, forward_m, travelled_m, not self._is_searching)
        if by_car != 1.0:
            self._car.rescale(by_car)
            self._keyframes.rescale(view.pose.p, by_car)
        self._posterior.rescale(float(np.log(by_road * by_car)))
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
        sigma = float(np.sqrt(self._filter.cov[0, 0]))
        if self._is_searching:
            self._posterior.diffuse(self.config.scale_walk_rel_per_sqrt_m**2 * travelled_m)
        elif sigma > self.config.doubt_sigma_rel or self._rejected >= self.config.doubt_after:
            self._start_search(sigma)

        self._update_bonnet(view, travelled_m)
        frame, pose = self._obstructions.correct(view.grey, travelled_m), view.pose
        factor = float(np.exp(np.clip(self._filter.pending_log, -0.1, 0.1)))
        self._filter.pending_log = 0.0
        keyframe = self._keyframe(pose)
        if keyframe is not None:
            T = keyframe.pose.between(pose)
            share = self._readout_share(T, travelled_m, view)
            if not self._has_been_known and not self._is_initialised and self.is_unknown:
                self._filter.initialise_pitch(T.R.T @ T.p, view.sigma_across_m)
            bend_per_m = _bend_per_m(step.R, travelled_m)
            wide = self._obstructions.has_fixed_pattern
            px = self._aligner.samples(self._tilt, view.boxes_px, view.road_mask, bend_per_m, wide)
            px = self._obstructions.exclude_bonnet(px)
            if len(px) >= self.config.align.min_samples:
                T_m, road = Pose(T.R, T.p * factor), self._filter.prediction[0]
                if self._obstructions.detect_pattern_change(keyframe, frame, px, T_m, road, view.flow_px):
                    self._keyframes.clear()  # they differ from the next images in the correction for a pattern
                    return factor
                T = Pose(T.R, T.p * factor)
                if self._is_searching:
                    found = self._search(keyframe.corrected, frame.corrected, T, px, view)
                    T, factor = Pose(T.R, T.p * found), factor * found
                if not self._is_searching:
                    factor *= self._align_and_update(keyframe.corrected, frame.corrected, T, px, view, share)
        is_measured = self._is_informative and not self._is_searching
        self._mount_change.update(self._filter.tilt, factor * travelled_m, is_measured)
        self._insert_keyframe(frame, pose, factor, view.flow_px)
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
        driven_m = travelled_m if self._is_initialised else None
        if self._obstructions.detect_bonnet_change(view.grey, driven_m, view.flow_px):
            self._filter.reset_scale(1.0)
            self._filter.reset_tilt()
            self._is_initialised = False
            self._start_search(1.0)

    def _start_search(self, sigma_rel: float) -> None:
        """Gives the scale to the posterior, whose prior is the window's scale with this 1-sigma."""
        self._is_searching, self._tries = True, 0
        self._posterior.reset(sigma_rel if sigma_rel < _UNKNOWN_SIGMA_REL else None)

    def _search(self, past: RoadImage, present: RoadImage, T: Pose, px: NDArray[np.int64], view: RoadView) -> float:
        """Updates the posterior and returns the factor to its mode; ends the search if one mode is left."""
        posterior, log_factors, length = self._posterior, self._posterior.log_factors, float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        new, new_road = (min(1.0, self._since_m / m) for m in (length, self.config.target_baseline_m))
        self._since_m, self._tries = 0.0, self._tries + 1
        fraction, sigma_pitch_rad = self.config.align.effective_sample_fraction, float(np.sqrt(self.tilt_cov[0, 0]))
        likely, by_road = posterior.plausible(_NEGLIGIBLE), np.zeros(len(log_factors))
        by_road[likely] = road_log_likelihood(
            self.camera, past, present, T, px, self._tilt, sigma_pitch_rad, log_factors[likely], fraction
        )
        by_landmarks = landmark_log_likelihood(self.camera, self._tilt, view.window, log_factors, fraction)
        by_car = None
        if self._car.scale_factor is not None:
            by_car = -0.5 * np.square((log_factors - np.log(self._car.scale_factor)) / _CAR_SIGMA_LOG)
        self._rejected += new_road * posterior.update(by_road, new)
        for log_likelihood in (by_landmarks, by_car):
            if log_likelihood is not None:
                posterior.update(log_likelihood, new)
        mode = posterior.mode()
        if mode.probability < _MIN_MODE_PROBABILITY:
            return 1.0
        is_found = mode.probability > 1.0 - P_WRONG and mode.sigma_log < self.config.doubt_sigma_rel
        if is_found:
            self._is_searching, self._is_initialised, self._has_been_known = False, True, True
            self._rejected = self._filter.carried_m = 0.0
        if abs(mode.log) < MODE_HALF_WIDTH_LOG and self._filter.cov[0, 0] < self.config.doubt_sigma_rel**2:
            return 1.0  # the filter's scale is confirmed, and is more accurate
        self._filter.reset_scale(max(mode.sigma_log, _FOUND_SIGMA_REL) if is_found else 1.0)
        if is_found and abs(mode.log) > self.config.doubt_sigma_rel:
            self._car.add_contradiction(mode.log)
        return float(np.exp(mode.log))

    def _insert_keyframe(self, frame: RoadFrame, pose: Pose, factor: float, flow_px: float) -> None:
        """Keeps the image for later alignments if it is far enough from the last one."""
        cfg = self.config
        if factor != 1.0:
            self._keyframes.rescale(pose.p, factor)
        self._flow_px += flow_px
        if self._is_scale_predicted:  # earlier ones show no road, or their distance is too uncertain
            self._keyframes.insert(frame, pose, cfg.min_baseline_m, alone=True)
        elif self._is_searching:
            if self._flow_px > _MIN_FLOW_PX:
                self._keyframes.insert(frame, pose, 0.0)
                self._flow_px = 0.0
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
        return seen and self._is_initialised

    def status(self) -> list[Status]:
        """Faults of the scale, the ground plane and the mount."""
        out: list[Status] = []
        if not self._sees_road() and not self._car.is_measuring:
            out.append(Status.SCALE_CARRIED)
        if self.is_unknown:
            out.append(Status.SCALE_INVALID)
        if self._rejected >= self.config.violated_after:
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

    def _keyframe(self, pose: Pose) -> RoadKeyframe | None:
        """The keyframe image to align with: the one with the baseline nearest to the target."""
        target_m, least_m = self.config.target_baseline_m, self.config.min_baseline_m
        if not self._is_searching:
            return self._keyframes.at_baseline(pose, target_m, least_m)
        found = None  # baselines are unknown: alternate between that by the mode and each of them
        if self._tries % 2 and self._posterior.mode().probability > _MIN_MODE_PROBABILITY:
            found = self._keyframes.at_baseline(pose, target_m, least_m)
        return found or self._keyframes.candidate(self._tries // 2)

    def _align_and_update(
        self,
        past: RoadImage,
        present: RoadImage,
        T: Pose,
        px: NDArray[np.int64],
        view: RoadView,
        readout_share: float,
    ) -> float:
        """Returns the factor on T_past_present, 1 if the alignment is rejected."""
        cfg, filter_ = self.config, self._filter
        length = float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        new, self._since_m = min(1.0, self._since_m / length), 0.0
        sigma_motion = (view.sigma_rotation_rad, view.sigma_across_m / length)
        fit = self._aligner.align(past, present, T, px, *filter_.prediction, sigma_motion, readout_share)
        if fit is None:
            return 1.0
        min_correlation = cfg.min_correlation
        if fit.length_information > cfg.doubt_sigma_rel**-2:  # other lengths are far less likely
            min_correlation *= _DISTINCT_CORRELATION_RATIO
        if fit.correlation < min_correlation or filter_.innovation(fit)[2] > cfg.max_innovation_sigma:
            self._rejected += new
            return 1.0
        self._comparisons += 1
        self._mean_information += (fit.length_information - self._mean_information) / min(
            self._comparisons, _MEAN_COUNT
        )
        self.fit = fit = fit.with_max_information(min(fit.length_information, self._mean_information))
        information = filter_.information(fit)
        self._rejected *= 1.0 - information
        self._is_informative = information >= _MIN_INFORMATIVE_RATIO
        if self._is_informative:
            self._is_scale_predicted = False
        factor = filter_.update_alignment(fit, min(1.0, filter_.unaligned_m / length))
        if abs(np.log(factor)) > cfg.doubt_sigma_rel:
            self._car.add_contradiction(float(np.log(factor)))
        return factor


def _bend_per_m(R_prev_curr: NDArray[np.float64], travelled_m: float) -> float:
    """Curvature of the path, to the right."""
    turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
    return float(np.clip(turned_rad / max(travelled_m, _MIN_STEP_M), -_MAX_BEND_PER_M, _MAX_BEND_PER_M))
