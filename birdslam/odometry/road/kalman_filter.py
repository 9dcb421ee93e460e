"""The Kalman filter of the road under the camera: scale, tilt, curvature and mount.

One alignment of two images (alignment.py) observes only a combination of scale, pitch, roll and curvature. Five things
join the alignments from frame to frame: the camera's own rotation, the road's curvature, the direction of travel and
the vanishing point, which lie in the road, and the mount, about which the car bounces.
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
_NOTHING_KNOWN = 10.0  # 1-sigma of the log of a length of which nothing is known
_WRONG_PITCH_SIGMAS = 2.0  # of the first direction of travel, where it shows that the camera file's pitch is wrong
_MAX_FACTOR_SIGMAS = 1.5  # of the factor's prior; two rendered nights chose between 1.5 and 2
CAR_FACTOR, CAR_DELAY, ROAD_ERROR = STATES, STATES + 1, STATES + 2  # with the car's own speed


class RoadFilter:
    """State, measurements and readers:

    - `x` (7,): log lambda (lambda: metres per unit of the odometry's length); pitch and roll (rad) of the camera
      against the plane that touches the road under it; the road's curvature (1/m, > 0 in a sag); pitch and roll (rad)
      of the mount, which is the mean of the tilt; the drift of log lambda (1/m). `cov` (7, 7). With the car's own speed
      (`add_car_states`) also the log of its scale factor, its delay (s), and the log of the road's systematic scale
      error.
    - Prediction: by the camera's rotation and the distance travelled (`predict`). Over a crest or a sag the touching
      plane turns by curvature times distance.
    - Measurements: the mount's tilt, in the mean (in `predict`); the direction of travel, which lies in the road
      (`update_travel`); the vanishing point, which does too (`update_vanishing_point`); alignments of the road's image
      (`update_alignment`); distances by the car's own speed (`update_car_speed`).
    - Readers: `RoadScale`, for the factor on all lengths, the ground plane and its sigma, and `MountChangeDetector`.

    The mount is a state, so that its correlation with the tilt is known. So is the drift, which lasts: an alignment
    trades length against pitch, and would give most of each metre's to the pitch. The odometry is rescaled after each
    update, so that log lambda is 0 between updates and only its variance is carried.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.config = config
        self.x = np.array([0.0, camera.pitch_rad, camera.roll_rad, 0.0, camera.pitch_rad, camera.roll_rad, 0.0])
        mount, tilt = config.sigma_mount_rad**2, config.sigma_mount_rad**2 + config.sigma_bounce_rad**2
        self.cov: Floats = np.diag(
            [1.0, tilt, tilt, config.sigma_curvature_per_m**2, mount, mount, config.scale_drift_per_m**2]
        )
        self.cov[[1, 2, 4, 5], [4, 5, 1, 2]] = mount
        self.pending_log = 0.0  # correction of log lambda that the caller has yet to apply
        # Travelled since the road has told the length, less the share that each alignment tells of it
        self.carried_m = 0.0
        self.unaligned_m = 0.0  # travelled since an alignment was accepted

    @property
    def tilt(self) -> Floats:
        """(pitch_rad, roll_rad) of the camera against the plane that touches the road under it."""
        out: Floats = self.x[1:3]
        return out

    @property
    def chord(self) -> tuple[Floats, Floats]:
        """(pitch, roll) against the plane through the foot and the road chord_m ahead, and their covariance (2, 2)."""
        H = np.array([[1.0, 0.0, 0.5 * self.config.chord_m], [0.0, 1.0, 0.0]])
        return H @ self.x[1:ROAD], H @ self.cov[1:ROAD, 1:ROAD] @ H.T

    @property
    def prediction(self) -> tuple[Floats, Floats]:
        """(4,) and (4, 4): the predicted measurement of an alignment, and its covariance."""
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
        if self.cov[0, 0] < self.config.doubt_sigma_rel**2:  # lambda was measured by the road, with the road's error
            cov[0, 0] += car.sigma_road_rel**2
            cov[0, ROAD_ERROR] = cov[ROAD_ERROR, 0] = -(car.sigma_road_rel**2)
        self.cov = cov

    def _alignment_jacobian(self) -> Floats:
        """(4, states): the Jacobian of an alignment."""
        H = np.eye(len(self.x))[:ROAD]
        if self.has_car_states:
            H[0, ROAD_ERROR] = 1.0
        return H

    def reset_scale(self, sigma_rel: float) -> None:
        """The scale is known to `sigma_rel`, whatever it was: the window restarted, or it is doubted."""
        self.cov[0, :] = self.cov[:, 0] = 0.0
        self.cov[0, 0] = sigma_rel**2

    def inflate_scale(self, sigma_rel: float) -> None:
        """The scale is known to `sigma_rel` at best."""
        self.cov[0, 0] = max(self.cov[0, 0], min(sigma_rel, 1.0) ** 2)

    def lose_tilt(self) -> None:
        """The camera turned without being seen: its tilt is known no better than by the mount."""
        cfg = self.config
        self.cov[1:ROAD, :] = self.cov[:, 1:ROAD] = 0.0
        self.x[3] = 0.0
        self.cov[range(1, ROAD), range(1, ROAD)] = np.square(
            [cfg.sigma_unseen_rad, cfg.sigma_unseen_rad, cfg.sigma_curvature_per_m]
        )

    def predict(self, R_prev_curr: Floats, travelled_m: float) -> None:
        """The camera turned by R_prev_curr over `travelled_m` of road."""
        cfg = self.config
        normal = R_prev_curr.T @ plane_normal(*self.tilt)[0]
        keep = float(np.exp(-travelled_m / cfg.curvature_memory_m))
        pitch_rad, roll_rad = plane_tilt(normal)
        self.x[1:ROAD] = pitch_rad + self.x[3] * travelled_m, roll_rad, keep * self.x[3]
        F = np.eye(len(self.x))
        F[1, 3], F[3, 3] = travelled_m, keep
        lasts = float(np.exp(-travelled_m / cfg.scale_drift_memory_m))
        F[0, DRIFT], F[DRIFT, DRIFT] = travelled_m, lasts
        self.pending_log += float(self.x[DRIFT]) * travelled_m
        self.x[DRIFT] *= lasts
        walk = cfg.tilt_walk_rad_per_sqrt_m**2 * travelled_m + 1e-8
        mount = cfg.mount_walk_rad_per_sqrt_m**2 * travelled_m
        bend = (1.0 - keep**2) * cfg.sigma_curvature_per_m**2
        noise = [0.0, walk, walk, bend, mount, mount, (1.0 - lasts**2) * cfg.scale_drift_per_m**2]
        if self.has_car_states:
            lasts = float(np.exp(-travelled_m / cfg.car.road_error_m))
            F[ROAD_ERROR, ROAD_ERROR] = lasts
            self.x[ROAD_ERROR] *= lasts
            factor = cfg.car.factor_walk_rel_per_sqrt_m**2 * travelled_m
            noise += [factor, 0.0, (1.0 - lasts**2) * cfg.car.sigma_road_rel**2]
        self.cov = F @ self.cov @ F.T + np.diag(noise)
        # In a turn landmarks leave the image at the side, and the scale drifts more
        turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
        bend_per_m = min(abs(turned_rad) / max(travelled_m, 0.1), cfg.max_bend_per_m)
        drift = cfg.scale_walk_rel_per_sqrt_m**2 + (cfg.scale_walk_bend_sqrt_m * bend_per_m) ** 2
        self.cov[0, 0] = min(self.cov[0, 0] + drift * travelled_m, 1.0)
        self.carried_m += travelled_m
        self.unaligned_m += travelled_m
        # The mount's tilt is the mean of the tilt: a weak measurement, which holds it where there is no alignment
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
        keep = np.eye(len(self.x)) - gain @ H
        self.cov = keep @ self.cov @ keep.T + gain @ noise @ gain.T

    def update_travel(self, t_prev_curr: Floats, travelled_m: float, sigma_across_m: float = 0.0) -> None:
        """The direction of travel lies in the road, in the mean.

        `sigma_across_m` is 1-sigma of the translation across it, by the images.
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
        """Of the direction of travel against the road, rad^2, over one metre.

        Errors of the positions do not add up over many short steps.
        """
        corners_rad = sigma_across_m / max(travelled_m, 1.0)
        return self.config.sigma_travel_rad**2 + self.config.travel_correlation_m * corners_rad**2

    def update_vanishing_point(self, vanishing_point: VanishingPoint) -> bool:
        """The vanishing point lies in the road, as the direction of travel does. False: rejected, other lines."""
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
        """Takes the pitch from the first direction of travel, where the camera file's is far off.

        `sigma_across_m` is as in `update_travel`: corners on drops show any direction, and no wrong file.
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
        """An alignment's innovation (4,), its noise (4, 4), and the innovation in sigmas."""
        cfg = self.config
        tilt_rad = cfg.sigma_tilt_floor_rad
        floor = np.array([cfg.sigma_scale_floor_rel, tilt_rad, tilt_rad, cfg.sigma_curvature_floor_per_m])
        noise = fit.cov + np.diag(floor**2)
        mean, cov = self.prediction
        innovation = fit.state - mean
        return innovation, noise, float(np.sqrt(innovation @ np.linalg.solve(cov + noise, innovation)))

    def length(self, fit: RoadFit) -> tuple[float, float]:
        """The log length by an alignment and what is known of the tilt, and its variance."""
        _, noise, _ = self.innovation(fit)
        mean, cov = self.prediction
        prior = cov.copy()
        prior[0, :] = prior[:, 0] = 0.0
        prior[0, 0] = _NOTHING_KNOWN**2
        by_prior, by_fit = np.linalg.inv(prior), np.linalg.inv(noise)
        joined = np.linalg.inv(by_prior + by_fit)
        return float((joined @ (by_prior @ mean + by_fit @ fit.state))[0]), float(joined[0, 0])

    def information(self, fit: RoadFit) -> float:
        """How much an alignment tells of the length, 0 to 1, given what is known of the tilt: 1 where it alone gives it
        to doubt_sigma_rel."""
        return min(1.0, self.config.doubt_sigma_rel**2 / self.length(fit)[1])

    def update_alignment(self, fit: RoadFit, share: float = 1.0) -> float:
        """Updates with an alignment and returns lambda, by which the visual scale is to be multiplied.

        `share` of it is new: the errors of alignments over the same stretch of road are correlated.
        """
        innovation, noise, _ = self.innovation(fit)
        tells = self.information(fit)
        before = self.pending_log
        self._update(innovation, self._alignment_jacobian(), noise / max(share, 1e-3))
        step, self.pending_log = self.pending_log - before, before
        self.carried_m *= 1.0 - tells
        self.unaligned_m = 0.0
        return float(np.exp(np.clip(step, -0.7, 0.7)))

    def car_innovation(self, log_ratio: float, by_delay: float, var: float) -> tuple[Floats, float, float]:
        """Jacobian (1, states) of a distance by the car's own speed, its innovation, and the innovation in sigmas.

        `log_ratio` is the log of that distance, at the state's delay, over the distance by images; `by_delay` (1/s) is
        its derivative by the delay, `var` its noise.
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
            # No tyres are off by this amount: the road's scale is (by night the car's own light moves along with it)
            self.cov[ROAD_ERROR, ROAD_ERROR] += off**2
            H = np.zeros((1, len(self.x)))
            H[0, CAR_FACTOR] = 1.0
            self._update(np.array([-off]), H, np.array([[self.config.car.sigma_factor_rel**2]]))
        step, self.pending_log = self.pending_log - before, before
        return float(np.exp(np.clip(step, -4.0, 4.0)))
