"""The metric scale by a Kalman filter over comparisons of the road's image.

The paper scales ego-motion by road points of known metric depth under a moving median (Sec. 3.1; `moving_median.py`).
Here `road_filter.RoadFilter` takes the place of the median: one comparison of two images (`road/alignment.py`) knows
only some combination of scale, pitch, roll and curvature, and the filter knows which.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.metric_scale import RoadView
from birdslam.odometry.motion import planar
from birdslam.odometry.obstruction.bonnet import Bonnet
from birdslam.odometry.obstruction.fixed_pattern import StandingPattern
from birdslam.odometry.road.alignment import RoadAligner, RoadImage
from birdslam.odometry.road.fit import ROAD, RoadFit
from birdslam.odometry.road.kalman_filter import RoadFilter, RoadScaleConfig
from birdslam.odometry.road.keyframe_images import Kept, KeptImages, Seen
from birdslam.odometry.road.landmarks import length_unit
from birdslam.odometry.road.mount_change import TiltWatch
from birdslam.odometry.road.scale_search import search_length
from birdslam.odometry.road.vanishing_point import LinesDirection, RoadLines
from birdslam.odometry.speed.scale import CarScale, CarStep
from birdslam.types import SpeedReading, SpeedSource, Status

Floats = NDArray[np.float64]

_SHORTEST_M = 0.1  # of a motion whose rotation says how the way bends
_LANDMARKS_LOG = 0.4  # they are short by up to a tenth, and a wrong pitch of a degree makes another fifth
# A comparison that the landmarks bear out so well may be so much less alike: their errors are not the same. A rendered
# motorway behind a coarse encoder was looked at, whose comparisons reach 0.2
_AGREED_LOG, _ALIKE_WHERE_AGREED = 0.15, 0.5
# A comparison that knows the length no better, and that no landmarks bear out, has found none: drops over a rendered
# motorway that seem to stand have 0.8, lengths that are found there and behind that encoder less than 0.4
_FOUND_LOG = 0.5
_DRIVEN_PX = 3.0  # of what is below the horizon from one image to the next
_BEND_PER_M = 0.2  # no car turns more tightly
_LENGTHS_M = np.geomspace(0.03, 6.0, 84)  # tried where the length is not known at all


class RoadScale:
    """A `metric_scale.MetricScale`: chooses the earlier image, compares, and lets the filter accept or refuse.

    Poses come in the odometry's own frame. By the factor that `measure_scale` returns the caller multiplies all its
    lengths, about the present camera, and so does this. A scale that is in doubt is searched for over all lengths.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.camera, self.config = camera, config
        self._aligner = RoadAligner(camera, config.align)
        self._filter = RoadFilter(camera, config)
        self._car = CarScale(config, self._filter)
        self._watch = TiltWatch(camera, config.watch)
        self._standing = StandingPattern(config.standing)
        self._bonnet = Bonnet(config.bonnet)
        self._lines = RoadLines(camera, config.lines)
        self._kept = KeptImages(config.kept_images)
        self._confirmed = 0
        self._begun = False  # whether a scale was ever known: then the drive has shown how the camera is mounted
        self._refused = 0.0  # comparisons in a row, each counted by what of it is new: those of one view err together
        self._tries = 0  # and by number
        self._since_m = 0.0  # travelled since the last comparison
        self._held = False  # whether the speed was held since a comparison was accepted
        self._direction_held = False  # whether it is for the newest motion, whose direction the images do not show
        self.fit: RoadFit | None = None  # what the newest image's comparison alone said, where it was accepted
        self.lines: LinesDirection | None = None  # where the newest image's lines lead, where they were accepted

    @property
    def ground(self) -> GroundPlane:
        """The present camera over the road; the height is the calibrated one, by which all lengths are measured."""
        pitch_rad, roll_rad = self._filter.chord[0]
        return GroundPlane(self.camera.height_m, float(pitch_rad), float(roll_rad))

    @property
    def sigma_rel(self) -> float:
        """1-sigma of the scale as a fraction."""
        return float(np.sqrt(self._filter.cov[0, 0]))

    @property
    def unknown(self) -> bool:
        """Too vague to be driven by."""
        return self.sigma_rel > self.config.invalid_sigma_rel

    @property
    def pitch_sigma_rad(self) -> float:
        """1-sigma of the ground's pitch."""
        return self._filter.chord[1]

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """The odometry begins anew with this image; its unit of length is known to `sigma_rel`."""
        image = self._aligner.image(grey)
        if not self._bonnet.begun:
            self._bonnet.learn(grey, self._aligner.top_px, np.inf)
        self._kept.clear()
        if not self._standing.present:
            self._kept.keep(Seen(image, image), pose, 0.0)
        if not self._confirmed:
            sigma_rel = 1.0
        self._filter.forget_scale(sigma_rel)
        if sigma_rel > self.config.doubt_sigma_rel:
            self._confirmed = 0
        self._car.restart()

    def length_held(self, sigma_rel: float) -> None:
        """The newest motion is the last speed, held to `sigma_rel`: the unit of length is known no better."""
        self._filter.loosen_scale(sigma_rel)
        self._held = self._direction_held = True

    def turned_unseen(self) -> None:
        """The odometry lost sight of how the camera turned."""
        self._filter.turned_unseen()

    def hear(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """The car's own speed, as it had come by the frame of this time."""
        self._car.hear(readings, t_source_ns)

    def car_step(self, from_ns: int, to_ns: int) -> CarStep | None:
        """The car's motion by its own readings; None where there are none that can be trusted."""
        return self._car.step(from_ns, to_ns)

    @property
    def motion_factor(self) -> float:
        """The factor on the newest motion alone, after that on all lengths: its own error, by the car's speed."""
        return self._car.motion_factor

    def measure_scale(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, by the road of this image against an earlier one's and by the car's own speed.

        `step` is T_prev_curr, in the present unit of length.
        """
        by_road = self._measure_road(step, view)
        self._car.rescale(by_road)
        travelled_m = by_road * float(np.linalg.norm(step.p))
        forward_m = float(planar(Pose(step.R, step.p * by_road), self.ground).log()[0])
        by_car = self._car.follow(*view.interval_ns, forward_m, travelled_m, self._known())
        if by_car != 1.0:
            self._car.rescale(by_car)
            self._kept.rescale(view.pose.p, by_car)
        return by_road * by_car

    def _measure_road(self, step: Pose, view: RoadView) -> float:
        """The factor on all lengths, by the road alone."""
        self.fit = None
        travelled_m = float(np.linalg.norm(step.p))
        self._filter.predict(step.R, travelled_m)
        if not self._direction_held:
            self._filter.travel(step.R.T @ step.p, travelled_m, view.sigma_across_m)
        self._direction_held = False
        self._follow_lines(step, view, travelled_m)
        self._since_m += travelled_m

        self._learn_bonnet(view, travelled_m)
        image, pose = self._image(view.grey), view.pose
        factor = float(np.exp(np.clip(self._filter.owed_log, -0.1, 0.1)))
        self._filter.owed_log = 0.0
        past = self._past(pose)
        if past is not None:
            T = past.pose.between(pose)
            if not self._begun and not self._confirmed and self.unknown:
                self._filter.begin_travelling(T.R.T @ T.p)
            bend_per_m = _bend_per_m(step.R, travelled_m)
            px = self._aligner.samples(self._tilt, view.boxes_px, view.road_mask, bend_per_m, self._standing.present)
            px = self._bonnet.above(px)
            if len(px) >= self.config.align.min_samples:
                unit = self._unit_of_landmarks(view.window)
                baseline_m = float(np.linalg.norm(T.p)) * (unit or factor)
                driven_m = baseline_m if view.near_px < _DRIVEN_PX else np.inf
                driven = None
                if baseline_m >= self.config.standing.min_baseline_m:  # else it would be the standing image again
                    road = np.append(0.0, self._filter.expected[0][1:])
                    moved = Pose(T.R, T.p * (unit or factor))
                    driven = partial(self._aligner.driven, past.plain, moved, px, road)
                if self._standing.judge(past.plain, image.plain, px, driven_m, driven):
                    self._kept.clear()  # they are of the other kind
                    return factor
                borne_out = None if unit is None else unit / factor
                if self._car.length is not None:
                    borne_out = self._car.length / factor
                factor *= self._compare(past.image, image.image, Pose(T.R, T.p * factor), px, borne_out, view)
        measured = self._filter.carried_m == 0.0 and self._known()  # here, in metres
        self._watch.see(self._filter.tilt, factor * travelled_m, measured)
        self._keep(image, pose, factor)
        return factor

    def _image(self, grey: NDArray[np.uint8]) -> Seen:
        plain, standing, top_px = self._aligner.image(grey), self._standing, self._aligner.top_px
        standing.learn(grey, top_px)
        if not standing.present:
            return Seen(plain, plain)
        return Seen(plain, RoadImage.of(standing.without(grey, top_px), top_px))

    def _follow_lines(self, step: Pose, view: RoadView, travelled_m: float) -> None:
        """The tilt by the road's lines, where they lead on along the way."""
        self.lines = None
        if travelled_m < _SHORTEST_M:
            return
        right, _, ahead = step.R.T @ step.p
        lines = self._lines.look(
            view.grey,
            view.boxes_px,
            float(self._filter.tilt[0]),
            float(np.arctan2(right, ahead)),
            _bend_per_m(step.R, travelled_m),
            travelled_m,
        )
        if lines is not None and self._filter.accept_lines(lines):
            self.lines = lines

    def _learn_bonnet(self, view: RoadView, travelled_m: float) -> None:
        """Where a bonnet turns out to have been taken for road, all that it said is forgotten."""
        driven_m = travelled_m
        if (
            not self._confirmed
        ):  # of an unknown length: images that differ will do, but a standing car's whole image stands
            if view.near_px < _DRIVEN_PX:
                return
            driven_m = np.inf
        if self._bonnet.learn(view.grey, self._aligner.top_px, driven_m):
            self._filter.forget_scale(1.0)
            self._filter.turned_unseen()
            self._confirmed = 0

    def _unit_of_landmarks(self, window: SlidingWindow) -> float | None:
        """Metres in the window's unit of length by its landmarks on the road, where the length is in doubt."""
        if not (self._in_doubt() or self._refused):
            return None
        return length_unit(self.camera, self._tilt, window)

    def _keep(self, seen: Seen, pose: Pose, factor: float) -> None:
        """Remembers the image for later comparisons, where it is far enough from the last one kept."""
        cfg = self.config
        if factor != 1.0:
            self._kept.rescale(pose.p, factor)
        if self._held:  # the earlier ones show no road, or from too vague a distance
            self._kept.keep(seen, pose, cfg.min_baseline_m, alone=True)
        else:
            self._kept.keep(seen, pose, 0.5 * cfg.min_baseline_m)

    @property
    def sources(self) -> tuple[SpeedSource, ...]:
        """What the metres rest on."""
        road = (SpeedSource.ROAD,) if self._sees_road() else ()
        car = (SpeedSource.CAR,) if self._car.measures else ()
        return road + car or (SpeedSource.CARRIED,)

    def car_status(self) -> list[Status]:
        """What is wrong with the car's own speed; nothing where it never told any."""
        return self._car.status()

    def _sees_road(self) -> bool:
        seen = self._filter.carried_m <= self.config.carried_after_m and not self._held
        return seen and self._confirmed > 0

    def status(self) -> list[Status]:
        """What is wrong with the scale, the ground plane or the mount."""
        cfg, out = self.config, []
        if not self._sees_road() and not self._car.measures:
            out.append(Status.SCALE_CARRIED)
        if self.unknown:
            out.append(Status.SCALE_INVALID)
        if self._refused >= cfg.violated_after:
            out.append(Status.GROUND_VIOLATED)
        if self._standing.present or self._bonnet.present:
            out.append(Status.VIEW_OBSTRUCTED)
        if self._watch.drifted:
            out.append(Status.CALIBRATION_DRIFT)
        return out

    @property
    def _tilt(self) -> tuple[float, float]:
        ground = self.ground
        return ground.pitch_rad, ground.roll_rad

    def _known(self) -> bool:
        return self._confirmed >= self.config.confirmations

    def _in_doubt(self) -> bool:
        return self.sigma_rel > self.config.doubt_sigma_rel or self._refused >= self.config.doubt_after

    def _past(self, pose: Pose) -> Kept | None:
        """The earlier image to compare with: the one whose baseline is nearest to the target."""
        if self._in_doubt():
            # Lengths are not known: the longest there is, or, where that looked like nothing, the shortest, and so on.
            return self._kept.in_turn(self._tries)
        return self._kept.nearest_to(pose, self.config.target_baseline_m, self.config.min_baseline_m)

    def _compare(
        self,
        past: RoadImage,
        image: RoadImage,
        T: Pose,
        px: NDArray[np.int64],
        borne_out: float | None,
        view: RoadView,
    ) -> float:
        """The factor by which T_past_present is too short, 1 where the comparison is refused.

        `borne_out` is that factor by the landmarks on the road; None where they say nothing or are not asked.
        """
        cfg, filter_ = self.config, self._filter
        length = float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        new, self._since_m = min(1.0, self._since_m / length), 0.0
        sigma_motion = (view.sigma_rotation_rad, view.sigma_across_m / length)
        found = self._align(past, image, T, px, borne_out, sigma_motion)
        if found is None:
            return 1.0
        fit, searched, prior_cov = found
        known = self._known() or self._car.measures
        expected = searched != 1.0 or not known or filter_.innovation(fit)[2] < cfg.max_innovation_sigma
        least = cfg.min_correlation
        if _bears_out(float(np.log(searched)) + fit.state[0], borne_out):
            least *= _ALIKE_WHERE_AGREED
        if fit.correlation < least or not expected:
            self._refused += new
            self._tries += 1
            return 1.0
        self._refused, self._tries, self._held = 0.0, 0, False
        self.fit = fit
        filter_.cov = prior_cov
        factor = searched * filter_.accept(fit, min(1.0, filter_.carried_m / length))
        if abs(np.log(factor)) > self.config.doubt_sigma_rel:
            self._car.contradict(float(np.log(factor)))
        self._confirmed = 1 if abs(np.log(factor)) > 0.3 else self._confirmed + 1
        self._begun = self._begun or self._known()
        if not self._known() and not self._car.measures:
            filter_.cov[0, 0] = max(filter_.cov[0, 0], (1.1 * cfg.doubt_sigma_rel) ** 2)
        return factor

    def _align(
        self,
        past: RoadImage,
        image: RoadImage,
        T: Pose,
        px: NDArray[np.int64],
        borne_out: float | None,
        sigma_motion: tuple[float, float],
    ) -> tuple[RoadFit, float, Floats] | None:
        """The fit, the factor on T that it starts from, and the filter's covariance that it is to be joined with."""
        cfg, filter_ = self.config, self._filter
        (prior, expected_cov), prior_cov = filter_.expected, filter_.cov.copy()
        fit, factor, cov = self._aligner.align(past, image, T, px, prior, expected_cov, sigma_motion), 1.0, prior_cov
        if fit is not None and _contradicts(fit.state[0], borne_out):
            fit = None
        if self._in_doubt():
            length = float(np.linalg.norm(T.p))
            searched = search_length(self.camera, past, image, T, px, self._tilt, _LENGTHS_M) / length
            loose = prior_cov.copy()
            loose[0, :] = loose[:, 0] = 0.0
            loose[0, 0] = 0.3**2
            if self._refused >= cfg.doubt_after:
                loose[1:3, 1:3] += np.eye(2) * cfg.sigma_unseen_rad**2
            # What was confirmed before has to be beaten clearly: the dark below a car ahead agrees with standing still.
            lead = 0.02 if not self._confirmed else 0.1
            for begin in (searched,) if borne_out is None else (searched, borne_out):
                other = self._aligner.align(
                    past, image, Pose(T.R, T.p * begin), px, prior, loose[:ROAD, :ROAD], sigma_motion
                )
                if other is None:
                    continue
                log_length = float(np.log(begin)) + other.state[0]
                if _contradicts(log_length, borne_out):
                    continue
                if other.cov[0, 0] > _FOUND_LOG**2 and not _bears_out(log_length, borne_out):
                    continue
                if fit is None or other.correlation > fit.correlation + lead:
                    fit, factor, cov = other, begin, loose
        return None if fit is None else (fit, factor, cov)


def _contradicts(log_length: float, borne_out: float | None) -> bool:
    """Whether a factor on the lengths is none that the landmarks on the road could bear out."""
    return borne_out is not None and abs(log_length - float(np.log(borne_out))) > _LANDMARKS_LOG


def _bears_out(log_length: float, borne_out: float | None) -> bool:
    """Whether the landmarks on the road show that factor themselves."""
    return borne_out is not None and abs(log_length - float(np.log(borne_out))) <= _AGREED_LOG


def _bend_per_m(R_prev_curr: Floats, travelled_m: float) -> float:
    """The curvature of the way, to the right."""
    turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
    return float(np.clip(turned_rad / max(travelled_m, _SHORTEST_M), -_BEND_PER_M, _BEND_PER_M))
