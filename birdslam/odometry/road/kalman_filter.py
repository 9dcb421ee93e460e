"""Kalman filter of the road under the camera: scale, tilt, curvature and mount.

One alignment of two images (alignment.py) observes only a combination of scale, pitch, roll and curvature. The camera's
rotation, the direction of travel, the vanishing point and the mount make the states observable over several frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, plane_normal, plane_tilt
from birdslam.odometry.road.fit import ROAD, RoadFit
from birdslam.odometry.road.vanishing_point import VanishingPoint
from birdslam.odometry.scale_config import RoadScaleConfig

Floats = NDArray[np.float64]

STATES = ROAD + 3  # log lambda, pitch, roll, curvature; the mount's pitch and roll; the drift of log lambda
DRIFT = STATES - 1
_UNKNOWN_LENGTH_SIGMA_LOG = 10.0  # 1-sigma of an unknown log length
_LANDMARK_M = 10.0  # travelled from the triangulation of a landmark to its exit at the edge of the image
_WRONG_PITCH_SIGMAS = 2.0  # of the first direction of travel, above which the camera file's pitch is wrong
_MAX_FACTOR_SIGMAS = 1.5  # of the factor's prior
CAR_FACTOR, CAR_DELAY, ROAD_ERROR = STATES, STATES + 1, STATES + 2  # with the car's own speed


class RoadFilter:
    """State, measurements and readers:

    - State: `x` (7,) with `cov` (7, 7): log lambda (metres per scale of the window); pitch and roll (rad) of the camera
      against the tangent plane of the road under it; the road's curvature (1/m, > 0 in a sag); pitch and roll (rad) of
      the mount, the mean of the tilt; the drift of log lambda (1/m). With the car's own speed (`add_car_states`) also
      the log of its scale factor, its delay (s), and the log of the road's systematic scale error.
    - Prediction: rotation of the camera and distance travelled (`predict`). The tangent plane turns by curvature times
      distance.
    - Measurements: the mean of the tilt (in `predict`); the direction of travel (`update_travel`) and the vanishing
      point (`update_vanishing_point`), both in the road plane; alignments (`update_alignment`); distances by the car's
      own speed (`update_car_speed`).
    - Readers: `RoadScale`, for the factor on all lengths and the ground plane, and `MountChangeDetector`.

    An alignment trades length against pitch. Without the drift state, the pitch would absorb most of the drift. The
    caller rescales the odometry after each update, so log lambda is 0 between updates.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.config = config
        self.x = np.array([0.0, camera.pitch_rad, camera.roll_rad, 0.0, camera.pitch_rad, camera.roll_rad, 0.0])
        mount, tilt = config.sigma_mount_rad**2, config.sigma_mount_rad**2 + config.sigma_bounce_rad**2
        self._drift_var = config.scale_drift_per_m**2 + _distortion_drift_per_m(camera) ** 2
        self.cov: Floats = np.diag([1.0, tilt, tilt, config.sigma_curvature_per_m**2, mount, mount, self._drift_var])
        self.cov[[1, 2, 4, 5], [4, 5, 1, 2]] = mount
        self.pending_log = 0.0  # correction of log lambda that the caller has yet to apply
        self.carried_m = 0.0  # travelled without information on the length; each alignment reduces it
        self.unaligned_m = 0.0  # travelled since an alignment was accepted

    @property
    def tilt(self) -> Floats:
        """(pitch_rad, roll_rad) of the camera against the tangent plane of the road under it."""
        out: Floats = self.x[1:3]
        return out

    @property
    def chord(self) -> tuple[Floats, Floats]:
        """(pitch, roll) against the plane through the foot and the road at chord_m, and their covariance (2, 2)."""
        H = np.array([[1.0, 0.0, 0.5 * self.config.chord_m], [0.0, 1.0, 0.0]])
        return H @ self.x[1:ROAD], H @ self.cov[1:ROAD, 1:ROAD] @ H.T

    @property
    def prediction(self) -> tuple[Floats, Floats]:
        """Predicted measurement of an alignment (4,), and its covariance (4, 4)."""
        if not self.has_car_states:
            return self.x[:ROAD].copy(), self.cov[:ROAD, :ROAD]
        H = self._alignment_jacobian()
        return H @ self.x, H @ self.cov @ H.T

    @property
    def has_car_states(self) -> bool:
        """Whether the speed's scale factor and delay are states."""
        return len(self.x) > STATES

    def add_car_states(self) -> None:
        """Appends the speed's scale factor and delay, and the road's systematic scale error."""
        car, n = self.config.car, STATES
        self.x = np.append(self.x, np.zeros(3))
        cov = np.diag([0.0] * n + [car.sigma_factor_rel**2, car.sigma_delay_s**2, car.sigma_road_rel**2])
        cov[:n, :n] = self.cov
        if self.cov[0, 0] < self.config.doubt_sigma_rel**2:  # the road's error is in lambda
            cov[0, 0] += car.sigma_road_rel**2
            cov[0, ROAD_ERROR] = cov[ROAD_ERROR, 0] = -(car.sigma_road_rel**2)
        self.cov = cov

    def _alignment_jacobian(self) -> Floats:
        """Jacobian of an alignment (4, states)."""
        H = np.eye(len(self.x))[:ROAD]
        if self.has_car_states:
            H[0, ROAD_ERROR] = 1.0
        return H

    def reset_scale(self, sigma_rel: float) -> None:
        """Sets the 1-sigma of the scale and drops its correlations."""
        self.cov[0, :] = self.cov[:, 0] = 0.0
        self.cov[0, 0] = sigma_rel**2

    def inflate_scale(self, sigma_rel: float) -> None:
        """Raises the 1-sigma of the scale to at least `sigma_rel`."""
        self.cov[0, 0] = max(self.cov[0, 0], min(sigma_rel, 1.0) ** 2)

    def reset_tilt(self) -> None:
        """Resets the tilt's covariance to the prior of the mount, after an unobserved rotation."""
        cfg = self.config
        self.cov[1:ROAD, :] = self.cov[:, 1:ROAD] = 0.0
        self.x[3] = 0.0
        self.cov[range(1, ROAD), range(1, ROAD)] = np.square(
            [cfg.sigma_unseen_rad, cfg.sigma_unseen_rad, cfg.sigma_curvature_per_m]
        )

    def predict(self, R_prev_curr: Floats, travelled_m: float) -> None:
        """Predicts the state after a rotation R_prev_curr over `travelled_m` of road."""
        cfg = self.config
        normal = R_prev_curr.T @ plane_normal(*self.tilt)[0]
        fade = float(np.exp(-travelled_m / cfg.curvature_memory_m))
        pitch_rad, roll_rad = plane_tilt(normal)
        self.x[1:ROAD] = pitch_rad + self.x[3] * travelled_m, roll_rad, fade * self.x[3]
        F = np.eye(len(self.x))
        F[1, 3], F[3, 3] = travelled_m, fade
        decay = float(np.exp(-travelled_m / cfg.scale_drift_memory_m))
        F[0, DRIFT], F[DRIFT, DRIFT] = travelled_m, decay
        self.pending_log += float(self.x[DRIFT]) * travelled_m
        self.x[DRIFT] *= decay
        walk = cfg.tilt_walk_rad_per_sqrt_m**2 * travelled_m + 1e-8
        mount = cfg.mount_walk_rad_per_sqrt_m**2 * travelled_m
        bend = (1.0 - fade**2) * cfg.sigma_curvature_per_m**2
        noise = [0.0, walk, walk, bend, mount, mount, (1.0 - decay**2) * self._drift_var]
        if self.has_car_states:
            decay = float(np.exp(-travelled_m / cfg.car.road_error_m))
            F[ROAD_ERROR, ROAD_ERROR] = decay
            self.x[ROAD_ERROR] *= decay
            factor = cfg.car.factor_walk_rel_per_sqrt_m**2 * travelled_m
            noise += [factor, 0.0, (1.0 - decay**2) * cfg.car.sigma_road_rel**2]
        self.cov = F @ self.cov @ F.T + np.diag(noise)
        # In a turn, landmarks leave the image at the side, and the scale drifts faster
        turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
        bend_per_m = min(abs(turned_rad) / max(travelled_m, 0.1), cfg.max_bend_per_m)
        drift = cfg.scale_walk_rel_per_sqrt_m**2 + (cfg.scale_walk_bend_sqrt_m * bend_per_m) ** 2
        self.cov[0, 0] = min(self.cov[0, 0] + drift * travelled_m, 1.0)
        self.carried_m += travelled_m
        self.unaligned_m += travelled_m
        # The mean of the tilt is the mount's tilt: a weak measurement, which bounds it without alignments
        share = travelled_m / cfg.bounce_m
        if share > 0.0:
            states = np.eye(len(self.x))
            self._update(
                self.x[4:6] - self.tilt, states[1:3] - states[4:6], np.eye(2) * (cfg.sigma_bounce_rad**2 / share)
            )

    def _update(self, innovation: Floats, H: Floats, noise: Floats) -> None:
        gain = self.cov @ H.T @ np.linalg.inv(H @ self.cov @ H.T + noise)
        self.x = self.x + gain @ innovation
        self.pending_log += float(self.x[0])  # through its correlation with the other states
        self.x[0] = 0.0
        I_KH = np.eye(len(self.x)) - gain @ H
        self.cov = I_KH @ self.cov @ I_KH.T + gain @ noise @ gain.T

    def update_travel(self, t_prev_curr: Floats, travelled_m: float, sigma_across_m: float = 0.0) -> None:
        """Updates with the direction of travel, whose mean lies in the road plane.

        `sigma_across_m` is the 1-sigma of the lateral translation, from the images.
        """
        length = float(np.linalg.norm(t_prev_curr))
        if length < 0.05:
            return
        normal, by_pitch, by_roll = plane_normal(*self.tilt)
        d = t_prev_curr / length
        H = np.zeros((1, len(self.x)))
        H[0, 1:3] = by_pitch @ d, by_roll @ d
        share = travelled_m / 1.0
        noise = np.array([[self._travel_var(travelled_m, sigma_across_m) / share]])
        self._update(np.array([-(normal @ d)]), H, noise)

    def _travel_var(self, travelled_m: float, sigma_across_m: float) -> float:
        """Variance (rad^2) over one metre of the direction of travel against the road."""
        corners_rad = sigma_across_m / max(travelled_m, 1.0)
        return self.config.sigma_travel_rad**2 + self.config.travel_correlation_m * corners_rad**2

    def update_vanishing_point(self, vanishing_point: VanishingPoint) -> bool:
        """Updates with the vanishing point, a direction in the road plane. Returns False if it is an outlier."""
        pitch_rad, roll_rad = self.tilt + np.array([self.x[3] * vanishing_point.distance_m, 0.0])
        normal, by_pitch, by_roll = plane_normal(float(pitch_rad), float(roll_rad))
        H = np.zeros((1, len(self.x)))
        H[0, 1:3] = by_pitch @ vanishing_point.direction, by_roll @ vanishing_point.direction
        H[0, 3] = H[0, 1] * vanishing_point.distance_m
        innovation, var = -float(normal @ vanishing_point.direction), vanishing_point.sigma_rad**2
        if innovation**2 > self.config.vanishing_point.max_innovation_sigma**2 * (
            float((H @ self.cov @ H.T)[0, 0]) + var
        ):
            return False
        self._update(np.array([innovation]), H, np.array([[var]]))
        return True

    def initialise_pitch(self, t_prev_curr: Floats, sigma_across_m: float) -> None:
        """Initializes the pitch from the first direction of travel if the camera file's pitch is far off.

        `sigma_across_m` as in `update_travel`.
        """
        length = float(np.linalg.norm(t_prev_curr))
        if length <= 0.0 or t_prev_curr[2] < 0.9 * length:
            return  # not forwards
        off_rad = float(np.arctan2(-t_prev_curr[1], t_prev_curr[2])) - float(self.x[1])
        var = self._travel_var(length, sigma_across_m)
        wrong_rad = max(self.config.wrong_pitch_rad, _WRONG_PITCH_SIGMAS * float(np.sqrt(var)))
        if abs(off_rad) < wrong_rad or abs(off_rad) > self.config.max_wrong_pitch_rad:
            return
        self.cov[np.ix_([1, 4], [1, 4])] += off_rad**2
        H = np.zeros((1, len(self.x)))
        H[0, 1] = 1.0
        self._update(np.array([off_rad]), H, np.array([[var]]))

    def innovation(self, fit: RoadFit) -> tuple[Floats, Floats, float]:
        """Innovation of an alignment (4,), its noise (4, 4), and its Mahalanobis distance."""
        cfg = self.config
        tilt_rad = cfg.sigma_tilt_floor_rad
        floor = np.array([cfg.sigma_scale_floor_rel, tilt_rad, tilt_rad, cfg.sigma_curvature_floor_per_m])
        noise = fit.cov + np.diag(floor**2)
        mean, cov = self.prediction
        innovation = fit.state - mean
        return innovation, noise, float(np.sqrt(innovation @ np.linalg.solve(cov + noise, innovation)))

    def length(self, fit: RoadFit) -> tuple[float, float]:
        """Log length from an alignment and the prior of the tilt, and its variance."""
        _, noise, _ = self.innovation(fit)
        mean, cov = self.prediction
        prior = cov.copy()
        prior[0, :] = prior[:, 0] = 0.0
        prior[0, 0] = _UNKNOWN_LENGTH_SIGMA_LOG**2
        by_prior, by_fit = np.linalg.inv(prior), np.linalg.inv(noise)
        joined = np.linalg.inv(by_prior + by_fit)
        return float((joined @ (by_prior @ mean + by_fit @ fit.state))[0]), float(joined[0, 0])

    def information(self, fit: RoadFit) -> float:
        """Information of an alignment about the length, from 0 to 1 (1-sigma of doubt_sigma_rel or less)."""
        return min(1.0, self.config.doubt_sigma_rel**2 / self.length(fit)[1])

    def update_alignment(self, fit: RoadFit, share: float = 1.0) -> float:
        """Updates with an alignment and returns lambda, the factor on all lengths.

        `share` is the fraction of its road that is new: errors over the same road are correlated.
        """
        innovation, noise, _ = self.innovation(fit)
        information = self.information(fit)
        before = self.pending_log
        self._update(innovation, self._alignment_jacobian(), noise / max(share, 1e-3))
        step, self.pending_log = self.pending_log - before, before
        self.carried_m *= 1.0 - information
        self.unaligned_m = 0.0
        return float(np.exp(np.clip(step, -0.7, 0.7)))

    def car_innovation(self, log_ratio: float, by_delay: float, var: float) -> tuple[Floats, float, float]:
        """Jacobian (1, states) of a distance by the car's own speed, its innovation, and the latter in sigmas.

        `log_ratio` is log(distance by the car's speed / distance by images), `by_delay` (1/s) its derivative by the
        delay, `var` its noise.
        """
        H = np.zeros((1, len(self.x)))
        H[0, [0, CAR_FACTOR, CAR_DELAY]] = 1.0, 1.0, -by_delay
        innovation = log_ratio - float(self.x[CAR_FACTOR])
        return H, innovation, abs(innovation) / float(np.sqrt((H @ self.cov @ H.T)[0, 0] + var))

    def update_car_speed(self, log_ratio: float, by_delay: float, var: float) -> float:
        """Updates with a distance by the car's own speed (see `car_innovation`) and returns lambda."""
        H, innovation, _ = self.car_innovation(log_ratio, by_delay, var)
        before, limit_s = self.pending_log, self.config.car.max_delay_s
        self._update(np.array([innovation]), H, np.array([[var]]))
        self.x[CAR_DELAY] = np.clip(self.x[CAR_DELAY], -limit_s, limit_s)
        off = float(self.x[CAR_FACTOR])
        if abs(off) > _MAX_FACTOR_SIGMAS * self.config.car.sigma_factor_rel:
            # Implausible for tyres, so the road's scale is wrong: at night the car's own light moves along with it
            self.cov[ROAD_ERROR, ROAD_ERROR] += off**2
            H = np.zeros((1, len(self.x)))
            H[0, CAR_FACTOR] = 1.0
            self._update(np.array([-off]), H, np.array([[self.config.car.sigma_factor_rel**2]]))
        step, self.pending_log = self.pending_log - before, before
        return float(np.exp(np.clip(step, -4.0, 4.0)))


def _distortion_drift_per_m(camera: Camera) -> float:
    """1-sigma of the drift of the log scale (1/m) by an error of k1.

    An error of k1 by e changes the depth of a landmark at radius r (z = 1) by the factor 1 - 2 e r^2. So the scale
    changes by e times the squared radius of the edge while landmarks move there from the centre of the image.
    """
    edge = 0.5 * camera.width_px / camera.fx_px
    return camera.distortion_sigma * edge**2 / _LANDMARK_M
