"""Seeded drives as `Measurements` with exact truth: what the back end sees of a world, without images.

The ego follows a winding road, slows down, stands, and goes on. Traffic drives along the same road: it overtakes, falls
behind, changes lanes, parks at the side, leaves the camera's range and re-appears. Every edge is the truth with noise
drawn from the very covariance that it states, so an estimator can be held to its own uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.planar import between, compose, exp
from birdslam.geometry.se2 import SE2, wrap
from birdslam.types import EgoEdge, LandmarkEdge, LanePoint, Measurements, MotionEdge, Status, VehicleEdge

Count = Annotated[int, msgspec.Meta(ge=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]

_TABLE_STEP_M = 0.25  # the road is tabulated so finely
_DRIVING_MPS = 1.0  # what is seen changes far above this speed, not below it


class DriveConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long a drive is, who is on the road, and how well things are seen. Sigmas are of one edge."""

    frames: Count = 300
    rate_hz: Annotated[float, msgspec.Meta(gt=0.0)] = 33.0
    vehicles: Count = 6
    landmarks: Count = 24  # in sight at any time
    lane_points: Count = 16
    speed_mps: NotNegative = 10.0
    sigma_cc_m: NotNegative = 0.01
    sigma_cc_rad: NotNegative = 0.001
    sigma_cv_rel: NotNegative = 0.03  # of the distance, along the line of sight
    sigma_cv_m: NotNegative = 0.2
    sigma_cv_rad: NotNegative = 0.1
    # Of the variance of a vehicle's place, how much is that of an error that its next edge has, too, and for how long
    # (s, of driving), as `GraphConfig` has them
    lasting_share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.0
    lasting_s: Annotated[float, msgspec.Meta(gt=0.0)] = 2.0
    sigma_vv_m: NotNegative = 0.03
    sigma_vv_rad: NotNegative = 0.01
    sigma_cp_m: NotNegative = 0.05
    noise: NotNegative = 1.0  # 0: edges are exact, their covariances as stated
    outliers: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0  # share of CV and CP edges that are outliers
    drop: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0  # share of frames that never come
    range_m: NotNegative = 60.0
    # "convoy": everyone stays in sight; "drawn": twists are drawn, as the graph's constant-velocity factor has it
    traffic: Literal["road", "convoy", "drawn"] = "road"
    birth_twist: tuple[float, float, float] = (12.0, 2.0, 0.5)  # 1-sigma (m/s, m/s, rad/s)
    change_twist: tuple[float, float, float] = (2.0, 0.5, 0.3)  # 1-sigma within a second


@dataclass(frozen=True)
class Drive:
    """`ego` (frames, 3) and each vehicle's (frames, 3): true poses in world at every frame, dropped ones too."""

    measurements: list[Measurements]
    ego: Floats
    vehicles: list[Floats]


class _Road:
    """A winding centre line from -500 m to `length_m`, by arc length."""

    def __init__(self, length_m: float, rng: np.random.Generator) -> None:
        s = np.arange(-500.0, length_m + 500.0, _TABLE_STEP_M)
        curvature = np.zeros_like(s)
        for _ in range(4):
            wave_m, phase = rng.uniform(120.0, 600.0), rng.uniform(0.0, 2.0 * np.pi)
            curvature += rng.uniform(0.001, 0.004) * np.sin(2.0 * np.pi * s / wave_m + phase)
        yaw = np.cumsum(curvature) * _TABLE_STEP_M
        middle = yaw - 0.5 * curvature * _TABLE_STEP_M
        self._s = s
        self._table = np.stack([np.cumsum(np.cos(middle)), np.cumsum(np.sin(middle)), yaw / _TABLE_STEP_M], axis=1)
        self._table *= _TABLE_STEP_M

    def poses(self, s_m: Floats, left_m: Floats, heading_rad: Floats) -> Floats:
        """(N, 3) at `s_m` along the road, `left_m` of its centre, turned by `heading_rad` against it."""
        centre = np.stack([np.interp(s_m, self._s, column) for column in self._table.T], axis=1)
        return compose(centre, np.stack([np.zeros_like(s_m), left_m, heading_rad], axis=1))


def drive(config: DriveConfig, seed: int) -> Drive:
    """The drive of this seed. The first measurement begins the graph; those of dropped frames are missing."""
    rng = np.random.default_rng(seed)
    n, dt_s = config.frames, 1.0 / config.rate_hz
    t_s = np.arange(n) / np.float64(config.rate_hz)
    # Stop and go: the speed is a raised wave that is cut off at zero
    phase = rng.uniform(0.5, 1.5)
    speed_mps: Floats = np.maximum(0.0, config.speed_mps * (0.6 + 0.8 * np.cos(0.25 * t_s + phase)))
    s_ego = np.concatenate([[0.0], np.cumsum(speed_mps * dt_s)])[:n]
    road = _Road(float(s_ego[-1]) if n else 0.0, rng)
    ego = road.poses(s_ego, np.zeros(n), np.zeros(n))
    if config.traffic == "drawn":
        truth = [_drawn(config, ego, rng) for _ in range(config.vehicles)]
    else:
        truth = [_traffic(config, road, s_ego, speed_mps, t_s, rng) for _ in range(config.vehicles)]
    origin = ego[0].copy() if n else np.zeros(3)
    ego, truth = between(origin, ego), [between(origin, poses) for poses in truth]
    return Drive(_Camera(config, rng).measure(ego, truth), ego, truth)


def _traffic(
    config: DriveConfig, road: _Road, s_ego: Floats, speed_mps: Floats, t_s: Floats, rng: np.random.Generator
) -> Floats:
    """(frames, 3) of one vehicle: ahead of the ego by a distance that swings, or parked, again and again."""
    swing_rad, phase = rng.uniform(0.05, 0.25), rng.uniform(0.0, 2.0 * np.pi)
    convoy = config.traffic == "convoy"
    if rng.uniform() < 0.3 and not convoy:  # parked; when the ego has passed, the next one stands 80 m further on
        spacing_m = 120.0
        s = np.floor((s_ego + 20.0 + rng.uniform(0.0, spacing_m)) / spacing_m) * spacing_m + rng.uniform(20.0, 80.0)
        left = np.full_like(s, rng.choice([-4.0, 5.5]))
        return road.poses(s, left, np.zeros_like(s))
    swing_m = rng.uniform(0.0, 3.0) if convoy else rng.uniform(5.0, 30.0)
    s = s_ego + rng.uniform(10.0, 35.0) + swing_m * np.sin(swing_rad * t_s + phase)
    lane_rad = rng.uniform(0.1, 0.4)
    left = 1.75 + 1.75 * np.tanh(4.0 * np.sin(lane_rad * t_s + phase))
    sideways, forward = np.gradient(left, t_s) if len(t_s) > 1 else left * 0.0, np.maximum(speed_mps, 1.0)
    return road.poses(s, left, np.arctan2(sideways, forward) * (speed_mps > 1.0))


def _drawn(config: DriveConfig, ego: Floats, rng: np.random.Generator) -> Floats:
    """(frames, 3) of one vehicle that begins ahead of the ego; its twist wanders from interval to interval."""
    dt_s = 1.0 / config.rate_hz
    wander = rng.standard_normal((len(ego), 3)) * np.array(config.change_twist) * np.sqrt(dt_s)
    wander[0] = rng.standard_normal(3) * np.array(config.birth_twist)
    motions = exp(np.cumsum(wander, axis=0) * dt_s)
    motions[0] = compose(ego[0], np.array([rng.uniform(20.0, 40.0), rng.uniform(-8.0, 8.0), rng.uniform(-0.5, 0.5)]))
    out = [motions[0]]
    for motion in motions[1:]:
        out.append(compose(out[-1], motion))
    return np.array(out)


class _Camera:
    """Draws the edges."""

    def __init__(self, config: DriveConfig, rng: np.random.Generator) -> None:
        self.config = config
        self._rng = rng
        self._landmarks: dict[int, Floats] = {}  # in world
        self._next_landmark = 0
        self._lasting: dict[int, tuple[Floats, Floats, float]] = {}  # of vehicles: numbers, relative sigmas, when

    def measure(self, ego: Floats, vehicles: list[Floats]) -> list[Measurements]:
        config, last = self.config, 0
        speeds_mps = np.linalg.norm(np.diff(ego[:, :2], axis=0, prepend=ego[:1, :2]), axis=1) * config.rate_hz
        driven_s = np.cumsum(-np.expm1(-speeds_mps / _DRIVING_MPS)) / config.rate_hz
        last_seen: dict[int, int] = {}
        out = []
        for frame in range(config.frames):
            if frame and self._rng.uniform() < config.drop:
                continue
            t_ns = round(frame * 1e9 / config.rate_hz)
            cv = []
            vv = []
            for k, poses in enumerate(vehicles):
                seen = between(ego[frame], poses[frame])
                if not (3.0 < seen[0] < config.range_m and abs(seen[1]) < seen[0]):
                    continue
                cv.append(self._vehicle_edge(k, frame, seen, driven_s[frame]))
                before = last_seen.get(k)
                if before is not None and frame - before < config.rate_hz:
                    motion = between(poses[before], poses[frame])
                    if np.hypot(*motion[:2]) < 20.0:  # else another car took its place at the roadside
                        sigma = np.array([config.sigma_vv_m, config.sigma_vv_m, config.sigma_vv_rad])
                        T, cov = self._noisy(motion, sigma**2)
                        vv.append(MotionEdge(vehicle=k, from_frame=before, to_frame=frame, T_from_to=T, cov=cov))
                last_seen[k] = frame
            out.append(
                Measurements(
                    frame_id=frame,
                    t_source_ns=t_ns,
                    t_capture_ns=t_ns,
                    t_utc_ns=t_ns,
                    cc=self._ego_edge(last, frame, ego) if frame else None,
                    cv=tuple(cv),
                    vv=tuple(vv),
                    cp=self._landmark_edges(frame, ego[frame]),
                    lanes=tuple(LanePoint(3.0 + k, 1.75 * (-1) ** k) for k in range(config.lane_points)),
                    status=() if frame else (Status.NOT_INITIALISED,),
                )
            )
            last = frame
        return out

    def _noisy(self, pose: Floats, variances: Floats) -> tuple[SE2, tuple[float, ...]]:
        least = 1e-18 + 1e-12 * np.sum(variances)  # an edge may be exact in some direction
        noise = self.config.noise * (np.sqrt(variances + least) * self._rng.standard_normal(3))
        x, y, yaw = compose(pose, noise).tolist()
        return SE2(x, y, wrap(yaw)), tuple(np.diag(variances).ravel().tolist())

    def _ego_edge(self, before: int, frame: int, ego: Floats) -> EgoEdge:
        config = self.config
        sigma = np.array([config.sigma_cc_m, config.sigma_cc_m / 2.0, config.sigma_cc_rad])
        T, cov = self._noisy(between(ego[before], ego[frame]), sigma**2 * (frame - before))
        return EgoEdge(from_frame=before, to_frame=frame, T_from_to=T, cov=cov)

    def _vehicle_edge(self, vehicle: int, frame: int, seen: Floats, driven_s: float) -> VehicleEdge:
        """Noise is largest along the line of sight; its axes are those of the measured pose."""
        config, rng = self.config, self._rng
        far_m = float(np.hypot(seen[0], seen[1]))
        sigmas = np.array([config.sigma_cv_m + config.sigma_cv_rel * far_m, config.sigma_cv_m, config.sigma_cv_rad])
        drawn = rng.standard_normal(3)
        if config.lasting_share:
            lasting = self._lasting_error(vehicle, sigmas[:2] / far_m, driven_s)
            drawn[:2] = np.sqrt(1.0 - config.lasting_share) * drawn[:2] + np.sqrt(config.lasting_share) * lasting
        noise = config.noise * sigmas * drawn
        sight = np.arctan2(seen[1], seen[0])
        yaw = wrap(float(seen[2] + noise[2]))
        turn = np.eye(3)
        turn[:2, :2] = SE2(yaw_rad=float(sight)).rotation()
        x, y = seen[:2] + turn[:2, :2] @ noise[:2]
        T = SE2(float(x), float(y), yaw)
        turn[:2, :2] = SE2(yaw_rad=float(sight) - yaw).rotation()
        cov = turn @ np.diag(sigmas**2) @ turn.T
        if rng.uniform() < config.outliers:
            T = SE2(T.x_m + rng.uniform(8.0, 30.0), T.y_m + rng.uniform(-10.0, 10.0), T.yaw_rad)
        numbers = tuple((0.5 * (cov + cov.T)).ravel().tolist())
        return VehicleEdge(vehicle=vehicle, frame=frame, T_ego_vehicle=T, cov=numbers)

    def _lasting_error(self, vehicle: int, sigma_rel: Floats, driven_s: float) -> Floats:
        """(2,) in sigmas, along the line of sight and across it."""
        new = self._rng.standard_normal(2)
        if vehicle in self._lasting:
            before, before_rel, then_s = self._lasting[vehicle]
            same = np.exp((then_s - driven_s) / self.config.lasting_s)
            same = same * np.minimum(sigma_rel, before_rel) / np.maximum(sigma_rel, before_rel)
            new = same * before + np.sqrt(1.0 - same**2) * new
        self._lasting[vehicle] = new, sigma_rel, driven_s
        return new

    def _landmark_edges(self, frame: int, ego: Floats) -> tuple[LandmarkEdge, ...]:
        """Road points from 4 to 20 m ahead; one that the ego has passed is replaced by a new one far ahead."""
        config, rng = self.config, self._rng
        back = between(ego, np.zeros(3))
        while len(self._landmarks) < config.landmarks:
            ahead = np.array([rng.uniform(4.0, 20.0), rng.uniform(-4.0, 4.0), 0.0])
            self._landmarks[self._next_landmark] = compose(ego, ahead)
            self._next_landmark += 1
        out = []
        variance = config.sigma_cp_m**2
        places = compose(back, np.reshape([*self._landmarks.values()], (-1, 3)))
        for landmark, (x, y, _) in zip([*self._landmarks], places.tolist(), strict=True):
            if x < 4.0:
                del self._landmarks[landmark]
                continue
            outlier_m = rng.uniform(2.0, 8.0) if rng.uniform() < config.outliers else 0.0
            noise_x, noise_y = (config.noise * config.sigma_cp_m * rng.standard_normal(2)).tolist()
            x_m, y_m = x + noise_x + outlier_m, y + noise_y + outlier_m
            cov = (variance, 0.0, 0.0, variance)
            out.append(LandmarkEdge(landmark=landmark, frame=frame, x_m=x_m, y_m=y_m, cov=cov))
        return tuple(out)
