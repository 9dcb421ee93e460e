"""Mounting of a camera from a drive: pitch and roll over the road, and checks of its height.

Least squares over four cues with covariances, widened by their disagreement (Birge's ratio): homography of the road
(road/alignment.py), direction of travel, vanishing point of the road's lines (road/vanishing_point.py), and vehicles
(road_users/camera_height.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.height_check import (
    HeightCheck,
    HeightCheckConfig,
    KnownLength,
    Step,
    VehicleHeightConfig,
    checks_by_length,
    checks_by_vehicles,
    solve_mounting,
)
from birdslam.calibration.lane_width import LaneWidth, checks_by_lanes, painted_width_m
from birdslam.frontend import FrontEnd, FrontEndConfig, Pending
from birdslam.geometry.camera import Camera, plane_normal
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.vanishing_point import VanishingPoint
from birdslam.road_users.camera_height import BoxHeight, measure_heights
from birdslam.types import NS_PER_S, Frame, Status

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
UNOBSERVED_RAD = 10.0  # 1-sigma of an unobserved angle


class CalibrationError(ValueError):
    """The drive does not determine the camera; the message states what is missing."""


class CalibrationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Uncertainty of each cue, and requirements on a drive."""

    vehicles: VehicleHeightConfig = VehicleHeightConfig()
    height: HeightCheckConfig = HeightCheckConfig()
    min_path_m: Positive = 20.0  # min. distance travelled: less gives bounces of the car instead of their mean
    min_fits: Annotated[int, msgspec.Meta(ge=3)] = 10
    bounce_m: Positive = 3.0  # correlation length of the car's bounce
    sigma_bounce_rad: Positive = 0.012
    sigma_fit_rad: Positive = 0.004  # of one alignment: roads are not exact planes
    sigma_length_rel: Positive = 0.02  # of the running scale
    sigma_curvature_per_m: Positive = 0.0006  # longitudinal curvature of roads
    sigma_road_rad: Positive = 0.002  # of their mean: crown and grade of the road driven
    straight_rad_per_m: Positive = 0.005
    sigma_direction_rad: Positive = 0.012  # of the direction of travel over one metre
    sigma_travel_rad: Positive = 0.003  # of its mean: suspension and grade
    crest_m: Positive = 30.0  # correlation length of crests and sags
    min_looks: Annotated[int, msgspec.Meta(ge=3)] = 5  # at the vanishing point
    max_sigma_rad: Positive = 0.02  # max. sigma of the resulting pitch, which all longitudinal distances depend on
    max_sigma_roll_rad: Positive = 0.02  # max. sigma of the roll: at the side of the own lane it is 4 cm of height
    restart_rad: Positive = 0.01  # max. distance from the initial tilt; above it the drive is repeated from the result
    max_drives: Annotated[int, msgspec.Meta(ge=1)] = 3
    known_lane_m: Positive | None = None  # width of the drive's lanes, if stated
    known_vehicle_m: Positive | None = None  # height of the vehicle that is in view for most frames, if stated


class CueEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """(pitch_rad, roll_rad) from one cue with cov (2, 2); `chi2` is its squared distance from the mean of all cues."""

    cue: str
    pitch_rad: float
    roll_rad: float | None  # None: not observed
    cov: tuple[float, ...]
    samples: int
    chi2: float = 0.0


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """The calibrated camera with cov (2, 2) of (pitch_rad, roll_rad) and the estimates behind it."""

    camera: Camera
    cov: tuple[float, ...]
    estimates: tuple[CueEstimate, ...]
    height_checks: tuple[HeightCheck, ...]
    yaw_rad: float | None  # of the optical axis, left of the direction of travel; not in the camera file
    path_m: float
    frames: int
    speed_mps: float  # median over frames with a measured motion
    assumed: str = ""  # reason why the tilt is assumed, "" if measured


class _RecordingOdometry(Odometry):
    """The front end's odometry; stores its last motion."""

    motion: Motion | None = None

    def estimate(self, *arguments: Any, **named: Any) -> Motion | None:
        self.motion = super().estimate(*arguments, **named)
        return self.motion

    def take(self) -> Motion | None:
        """The motion of the current frame, once."""
        motion, self.motion = self.motion, None
        return motion


@dataclass
class Observations:
    """Measurements of one drive."""

    fits: list[tuple[RoadFit, float]] = field(default_factory=list)  # with the distance since the previous one
    directions: list[tuple[Floats, float]] = field(default_factory=list)  # of straight travel, with its length
    lines: list[VanishingPoint] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    boxes: list[BoxHeight] = field(default_factory=list)
    lanes: list[LaneWidth] = field(default_factory=list)
    times_ns: dict[int, int] = field(default_factory=dict)
    frames: int = 0

    @property
    def path_m(self) -> float:
        return sum(length for _, _, length in self.steps)

    @property
    def speed_mps(self) -> float:
        """The median speed; 0 without motion."""
        each = [length / (self.times_ns[to] - self.times_ns[of]) * NS_PER_S for of, to, length in self.steps]
        return float(np.median(each)) if each else 0.0


Drive = Callable[[], Iterable[tuple[Frame, Pending]]]


def calibrate(
    drive: Drive,
    camera: Camera,
    frontend: FrontEndConfig,
    config: CalibrationConfig,
    lengths: dict[str, KnownLength] | None = None,
) -> Calibration:
    """Calibrates from all frames of a drive, which is repeated if the initial tilt was far off.

    `lengths`: known distances between two frames, by name of their source. Raises CalibrationError.
    """
    for _ in range(config.max_drives):
        seen = _observe(drive, camera, frontend, config)
        if seen.path_m < config.min_path_m:
            raise CalibrationError(
                f"too little motion: {seen.path_m:.1f} m in {seen.frames} frames, {config.min_path_m:g} m needed"
            )
        tilt, cov, estimates = _mean(_cue_estimates(seen, camera, config))
        moved = float(np.abs(tilt - [camera.pitch_rad, camera.roll_rad]).max())
        sigma = np.sqrt(np.diag(cov))
        camera = msgspec.structs.replace(
            camera, pitch_rad=float(tilt[0]), roll_rad=float(tilt[1]), tilt_sigma_rad=float(sigma.max())
        )
        if moved < config.restart_rad:
            break
    if sigma[0] > config.max_sigma_rad or sigma[1] > config.max_sigma_roll_rad:
        raise CalibrationError(
            f"pitch and roll have 1-sigma of {sigma[0]:.3f} and {sigma[1]:.3f} rad, {config.max_sigma_rad:g} and "
            f"{config.max_sigma_roll_rad:g} are the limits: too little of the road is in view"
        )
    return Calibration(
        camera=camera,
        cov=tuple(cov.ravel().tolist()),
        estimates=estimates,
        height_checks=(
            *checks_by_length(lengths or {}, seen.steps, seen.times_ns, camera, config.height),
            *checks_by_vehicles(seen.boxes, camera, cov, config.vehicles, config.known_vehicle_m),
            *checks_by_lanes(seen.lanes, camera.height_m, float(sigma[0]), config.known_lane_m),
        ),
        yaw_rad=_yaw_rad(seen),
        path_m=seen.path_m,
        frames=seen.frames,
        speed_mps=seen.speed_mps,
    )


def _observe(drive: Drive, camera: Camera, frontend: FrontEndConfig, config: CalibrationConfig) -> Observations:
    odometry, seen = _RecordingOdometry(camera, frontend.odometry), Observations()
    front = FrontEnd(camera, frontend, odometry)
    since_m = 0.0
    for frame, pending in drive():
        measurements = front.measure(frame, pending)
        seen.frames += 1
        seen.times_ns[frame.frame_id] = frame.t_source_ns
        seen.boxes += measure_heights(measurements.cv, camera, frontend.localisation)
        motion = odometry.take()
        if motion is None or {Status.ODOMETRY_COASTING, Status.SCALE_INVALID, Status.STANDSTILL} & set(motion.status):
            continue
        length = float(np.linalg.norm(motion.t_prev_curr_m))
        since_m += length
        width_m = painted_width_m(measurements.road_lanes)
        if width_m is not None:
            seen.lanes.append(LaneWidth(width_m, length))
        if odometry.road_fit is not None:
            seen.fits.append((odometry.road_fit, since_m))
            since_m = 0.0
        if odometry.vanishing_point is not None:
            seen.lines.append(odometry.vanishing_point)
        if Status.SCALE_CARRIED in motion.status:
            continue
        seen.steps.append((motion.from_frame, motion.to_frame, length))
        if length > 0.05 and abs(motion.T_prev_curr.yaw_rad) < config.straight_rad_per_m * length:
            seen.directions.append((motion.R_prev_curr.T @ motion.t_prev_curr_m / length, length))
    return seen


# --- pitch and roll ---


def _cue_estimates(seen: Observations, camera: Camera, config: CalibrationConfig) -> list[CueEstimate]:
    found = [by(seen, camera, config) for by in (by_road, _by_travel, _by_lines, _by_vehicles)]
    estimates = [estimate for estimate in found if estimate is not None]
    if not estimates:
        raise CalibrationError(
            "no cue for the tilt: no road, lines of the road, straight travel or vehicles were detected"
        )
    return estimates


def by_road(seen: Observations, camera: Camera, config: CalibrationConfig) -> CueEstimate | None:
    """Robust mean over the alignments of the road; those within bounce_m count as one sample."""
    if len(seen.fits) < config.min_fits:
        return None
    # The tilt of each is correlated with the length of its step, which the running scale gives more precisely, and with
    # the road's curvature, which is small in the mean
    known = np.diag([config.sigma_length_rel**-2, 0.0, 0.0, config.sigma_curvature_per_m**-2])
    own = np.linalg.inv([fit.cov for fit, _ in seen.fits])
    cov = np.linalg.inv(own + known)
    tilt = np.einsum("nij,njk,nk->ni", cov, own, [fit.state for fit, _ in seen.fits])[:, 1:3]
    by_length = cov[:, 1:3, 0] * config.sigma_length_rel**-2  # derivative of the tilt by the log of the running scale
    noise = cov[:, 1:3, 1:3]
    noise = noise + np.eye(2) * (config.sigma_fit_rad**2 + config.sigma_bounce_rad**2)
    share = np.array([min(1.0, way_m / config.bounce_m) for _, way_m in seen.fits])
    info = np.linalg.inv(noise) * share[:, None, None]
    mean = np.median(tilt, axis=0)
    weights = np.ones(len(tilt))
    for _ in range(10):
        total = np.einsum("n,nij->ij", weights, info)
        mean = np.linalg.solve(total, np.einsum("n,nij,nj->i", weights, info, tilt))
        away = np.sqrt(np.einsum("ni,nij,nj->n", tilt - mean, np.linalg.inv(noise), tilt - mean))
        weights = 1.0 / np.maximum(1.0, away / 1.5)  # Huber
    # The error of the running scale is systematic: it tilts all alignments alike
    lasting = np.linalg.solve(total, np.einsum("n,nij,nj->i", weights, info, by_length)) * config.sigma_length_rel
    of_mean = np.linalg.inv(total) + np.outer(lasting, lasting) + np.eye(2) * config.sigma_road_rad**2
    return _cue_estimate("road", mean, of_mean, len(tilt))


def _by_travel(seen: Observations, camera: Camera, config: CalibrationConfig) -> CueEstimate | None:
    """A car travels along the road: normal . direction = 0, solved for the pitch with the current roll."""
    length = np.array([length for _, length in seen.directions])
    if length.sum() < config.min_path_m:
        return None
    directions = np.array([d for d, _ in seen.directions])
    normal, by_pitch, _ = plane_normal(camera.pitch_rad, camera.roll_rad)
    pitch = camera.pitch_rad - (directions @ normal) / (directions @ by_pitch)
    order = np.argsort(pitch)
    cumulated = np.cumsum(length[order])
    centre = float(pitch[order[np.searchsorted(cumulated, 0.5 * cumulated[-1])]])  # the weighted median
    # Bounces are correlated over bounce_m and rotate the direction of travel back and forth
    variance = config.sigma_direction_rad**2 * max(1.0, config.bounce_m) / length.sum() + config.sigma_travel_rad**2
    return _cue_estimate(
        "travel", np.array([centre, 0.0]), np.diag([variance, UNOBSERVED_RAD**2]), len(pitch), sees_roll=False
    )


def _by_lines(seen: Observations, camera: Camera, config: CalibrationConfig) -> CueEstimate | None:
    """The road's lines are in its plane: normal . direction = 0, solved for the pitch with the current roll."""
    if len(seen.lines) < config.min_looks:
        return None
    normal, by_pitch, _ = plane_normal(camera.pitch_rad, camera.roll_rad)
    directions = np.array([look.direction for look in seen.lines])
    pitch = float(np.median(camera.pitch_rad - (directions @ normal) / (directions @ by_pitch)))
    # A crest tilts the road at the lines, a bounce the camera; both are correlated over several detections
    distance_m = float(np.median([look.distance_m for look in seen.lines]))
    lasting = config.sigma_bounce_rad**2 * config.bounce_m
    lasting += (config.sigma_curvature_per_m * distance_m) ** 2 * config.crest_m
    variance = lasting / max(seen.path_m, config.crest_m) + config.sigma_road_rad**2
    return _cue_estimate(
        "lines", np.array([pitch, 0.0]), np.diag([variance, UNOBSERVED_RAD**2]), len(seen.lines), sees_roll=False
    )


def _by_vehicles(seen: Observations, camera: Camera, config: CalibrationConfig) -> CueEstimate | None:
    prior = np.array([camera.height_m, camera.pitch_rad, camera.roll_rad])
    mounting = solve_mounting(
        seen.boxes, prior, np.diag([(0.3 * camera.height_m) ** 2, 0.1**2, 0.1**2]), config.vehicles
    )
    if mounting is None:
        return None
    return _cue_estimate("vehicles", mounting.state[1:], mounting.cov[1:, 1:], mounting.vehicles)


def _cue_estimate(cue: str, tilt: Floats, cov: Floats, samples: int, sees_roll: bool = True) -> CueEstimate:
    return CueEstimate(
        cue=cue,
        pitch_rad=float(tilt[0]),
        roll_rad=float(tilt[1]) if sees_roll else None,
        cov=tuple(np.ravel(cov).tolist()),
        samples=samples,
    )


def _mean(estimates: list[CueEstimate]) -> tuple[Floats, Floats, tuple[CueEstimate, ...]]:
    """Least squares over all cues; their disagreement widens the covariance (Birge's ratio)."""
    covs = [np.reshape(w.cov, (2, 2)) for w in estimates]
    states = [np.array([w.pitch_rad, 0.0 if w.roll_rad is None else w.roll_rad]) for w in estimates]
    cov: Floats = np.linalg.inv(np.sum([np.linalg.inv(c) for c in covs], axis=0))
    mean: Floats = cov @ np.sum([np.linalg.solve(c, s) for c, s in zip(covs, states, strict=True)], axis=0)
    chi2 = [float((s - mean) @ np.linalg.solve(c, s - mean)) for c, s in zip(covs, states, strict=True)]
    freedom = sum(1 if w.roll_rad is None else 2 for w in estimates) - 2
    if freedom > 0:
        cov = cov * max(1.0, sum(chi2) / freedom)
    return mean, cov, tuple(msgspec.structs.replace(w, chi2=c) for w, c in zip(estimates, chi2, strict=True))


def _yaw_rad(seen: Observations) -> float | None:
    if not seen.directions:
        return None
    return float(np.median([np.arctan2(d[0], d[2]) for d, _ in seen.directions]))
