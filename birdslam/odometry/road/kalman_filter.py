"""The Kalman filter of the road under the camera: scale, tilt, curvature and mount.

One comparison of two images (`road/alignment.py`) knows only some combination of scale, pitch, roll and curvature. Five
things join the comparisons from frame to frame: the camera's own rotation, the road's curvature, the direction of
travel and the road's own lines, which lie in the road, and the mount, about which the car bounces.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.odometry.obstruction.bonnet import BonnetConfig
from birdslam.odometry.obstruction.fixed_pattern import StandingPatternConfig
from birdslam.odometry.road.alignment import RoadAlignConfig, plane_normal, plane_tilt
from birdslam.odometry.road.fit import ROAD, RoadFit
from birdslam.odometry.road.mount_change import TiltWatchConfig
from birdslam.odometry.road.vanishing_point import LinesDirection, RoadLinesConfig
from birdslam.odometry.speed.readings import CarSpeedConfig

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

STATES = ROAD + 2  # log lambda, pitch, roll, curvature; the mount's pitch and roll
_NO_TYRES = 1.5  # sigmas of the factor beforehand; two rendered nights chose between 1.5 and 2
CAR_FACTOR, CAR_DELAY, ROAD_ERROR = STATES, STATES + 1, STATES + 2  # once the car has told of its speed


class RoadScaleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How what the road shows becomes a running scale and tilt.

    `mode` is the strategy: "kalman" is `road_scale.RoadScale`, "paper" the paper's moving median,
    `moving_median.MedianScale`.
    """

    mode: Literal["kalman", "paper"] = "kalman"  # of the metric scale: a Kalman filter, or the paper's moving median
    align: RoadAlignConfig = RoadAlignConfig()
    standing: StandingPatternConfig = StandingPatternConfig()
    bonnet: BonnetConfig = BonnetConfig()
    lines: RoadLinesConfig = RoadLinesConfig()
    min_baseline_m: Positive = 0.35  # travelled between the two images; shorter says too little
    target_baseline_m: Positive = 1.1  # of the kept images the one nearest to this is compared
    kept_images: Annotated[int, msgspec.Meta(ge=2)] = 8  # earlier images of the road, to compare with
    # of the two images of the road; less is no match
    min_correlation: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.35
    max_innovation_sigma: Positive = 4.0  # a comparison farther from what was expected is refused
    confirmations: Annotated[int, msgspec.Meta(ge=1)] = 3  # comparisons in a row before a scale counts as known
    doubt_sigma_rel: Positive = 0.15  # less sure than this, lengths far from the present one are tried as well
    doubt_after: Annotated[int, msgspec.Meta(ge=1)] = 3  # refused comparisons in a row that begin such a search
    violated_after: Annotated[int, msgspec.Meta(ge=1)] = 5  # refused comparisons in a row until the ground is in doubt
    sigma_scale_floor_rel: Positive = 0.015  # one pair never knows the length better: the road is no perfect plane
    sigma_tilt_floor_rad: Positive = 0.004  # nor does it know the tilt better
    sigma_bounce_rad: Positive = 0.012  # pitch and roll of the body against their mean, seen once in bounce_m
    bounce_m: Positive = 3.0  # the way over which the body's bounce lasts
    sigma_travel_rad: Positive = 0.012  # direction of travel against the road, over one metre
    # The corners' error of that direction lasts as long as these are in sight. The roads of tests/roads and the shipped
    # drive behind its windscreens, from six images each, KITTI 00, 01, 06 and 0005 chose between 0, 2, 3, 6 and 15 m
    travel_lasts_m: Positive = 3.0
    # A file's pitch so far from the first direction of travel is wrong: bumps and loads make a degree of it
    wrong_pitch_rad: Positive = 0.025
    max_wrong_pitch_rad: Positive = 0.08  # a direction that is off by more is no car's: nothing is concluded from it
    sigma_mount_rad: Positive = 0.02  # of the calibrated pitch and roll
    sigma_unseen_rad: Positive = 0.03  # of the tilt after a gap in which nobody saw how the camera turned
    scale_walk_rel_per_sqrt_m: Positive = 0.004  # drift of the visual scale
    # ... and in a bend of so much: on KITTI 01's ramp of 21 m radius it drifts by 12 % over as many metres
    scale_walk_bend_sqrt_m: Positive = 0.4
    max_bend_per_m: Positive = 0.15  # a tighter curvature of the way than this counts as this
    tilt_walk_rad_per_sqrt_m: Positive = 0.003  # crown and grade of the road
    sigma_curvature_per_m: Positive = 0.0006  # of roads along the way: town streets have radii of 500 m and more
    curvature_memory_m: Positive = 30.0  # so far a crest or a sag reaches
    sigma_curvature_floor_per_m: Positive = 0.0001  # nor does one pair know the curvature better
    chord_m: Positive = 15.0  # the ground is reported as the plane that meets the road at the foot and so far ahead
    mount_walk_rad_per_sqrt_m: Positive = 0.0007  # of the mean pitch and roll, as loads and tanks change
    carried_after_m: Positive = 6.0  # without a comparison, until the status says so
    invalid_sigma_rel: Positive = 0.15  # less sure of the scale than this, a frame is invalid
    watch: TiltWatchConfig = TiltWatchConfig()
    car: CarSpeedConfig = CarSpeedConfig()
    # of mode "paper" alone
    median_frames: Annotated[int, msgspec.Meta(ge=1)] = 21  # over which the median moves; the paper states none
    median_landmarks: Annotated[int, msgspec.Meta(ge=1)] = 3  # on the road, or the frame gives no scale
    median_range_m: Positive = 20.0  # of those landmarks: the paper's depth threshold T
    median_sigma_depth_rel: Positive = 0.1  # of the depth of a landmark that counts, 1-sigma


class RoadFilter:
    """State, measurements and readers:

    - `x` (6,): log lambda (lambda: metres per unit of the odometry's length); pitch and roll (rad) of the camera
      against the plane that touches the road under it; the road's curvature (1/m, > 0 in a sag); pitch and roll (rad)
      of the mount, which is the tilt in the mean. `cov` (6, 6). Once the car tells of its own speed (`begin_car`) also
      the log of its readings' scale factor, their delay (s), and the log error that the road's metres keep for long.
    - Predicted by the camera's rotation and the distance travelled (`predict`). Over a crest or through a sag the
      touching plane turns by curvature times distance, and so, in the mean, does the car.
    - Measured: the tilt is the mount's in the mean (in `predict`), the direction of travel lies in the road (`travel`),
      so do the road's lines (`accept_lines`), comparisons of the road's image (`accept`), ways by the car's own
      readings (`measure_car`).
    - Readers: `RoadScale`, for the factor on all lengths, the ground plane and its sigma; through it `TiltWatch`.

    The mount is a state, since otherwise what it learned of a tilt would be believed twice. The odometry is rescaled
    after each update, so log lambda is 0 between updates and only its variance runs.
    """

    def __init__(self, camera: Camera, config: RoadScaleConfig) -> None:
        self.config = config
        self.x = np.array([0.0, camera.pitch_rad, camera.roll_rad, 0.0, camera.pitch_rad, camera.roll_rad])
        mount, tilt = config.sigma_mount_rad**2, config.sigma_mount_rad**2 + config.sigma_bounce_rad**2
        self.cov: Floats = np.diag([1.0, tilt, tilt, config.sigma_curvature_per_m**2, mount, mount])
        self.cov[[1, 2, 4, 5], [4, 5, 1, 2]] = mount
        self.owed_log = 0.0  # correction of log lambda that the caller has not applied yet
        self.carried_m = 0.0  # travelled since a comparison held

    @property
    def tilt(self) -> Floats:
        """(pitch_rad, roll_rad) of the camera against the plane that touches the road under it."""
        out: Floats = self.x[1:3]
        return out

    @property
    def chord(self) -> tuple[Floats, float]:
        """(pitch, roll) against the plane through the foot and the road chord_m ahead, and 1-sigma of the pitch."""
        half_m = 0.5 * self.config.chord_m
        H = np.array([1.0, half_m])
        return self.tilt + np.array([self.x[3] * half_m, 0.0]), float(np.sqrt(H @ self.cov[1:4:2, 1:4:2] @ H))

    @property
    def expected(self) -> tuple[Floats, Floats]:
        """(4,) and (4, 4): what a comparison of the road's image will show, and how surely."""
        if not self.hears_car:
            return self.x[:ROAD].copy(), self.cov[:ROAD, :ROAD]
        H = self._of_comparison()
        return H @ self.x, H @ self.cov @ H.T

    @property
    def hears_car(self) -> bool:
        """Whether the readings' factor and delay are states."""
        return len(self.x) > STATES

    def begin_car(self) -> None:
        """The car tells of its speed: from here on the road's metres may keep an error of their own."""
        car, n = self.config.car, STATES
        self.x = np.append(self.x, np.zeros(3))
        cov = np.diag([0.0] * n + [car.sigma_factor_rel**2, car.sigma_delay_s**2, car.sigma_road_rel**2])
        cov[:n, :n] = self.cov
        if self.cov[0, 0] < self.config.doubt_sigma_rel**2:  # what the road said of lambda was lambda with its error
            cov[0, 0] += car.sigma_road_rel**2
            cov[0, ROAD_ERROR] = cov[ROAD_ERROR, 0] = -(car.sigma_road_rel**2)
        self.cov = cov

    def _of_comparison(self) -> Floats:
        """(4, states): how a comparison of the road's image depends on the state."""
        H = np.eye(len(self.x))[:ROAD]
        if self.hears_car:
            H[0, ROAD_ERROR] = 1.0
        return H

    def forget_scale(self, sigma_rel: float) -> None:
        """The unit of length was lost (the window began anew) or doubted."""
        self.cov[0, :] = self.cov[:, 0] = 0.0
        self.cov[0, 0] = sigma_rel**2

    def loosen_scale(self, sigma_rel: float) -> None:
        """The unit of length is known to `sigma_rel` at the best."""
        self.cov[0, 0] = max(self.cov[0, 0], min(sigma_rel, 1.0) ** 2)

    def turned_unseen(self) -> None:
        """The camera turned and nobody saw by how much: all that is known of the tilt is what the mount gives."""
        cfg = self.config
        self.cov[1:ROAD, :] = self.cov[:, 1:ROAD] = 0.0
        self.x[3] = 0.0
        self.cov[range(1, ROAD), range(1, ROAD)] = np.square(
            [cfg.sigma_unseen_rad, cfg.sigma_unseen_rad, cfg.sigma_curvature_per_m]
        )

    def predict(self, R_prev_curr: Floats, travelled_m: float) -> None:
        """The camera turned by R_prev_curr over a road that bends a little on the way."""
        cfg = self.config
        normal = R_prev_curr.T @ plane_normal(*self.tilt)[0]
        keep = float(np.exp(-travelled_m / cfg.curvature_memory_m))
        pitch_rad, roll_rad = plane_tilt(normal)
        self.x[1:ROAD] = pitch_rad + self.x[3] * travelled_m, roll_rad, keep * self.x[3]
        F = np.eye(len(self.x))
        F[1, 3], F[3, 3] = travelled_m, keep
        walk = cfg.tilt_walk_rad_per_sqrt_m**2 * travelled_m + 1e-8
        mount = cfg.mount_walk_rad_per_sqrt_m**2 * travelled_m
        bend = (1.0 - keep**2) * cfg.sigma_curvature_per_m**2
        noise = [0.0, walk, walk, bend, mount, mount]
        if self.hears_car:
            lasts = float(np.exp(-travelled_m / cfg.car.road_error_m))
            F[ROAD_ERROR, ROAD_ERROR] = lasts
            self.x[ROAD_ERROR] *= lasts
            factor = cfg.car.factor_walk_rel_per_sqrt_m**2 * travelled_m
            noise += [factor, 0.0, (1.0 - lasts**2) * cfg.car.sigma_road_rel**2]
        self.cov = F @ self.cov @ F.T + np.diag(noise)
        # Of landmarks that a turn takes out of sight at the side none hands the length on
        turned_rad = float(np.arctan2(R_prev_curr[0, 2], R_prev_curr[2, 2]))
        bend_per_m = min(abs(turned_rad) / max(travelled_m, 0.1), cfg.max_bend_per_m)
        drift = cfg.scale_walk_rel_per_sqrt_m**2 + (cfg.scale_walk_bend_sqrt_m * bend_per_m) ** 2
        self.cov[0, 0] = min(self.cov[0, 0] + drift * travelled_m, 1.0)
        self.carried_m += travelled_m
        # The road under the car is, in the mean, where the mount says: holds the tilt where no comparison does.
        share = travelled_m / cfg.bounce_m
        if share > 0.0:
            states = np.eye(len(self.x))
            self._update(
                self.x[4:6] - self.tilt, states[1:3] - states[4:6], np.eye(2) * (cfg.sigma_bounce_rad**2 / share)
            )

    def _update(self, innovation: Floats, H: Floats, noise: Floats) -> None:
        gain = self.cov @ H.T @ np.linalg.inv(H @ self.cov @ H.T + noise)
        self.x = self.x + gain @ innovation
        self.owed_log += float(self.x[0])  # what is now known of the tilt says something of earlier comparisons too
        self.x[0] = 0.0
        keep = np.eye(len(self.x)) - gain @ H
        self.cov = keep @ self.cov @ keep.T + gain @ noise @ gain.T

    def travel(self, t_prev_curr: Floats, travelled_m: float, sigma_across_m: float = 0.0) -> None:
        """A car travels along the road, not into it: the direction of travel lies in the plane, in the mean.

        `sigma_across_m` is how well the images show that direction.
        """
        length = float(np.linalg.norm(t_prev_curr))
        if length < 0.05:
            return
        normal, by_pitch, by_roll = plane_normal(*self.tilt)
        d = t_prev_curr / length
        H = np.zeros((1, len(self.x)))
        H[0, 1:3] = by_pitch @ d, by_roll @ d
        share = travelled_m / 1.0
        # Over one metre: the errors of the places do not add up over many short steps
        corners_rad = sigma_across_m / max(travelled_m, 1.0)
        var = self.config.sigma_travel_rad**2 + self.config.travel_lasts_m * corners_rad**2
        noise = np.array([[var / share]])
        self._update(np.array([-(normal @ d)]), H, noise)

    def accept_lines(self, lines: LinesDirection) -> bool:
        """The road's lines lie in it: what `travel` says of the way holds of them. False: refused, these are others."""
        pitch_rad, roll_rad = self.tilt + np.array([self.x[3] * lines.distance_m, 0.0])
        normal, by_pitch, by_roll = plane_normal(float(pitch_rad), float(roll_rad))
        H = np.zeros((1, len(self.x)))
        H[0, 1:3] = by_pitch @ lines.direction, by_roll @ lines.direction
        H[0, 3] = H[0, 1] * lines.distance_m
        beyond, var = -float(normal @ lines.direction), lines.sigma_rad**2
        if beyond**2 > self.config.lines.max_innovation_sigma**2 * (float((H @ self.cov @ H.T)[0, 0]) + var):
            return False
        self._update(np.array([beyond]), H, np.array([[var]]))
        return True

    def begin_travelling(self, t_prev_curr: Floats) -> None:
        """The first direction of travel: where it says that the camera file's pitch is far off, it goes before it."""
        length = float(np.linalg.norm(t_prev_curr))
        if length <= 0.0 or t_prev_curr[2] < 0.9 * length:
            return  # not forwards: a direction that no start may rest on
        off_rad = float(np.arctan2(-t_prev_curr[1], t_prev_curr[2])) - float(self.x[1])
        if abs(off_rad) < self.config.wrong_pitch_rad or abs(off_rad) > self.config.max_wrong_pitch_rad:
            return
        self.cov[np.ix_([1, 4], [1, 4])] += off_rad**2
        H = np.zeros((1, len(self.x)))
        H[0, 1] = 1.0
        self._update(np.array([off_rad]), H, np.array([[self.config.sigma_travel_rad**2]]))

    def innovation(self, fit: RoadFit) -> tuple[Floats, Floats, float]:
        """What a comparison says beyond what was expected, its noise (4, 4), and how many sigma that is away."""
        cfg = self.config
        tilt_rad = cfg.sigma_tilt_floor_rad
        floor = np.array([cfg.sigma_scale_floor_rel, tilt_rad, tilt_rad, cfg.sigma_curvature_floor_per_m])
        noise = fit.cov + np.diag(floor**2)
        mean, cov = self.expected
        beyond = fit.state - mean
        return beyond, noise, float(np.sqrt(beyond @ np.linalg.solve(cov + noise, beyond)))

    def accept(self, fit: RoadFit, share: float = 1.0) -> float:
        """Takes a comparison over and returns lambda, by which the visual scale is to be multiplied.

        `share` of it is new: comparisons over the same piece of way err together.
        """
        beyond, noise, _ = self.innovation(fit)
        owed = self.owed_log
        self._update(beyond, self._of_comparison(), noise / max(share, 1e-3))
        step, self.owed_log = self.owed_log - owed, owed
        self.carried_m = 0.0
        return float(np.exp(np.clip(step, -0.7, 0.7)))

    def car_innovation(self, log_ratio: float, by_delay: float, var: float) -> tuple[Floats, float, float]:
        """How a way by the car's readings depends on the state (1, states), what it says beyond what was expected,
        and how many sigma that is away.

        `log_ratio` is the log of that way, read at the delay of the state, over the way by images; `by_delay` (1/s)
        its derivative by the delay, `var` its noise.
        """
        H = np.zeros((1, len(self.x)))
        H[0, [0, CAR_FACTOR, CAR_DELAY]] = 1.0, 1.0, -by_delay
        beyond = log_ratio - float(self.x[CAR_FACTOR])
        return H, beyond, abs(beyond) / float(np.sqrt((H @ self.cov @ H.T)[0, 0] + var))

    def measure_car(self, log_ratio: float, by_delay: float, var: float) -> float:
        """Takes a way by the car's readings over and returns lambda, as `accept` does; as `car_innovation` has it."""
        H, beyond, _ = self.car_innovation(log_ratio, by_delay, var)
        owed, limit_s = self.owed_log, self.config.car.max_delay_s
        self._update(np.array([beyond]), H, np.array([[var]]))
        self.x[CAR_DELAY] = np.clip(self.x[CAR_DELAY], -limit_s, limit_s)
        off = float(self.x[CAR_FACTOR])
        if abs(off) > _NO_TYRES * self.config.car.sigma_factor_rel:
            # No tyres are off by so much: it is the road's metres that are (by night the car's own light travels along)
            self.cov[ROAD_ERROR, ROAD_ERROR] += off**2
            H = np.zeros((1, len(self.x)))
            H[0, CAR_FACTOR] = 1.0
            self._update(np.array([-off]), H, np.array([[self.config.car.sigma_factor_rel**2]]))
        step, self.owed_log = self.owed_log - owed, owed
        return float(np.exp(np.clip(step, -4.0, 4.0)))
