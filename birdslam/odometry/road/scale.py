"""The metric scale by a Kalman filter over alignments of the road's image.

The paper scales ego-motion by road points of known metric depth under a moving median (Sec. 3.1; `moving_median.py`).
Here the filter of `kalman_filter.py` replaces the median: one alignment of two images (`alignment.py`) observes only a
combination of scale, pitch, roll and curvature, and the filter knows which.
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
from birdslam.odometry.road.scale_confirmation import TOLD, ScaleConfirmation
from birdslam.odometry.road.scale_search import LengthSearch, agrees, best_alignment, scale_from_landmarks
from birdslam.odometry.road.vanishing_point import VanishingPoint, VanishingPointDetector
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.scale import CarMotion, SpeedScale
from birdslam.types import SpeedReading, SpeedSource, Status

_MIN_STEP_M = 0.1  # of a motion whose rotation gives the curvature of the path
# The share of the least correlation that suffices where the landmarks agree, whose errors are independent, or where
# other lengths are far less likely: on a rendered motorway behind a coarse encoder correlations reach 0.2
_AGREED_CORRELATION_SHARE = 0.5
_MAX_BEND_PER_M = 0.2  # no car turns more tightly


class RoadScale:
    """A `metric_scale.MetricScale`: chooses a keyframe image, aligns, and lets the filter accept or reject.

    Poses are in the odometry's own frame. The caller multiplies all its lengths, about the present camera, by the
    factor that `measure_scale` returns, and so does this. A doubtful scale is searched for over all lengths.
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
        self._on_glass = False  # corners are fixed to the windscreen
        self._informed = False  # the newest image's alignment told the length
        self._was_known = False  # a scale was known once: then the drive has shown how the camera is mounted
        self._since_m = 0.0  # travelled since the last alignment
        self._predicted = False  # the velocity prior gave a motion since an alignment was accepted
        self._direction_predicted = False  # and gave the newest one, whose direction the images do not show
        self.fit: RoadFit | None = None  # of the newest image's alignment without its prior, where it was accepted
        self.vanishing_point: VanishingPoint | None = None  # of the newest image, where it was accepted

    @property
    def bonnet_px(self) -> NDArray[np.float64] | None:
        """(W, 2) the upper edge of the car's own bonnet in the image; None: none is seen."""
        return self._obstructions.bonnet_px

    @property
    def ground(self) -> GroundPlane:
        """The present camera over the road; the height is the calibrated one, by which all lengths are measured."""
        pitch_rad, roll_rad = self._filter.chord[0]
        return GroundPlane(self.camera.height_m, float(pitch_rad), float(roll_rad))

    @property
    def sigma_rel(self) -> float:
        """1-sigma of the scale as a fraction.

        What is on the glass bends and blurs the road's image the same way in each, so that its error is in no mean.
        """
        lasting = self.config.sigma_on_glass_rel if self._on_glass or self._obstructions.fixed_pattern else 0.0
        return float(np.hypot(np.sqrt(self._filter.cov[0, 0]), lasting))

    @property
    def unknown(self) -> bool:
        """Too vague to be driven by."""
        return self.sigma_rel > self.config.invalid_sigma_rel

    @property
    def tilt_cov(self) -> NDArray[np.float64]:
        """(2, 2) of the ground's pitch and roll."""
        return self._filter.chord[1]

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """The window restarts with this image; its scale is known to `sigma_rel`."""
        image = self._aligner.image(grey)
        self._obstructions.begin(grey)
        self._keyframes.clear()
        if not self._obstructions.fixed_pattern:
            self._keyframes.insert(RoadFrame(image, image), pose, 0.0)
        if not self._confirmation.started:
            sigma_rel = 1.0
        self._filter.reset_scale(sigma_rel)
        if sigma_rel > self.config.doubt_sigma_rel:
            self._confirmation.forget()
        self._car.restart()

    def speed_predicted(self, sigma_rel: float) -> None:
        """The newest motion's length comes from the velocity prior, so the scale is known to `sigma_rel`."""
        self._filter.inflate_scale(sigma_rel)
        self._predicted = self._direction_predicted = True

    def lose_tilt(self) -> None:
        """The camera turned without being seen: its tilt is known no better than by the mount."""
        self._filter.lose_tilt()

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Readings of the car's own speed that had come by the frame of this time."""
        self._car.add_readings(readings, t_source_ns)

    def car_motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """The car's motion by its own speed; None where there are no trusted readings."""
        return self._car.motion(from_ns, to_ns)

    @property
    def motion_factor(self) -> float:
        """The factor on the newest motion alone, beside that on all lengths: its error by the car's own speed."""
        return self._car.motion_factor

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, by the road in this image and an earlier one and by the car's own speed.

        `step` is T_prev_curr, in the present scale.
        """
        by_road = self._measure_road(step, view)
        self._car.rescale(by_road)
        travelled_m = by_road * float(np.linalg.norm(step.p))
        forward_m = float(planar(Pose(step.R, step.p * by_road), self.ground).log()[0])
        by_car = self._car.update(*view.interval_ns, forward_m, travelled_m, self._confirmation.known)
        if by_car != 1.0:
            self._car.rescale(by_car)
            self._keyframes.rescale(view.pose.p, by_car)
        return by_road * by_car

    def _measure_road(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, by the road alone."""
        self.fit, self._informed, self._on_glass = None, False, view.on_glass
        travelled_m = float(np.linalg.norm(step.p))
        self._filter.predict(step.R, travelled_m)
        if not self._direction_predicted:
            self._filter.update_travel(step.R.T @ step.p, travelled_m, view.sigma_across_m)
        self._direction_predicted = False
        self._update_vanishing_point(step, view, travelled_m)
        self._since_m += travelled_m

        self._update_bonnet(view, travelled_m)
        frame, pose = self._obstructions.frame(view.grey, travelled_m), view.pose
        factor = float(np.exp(np.clip(self._filter.pending_log, -0.1, 0.1)))
        self._filter.pending_log = 0.0
        keyframe = self._keyframe(pose)
        if keyframe is not None:
            T = keyframe.pose.between(pose)
            share = self._readout_share(T, travelled_m, view)
            if not self._was_known and not self._confirmation.started and self.unknown:
                self._filter.initialise_pitch(T.R.T @ T.p, view.sigma_across_m)
            bend_per_m = _bend_per_m(step.R, travelled_m)
            wide = self._obstructions.fixed_pattern
            px = self._aligner.samples(self._tilt, view.boxes_px, view.road_mask, bend_per_m, wide)
            px = self._obstructions.above_bonnet(px)
            if len(px) >= self.config.align.min_samples:
                unit = self._landmark_scale(view.window)
                T_m, road = Pose(T.R, T.p * (unit or factor)), self._filter.prediction[0]
                if self._obstructions.pattern_changed(keyframe, frame, px, T_m, road, view.flow_px):
                    self._keyframes.clear()  # they are corrected for a pattern, or are not, unlike those to come
                    return factor
                by_landmarks = None if unit is None else unit / factor
                if self._car.scale_factor is not None:
                    by_landmarks = self._car.scale_factor / factor
                T = Pose(T.R, T.p * factor)
                factor *= self._align_and_update(keyframe.corrected, frame.corrected, T, px, by_landmarks, view, share)
        measured = self._informed and self._confirmation.known  # here, in metres
        self._mount_change.update(self._filter.tilt, factor * travelled_m, measured)
        self._insert_keyframe(frame, pose, factor)
        return factor

    def _readout_share(self, T_past_present: Pose, travelled_m: float, view: RoadView) -> float:
        """The camera's readout as a share of the time between two images, which is as the way to that of a step."""
        begin_ns, end_ns = view.interval_ns
        step_s, length = 1e-9 * (end_ns - begin_ns), float(np.linalg.norm(T_past_present.p))
        return self.camera.readout_s * travelled_m / (step_s * length) if step_s * length > 0.0 else 0.0

    def _update_vanishing_point(self, step: Pose, view: RoadView, travelled_m: float) -> None:
        """The tilt by the vanishing point of the road's lines, where there is one ahead."""
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
        """Where a bonnet has been taken for road until it was found, scale and tilt are dropped."""
        driven_m = travelled_m if self._confirmation.started else None
        if self._obstructions.bonnet_changed(view.grey, driven_m, view.flow_px):
            self._filter.reset_scale(1.0)
            self._filter.lose_tilt()
            self._confirmation.forget()

    def _landmark_scale(self, window: SlidingWindow) -> float | None:
        """Metres in the scale of the window by its landmarks on the road, where the scale is doubtful."""
        if not (self._is_doubtful() or self._confirmation.contradicted):
            return None
        return scale_from_landmarks(self.camera, self._tilt, window)

    def _insert_keyframe(self, frame: RoadFrame, pose: Pose, factor: float) -> None:
        """Keeps the image for later alignments, where it is far enough from the last one kept."""
        cfg = self.config
        if factor != 1.0:
            self._keyframes.rescale(pose.p, factor)
        if self._predicted:  # the earlier ones show no road, or from too vague a distance
            self._keyframes.insert(frame, pose, cfg.min_baseline_m, alone=True)
        else:
            self._keyframes.insert(frame, pose, 0.5 * cfg.min_baseline_m)

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """Where the metres come from."""
        road = (SpeedSource.ROAD,) if self._sees_road() else ()
        car = (SpeedSource.CAR,) if self._car.measures else ()
        return road + car or (SpeedSource.CARRIED,)

    def car_status(self) -> list[Status]:
        """What is wrong with the car's own speed; nothing where there never was a reading."""
        return self._car.status()

    def _sees_road(self) -> bool:
        seen = self._filter.carried_m <= self.config.carried_after_m and not self._predicted
        return seen and self._confirmation.started

    def status(self) -> list[Status]:
        """What is wrong with the scale, the ground plane or the mount."""
        out: list[Status] = []
        if not self._sees_road() and not self._car.measures:
            out.append(Status.SCALE_CARRIED)
        if self.unknown or self._confirmation.outweighed:
            out.append(Status.SCALE_INVALID)
        if self._confirmation.violated:
            out.append(Status.GROUND_VIOLATED)
        if self._obstructions.present:
            out.append(Status.VIEW_OBSTRUCTED)
        if self._mount_change.has_drifted:
            out.append(Status.CALIBRATION_DRIFT)
        return out

    @property
    def _tilt(self) -> tuple[float, float]:
        ground = self.ground
        return ground.pitch_rad, ground.roll_rad

    def _is_doubtful(self) -> bool:
        return self.sigma_rel > self.config.doubt_sigma_rel or self._confirmation.doubted

    def _keyframe(self, pose: Pose) -> RoadKeyframe | None:
        """The keyframe image to align with: that with the baseline nearest to the target."""
        if self._is_doubtful():
            # Lengths are not known: the longest baseline, then, after a rejection, the shortest, and so on.
            return self._keyframes.candidate(self._confirmation.rejections)
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
        """The factor by which T_past_present is too short, 1 where the alignment is rejected.

        `by_landmarks` is that factor by the landmarks on the road; None where it is unknown or not needed.
        """
        cfg, filter_, confirmation = self.config, self._filter, self._confirmation
        length = float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        new, self._since_m = min(1.0, self._since_m / length), 0.0
        sigma_motion = (view.sigma_rotation_rad, view.sigma_across_m / length)
        search = None
        if self._is_doubtful():
            # A confirmed scale must be beaten clearly: the dark below a car ahead correlates with standing still
            lead = 0.02 if not confirmation.started else 0.1
            search = LengthSearch(self._tilt, lead, cfg.sigma_unseen_rad if confirmation.doubted else 0.0)
        found = best_alignment(
            self._aligner, filter_, past, present, T, px, by_landmarks, sigma_motion, search, readout_share
        )
        if found is None:
            return 1.0
        fit, searched, prior_cov = found
        known = confirmation.known or self._car.measures
        least = cfg.min_correlation
        reported = fit.length_information > cfg.doubt_sigma_rel**-2  # far likelier than other lengths
        log_length = float(np.log(searched)) + float(fit.state[0])
        confirmed = (searched != 1.0 and confirmation.found_before(log_length)) or agrees(log_length, by_landmarks)
        if reported or confirmed:
            least *= _AGREED_CORRELATION_SHARE
        if searched == 1.0:
            expected = not known or filter_.innovation(fit)[2] < cfg.max_innovation_sigma
        else:
            expected = confirmed or confirmation.may_be(log_length)
        if fit.correlation < least or not expected:
            confirmation.reject(new, log_length if searched != 1.0 else None)
            return 1.0
        shown = confirmation.mean_information(fit.length_information)
        if not agrees(float(np.log(searched)) + filter_.length(fit)[0], by_landmarks):
            fit = fit.with_max_information(min(fit.length_information, shown))
        self.fit = fit
        filter_.cov = prior_cov
        tells = filter_.information(fit)
        confirmation.agree(tells)
        self._informed = tells >= TOLD
        if self._informed:
            self._predicted = False
        factor = searched * filter_.update_alignment(fit, min(1.0, filter_.unaligned_m / length))
        if abs(np.log(factor)) > cfg.doubt_sigma_rel:
            self._car.road_contradicts(float(np.log(factor)))
        confirmation.confirm(tells, float(np.log(factor)))
        self._was_known = self._was_known or confirmation.known
        if not confirmation.known and not self._car.measures:
            filter_.cov[0, 0] = max(filter_.cov[0, 0], (1.1 * cfg.doubt_sigma_rel) ** 2)
        return factor


def _bend_per_m(R_prev_curr: NDArray[np.float64], travelled_m: float) -> float:
    """The curvature of the path, to the right."""
    turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
    return float(np.clip(turned_rad / max(travelled_m, _MIN_STEP_M), -_MAX_BEND_PER_M, _MAX_BEND_PER_M))
