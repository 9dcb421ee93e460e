"""Metric scale: what the known camera height over the road says about the length of a motion; and the road's tilt.

The paper scales ego-motion by road points of known metric depth (Eq. 1, camera height H) under a moving median
(Sec. 3.1, scale-unambiguous ego-motion initialisation). Here a filter over (log lambda, pitch, roll) takes the place of
the median: one comparison (roadalign.py) knows only some combination of the three, and the filter knows which.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.camera import Camera, GroundPlane
from birdslam.pose import Pose
from birdslam.roadalign import RoadAlignConfig, RoadAligner, RoadFit, RoadImage, plane_normal, plane_tilt
from birdslam.types import Status

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_LENGTHS_M = np.geomspace(0.03, 6.0, 84)  # tried where the length is not known at all


class RoadScaleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How comparisons of the road become a running scale and tilt."""

    align: RoadAlignConfig = RoadAlignConfig()
    min_baseline_m: Positive = 0.35  # travelled between the two images; shorter says too little
    target_baseline_m: Positive = 1.1
    kept_images: Annotated[int, msgspec.Meta(ge=2)] = 8
    min_correlation: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.35
    max_innovation_sigma: Positive = 4.0  # a comparison farther from what was expected is refused
    confirmations: Annotated[int, msgspec.Meta(ge=1)] = (
        3  # comparisons in a row before an unknown scale counts as known
    )
    doubt_sigma_rel: Positive = 0.15  # less sure than this, lengths far from the present one are tried as well
    doubt_after: Annotated[int, msgspec.Meta(ge=1)] = 3  # refused comparisons in a row that begin such a search
    violated_after: Annotated[int, msgspec.Meta(ge=1)] = 8  # refused comparisons in a row until the ground is in doubt
    sigma_scale_floor_rel: Positive = 0.015  # one pair never knows the length better: the road is no perfect plane
    sigma_tilt_floor_rad: Positive = 0.004
    sigma_bounce_rad: Positive = 0.012  # pitch and roll of the body against their mean, seen once in bounce_m
    bounce_m: Positive = 3.0
    sigma_travel_rad: Positive = 0.012  # direction of travel against the road, over one metre
    sigma_mount_rad: Positive = 0.02  # of the calibrated pitch and roll
    sigma_unseen_rad: Positive = 0.03  # of the tilt after a gap in which nobody saw how the camera turned
    scale_walk_rel_per_sqrt_m: Positive = 0.004  # drift of the visual scale
    tilt_walk_rad_per_sqrt_m: Positive = 0.003  # crown and grade of the road
    mount_memory_m: Positive = 40.0  # distance over which the mean pitch and roll follow
    carried_after_m: Positive = 6.0  # without a comparison, until the status says so
    invalid_sigma_rel: Positive = 0.15
    drift_sigma: Positive = 3.0  # between the calibrated and the mean pitch or roll, until the status says so
    drift_memory_m: Positive = 12.0  # distance over which that mean is taken
    sigma_drift_pitch_rad: Positive = 0.005  # of the mean: bounces, load, and the grade of the way
    sigma_drift_roll_rad: Positive = 0.012  # and the road's crown


class RoadFilter:
    """The running estimate of (log lambda, pitch, roll) over all comparisons, and the mean pitch and roll behind it.

    The visual scale is rescaled after each update, so log lambda is 0 between updates; only its variance runs.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.config = config
        self.tilt = np.array([camera.pitch_rad, camera.roll_rad])
        self.mount = self.tilt.copy()
        self.recent = self.tilt.copy()  # the mean over a shorter way, in which a mount that was knocked shows
        self.mount_var = config.sigma_mount_rad**2
        self.cov: Floats = np.diag([1.0, config.sigma_mount_rad**2, config.sigma_mount_rad**2])
        self.owed_log = 0.0  # correction of log lambda that the caller has not applied yet
        self.carried_m = 0.0  # travelled since a comparison held

    def forget_scale(self, sigma_rel: float) -> None:
        """The unit of length was lost (the window began anew) or doubted."""
        self.cov[0, :] = self.cov[:, 0] = 0.0
        self.cov[0, 0] = sigma_rel**2

    def turned_unseen(self) -> None:
        """The camera turned and nobody saw by how much: all that is known of the tilt is what the mount gives."""
        self.cov[1:, :] = self.cov[:, 1:] = 0.0
        self.cov[1, 1] = self.cov[2, 2] = self.config.sigma_unseen_rad**2

    def predict(self, R_prev_curr: Floats, travelled_m: float) -> None:
        """The camera turned by R_prev_curr over a plane that bends a little on the way."""
        cfg = self.config
        normal = R_prev_curr.T @ plane_normal(*self.tilt)[0]
        self.tilt = np.array(plane_tilt(normal))
        self.cov[0, 0] = min(self.cov[0, 0] + cfg.scale_walk_rel_per_sqrt_m**2 * travelled_m, 1.0)
        walk = cfg.tilt_walk_rad_per_sqrt_m**2 * travelled_m + 1e-8
        self.cov[1, 1] += walk
        self.cov[2, 2] += walk
        self.carried_m += travelled_m
        # The road under the car is, in the mean, where the mount says: holds the tilt where no comparison does.
        self._observe(self.mount - self.tilt, np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), travelled_m)

    def _observe(self, innovation: Floats, H: Floats, travelled_m: float) -> None:
        share = travelled_m / self.config.bounce_m
        if share <= 0.0:
            return
        noise = np.eye(len(innovation)) * (self.config.sigma_bounce_rad**2 + self.mount_var) / share
        self._update(innovation, H, noise)

    def _update(self, innovation: Floats, H: Floats, noise: Floats) -> None:
        gain = self.cov @ H.T @ np.linalg.inv(H @ self.cov @ H.T + noise)
        step = gain @ innovation
        self.owed_log += float(step[0])  # what is now known of the tilt says something of earlier comparisons too
        self.tilt = self.tilt + step[1:]
        keep = np.eye(3) - gain @ H
        self.cov = keep @ self.cov @ keep.T + gain @ noise @ gain.T

    def travel(self, t_prev_curr: Floats, travelled_m: float) -> None:
        """A car travels along the road, not into it: the direction of travel lies in the plane, in the mean."""
        length = float(np.linalg.norm(t_prev_curr))
        if length < 0.05:
            return
        normal, by_pitch, by_roll = plane_normal(*self.tilt)
        d = t_prev_curr / length
        H = np.array([[0.0, by_pitch @ d, by_roll @ d]])
        share = travelled_m / 1.0
        noise = np.array([[self.config.sigma_travel_rad**2 / share]])
        self._update(np.array([-(normal @ d)]), H, noise)

    def innovation(self, fit: RoadFit) -> tuple[Floats, Floats, float]:
        """What a comparison says beyond what was expected, its noise (3, 3), and how many sigma that is away."""
        cfg = self.config
        floor = np.array([cfg.sigma_scale_floor_rel, cfg.sigma_tilt_floor_rad, cfg.sigma_tilt_floor_rad])
        noise = fit.cov + np.diag(floor**2)
        beyond = fit.state - np.concatenate([[0.0], self.tilt])
        return beyond, noise, float(np.sqrt(beyond @ np.linalg.solve(self.cov + noise, beyond)))

    def accept(self, fit: RoadFit) -> float:
        """Takes a comparison over and returns lambda, by which the visual scale is to be multiplied."""
        beyond, noise, _ = self.innovation(fit)
        gain = self.cov @ np.linalg.inv(self.cov + noise)
        step = gain @ beyond
        self.tilt = self.tilt + step[1:]
        keep = np.eye(3) - gain
        self.cov = keep @ self.cov @ keep.T + gain @ noise @ gain.T
        self.carried_m = 0.0
        return float(np.exp(np.clip(step[0], -0.7, 0.7)))

    def settle_mount(self, travelled_m: float) -> None:
        """Lets the mean pitch and roll follow the tilt seen in comparisons, as a mean of them at first."""
        rate = min(1.0, travelled_m / self.config.mount_memory_m)
        seen_var = float(self.cov[1, 1]) + self.config.sigma_bounce_rad**2
        rate = max(rate, self.mount_var / (self.mount_var + seen_var * self.config.bounce_m / max(travelled_m, 1e-3)))
        self.mount = self.mount + rate * (self.tilt - self.mount)
        self.recent = self.recent + min(1.0, travelled_m / self.config.drift_memory_m) * (self.tilt - self.recent)
        self.mount_var = max((1.0 - rate) * self.mount_var, (0.1 * self.config.sigma_bounce_rad) ** 2)


@dataclass(frozen=True)
class _Kept:
    image: RoadImage
    pose: Pose  # in the odometry's frame and unit


class MetricScale:
    """Turns the odometry's unit of length into metres, image by image.

    Poses come in the odometry's own frame. By the factor that `compare` returns the caller multiplies all its lengths,
    about the present camera, and so does this.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.camera, self.config = camera, config
        self._aligner = RoadAligner(camera, config.align)
        self._filter = RoadFilter(camera, config)
        self._kept: list[_Kept] = []
        self._confirmed = 0
        self._refused = 0
        self.fit: RoadFit | None = None  # what the last image's comparison alone said, where it was taken over

    @property
    def ground(self) -> GroundPlane:
        """The present camera over the road; the height is the calibrated one, by which all lengths are measured."""
        return GroundPlane(self.camera.height_m, float(self._filter.tilt[0]), float(self._filter.tilt[1]))

    @property
    def sigma_rel(self) -> float:
        return float(np.sqrt(self._filter.cov[0, 0]))

    @property
    def pitch_sigma_rad(self) -> float:
        return float(np.sqrt(self._filter.cov[1, 1]))

    def restart(self, grey: NDArray[np.uint8], pose: Pose, sigma_rel: float) -> None:
        """The odometry begins anew with this image; its unit of length is known to `sigma_rel`."""
        self._kept = [_Kept(self._aligner.image(grey), pose)]
        self.forget(sigma_rel)

    def turned_unseen(self) -> None:
        """The odometry lost sight of how the camera turned."""
        self._filter.turned_unseen()

    def forget(self, sigma_rel: float) -> None:
        """The unit of length is only known to `sigma_rel` from here on."""
        if not self._confirmed:
            sigma_rel = 1.0
        self._filter.forget_scale(sigma_rel)
        if sigma_rel > self.config.doubt_sigma_rel:
            self._confirmed = 0

    def moved(self, step: Pose) -> None:
        """The camera moved by T_prev_curr, in the present unit of length."""
        travelled_m = float(np.linalg.norm(step.p))
        self._filter.predict(step.R, travelled_m)
        self._filter.travel(step.R.T @ step.p, travelled_m)

    def compare(self, grey: NDArray[np.uint8], pose: Pose, boxes_px: Floats, road_mask: Bools | None) -> float:
        """Compares the road with that of an earlier image; returns the factor on all lengths."""
        cfg = self.config
        self.fit = None
        image = self._aligner.image(grey)
        factor = float(np.exp(np.clip(self._filter.owed_log, -0.1, 0.1)))
        self._filter.owed_log = 0.0
        past = self._past(pose)
        if past is not None:
            px = self._aligner.samples((self._filter.tilt[0], self._filter.tilt[1]), boxes_px, road_mask)
            if len(px) >= cfg.align.min_samples:
                T = past.pose.between(pose)
                factor *= self._compare(past, image, Pose(T.R, T.p * factor), px)
        if factor != 1.0:
            centre = pose.p
            self._kept = [_Kept(k.image, Pose(k.pose.R, centre + factor * (k.pose.p - centre))) for k in self._kept]
        newest = self._kept[-1] if self._kept else None
        if newest is None or float(np.linalg.norm(newest.pose.p - pose.p)) > 0.5 * cfg.min_baseline_m:
            self._kept = [*self._kept[1 - cfg.kept_images :], _Kept(image, pose)]
        return factor

    def status(self) -> list[Status]:
        cfg, out = self.config, []
        if self._filter.carried_m > cfg.carried_after_m or not self._confirmed:
            out.append(Status.SCALE_CARRIED)
        if self.sigma_rel > cfg.invalid_sigma_rel:
            out.append(Status.SCALE_INVALID)
        if self._refused >= cfg.violated_after:
            out.append(Status.GROUND_VIOLATED)
        away = self._filter.recent - np.array([self.camera.pitch_rad, self.camera.roll_rad])
        sigma = np.hypot(self.camera.tilt_sigma_rad, [cfg.sigma_drift_pitch_rad, cfg.sigma_drift_roll_rad])
        if np.abs(away / sigma).max() > cfg.drift_sigma:
            out.append(Status.CALIBRATION_DRIFT)
        return out

    def _past(self, pose: Pose) -> _Kept | None:
        cfg = self.config
        if not self._kept:
            return None
        if self._in_doubt():
            # Lengths are not known: the longest there is, or, where that looked like nothing, the shortest, and so on.
            return self._kept[-self._refused % len(self._kept)]
        distance = np.array([np.linalg.norm(k.pose.p - pose.p) for k in self._kept])
        usable = np.flatnonzero(distance > cfg.min_baseline_m)
        if not len(usable):
            return None
        return self._kept[int(usable[np.argmin(np.abs(np.log(distance[usable] / cfg.target_baseline_m)))])]

    def _in_doubt(self) -> bool:
        return self.sigma_rel > self.config.doubt_sigma_rel or self._refused >= self.config.doubt_after

    def _compare(self, past: _Kept, image: RoadImage, T: Pose, px: NDArray[np.int64]) -> float:
        cfg, filter_ = self.config, self._filter
        tilt = (float(filter_.tilt[0]), float(filter_.tilt[1]))
        prior, prior_cov = np.array([0.0, *tilt]), filter_.cov.copy()
        length = float(np.linalg.norm(T.p))
        if length < 1e-6:
            return 1.0
        searched = 1.0
        fit = self._aligner.align(past.image, image, T, px, prior, prior_cov)
        if self._in_doubt():
            found = self._aligner.search(past.image, image, T, px, tilt, _LENGTHS_M) / length
            loose = prior_cov.copy()
            loose[0, :] = loose[:, 0] = 0.0
            loose[0, 0] = 0.3**2
            if self._refused >= cfg.doubt_after:
                loose[1:, 1:] += np.eye(2) * cfg.sigma_unseen_rad**2
            other = self._aligner.align(past.image, image, Pose(T.R, T.p * found), px, prior, loose)
            # What was confirmed before has to be beaten clearly: the dark below a car ahead agrees with standing still.
            lead = 0.02 if not self._confirmed else 0.1
            if other is not None and (fit is None or other.correlation > fit.correlation + lead):
                fit, searched, prior_cov = other, found, loose
        if fit is None:
            return 1.0
        expected = searched != 1.0 or not self._known() or filter_.innovation(fit)[2] < cfg.max_innovation_sigma
        if fit.correlation < cfg.min_correlation or not expected:
            self._refused += 1
            return 1.0
        self._refused = 0
        self.fit = fit
        filter_.cov = prior_cov
        factor = searched * filter_.accept(fit)
        self._confirmed = 1 if abs(np.log(factor)) > 0.3 else self._confirmed + 1
        if not self._known():
            filter_.cov[0, 0] = max(filter_.cov[0, 0], (1.1 * cfg.doubt_sigma_rel) ** 2)
        else:
            filter_.settle_mount(length * searched)
        return factor

    def _known(self) -> bool:
        return self._confirmed >= self.config.confirmations
