"""Camera height over the road from the boxes of vehicles, and detection of its drift.

    slope of the bottom = (H / h) * height of the box - d_pitch + d_roll * bearing        (at a depth of 1)

from Eq. 1 and the height h / z, without the depth z. It is linear in the camera height H and tilt. The heights h of
vehicles are known by class; the ground under each vehicle has its own error.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.odometry.motion import Motion
from birdslam.road_users.placement.localisation import LocalisationConfig, observe_boxes
from birdslam.types import SpeedSource, Status, VehicleEdge

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
UNRELIABLE_TILT_STATUSES = {  # the tilt is not measured
    Status.ODOMETRY_COASTING,
    Status.SCALE_CARRIED,
    Status.SCALE_INVALID,
    Status.GROUND_VIOLATED,
}
ITERATIONS = 4
_MIN_RATIO = 0.1
# Ground offset under a vehicle as in ParallaxConfig, vertical curvature as in RoadScaleConfig
_SIGMA_OFFSET_M, _SIGMA_CROWN_RAD, _SIGMA_BANK_PER_M = 0.06, 0.007, 0.001  # constant, times y, times y^2
_SIGMA_CURVATURE_PER_M = 0.0006
# Bank beyond the road, common to one side (docs/constants.md)
BANK_RAD, _ROAD_HALF_WIDTH_M = 0.05, 6.0
_MIN_INVERSE_DEPTH = 1e-3  # 1/m
_BOX_MEMORY_S = 0.5  # as in ParallaxConfig
STATES = 5  # H, d_pitch, d_roll, bank at the left and at the right: first columns of `jacobian`
_OWN_COLUMNS = [0, 5]  # columns with a vehicle's own errors


class CameraHeightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of the camera height from vehicles, and thresholds of the drift."""

    sigma_height_rel: Positive = 0.5  # prior, of the calibrated height
    sigma_pitch_rad: Positive = 0.004  # of the mean tilt by the images
    sigma_roll_rad: Positive = 0.01  # of the mean tilt by the images
    sigma_class_rel: Positive = 0.04  # of the mean height of a class in a region, and of its boxes
    gate_sigma: Positive = 1.5  # Huber threshold of a vehicle
    max_sigma_box_rel: Positive = 0.2  # maximum relative sigma of a box
    max_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 60  # number of last vehicles that are kept
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 8  # for a report
    drift_sigma: Positive = 2.5  # significance of calibration_drift
    drift_rel: Positive = 0.08  # minimum difference for calibration_drift


@dataclass(frozen=True)
class BoxHeight:
    """One box of one vehicle; slopes and bearing relative to the optical axis, at a depth of 1."""

    vehicle: int
    slope_bottom: float
    sigma_bottom: float
    tan_height: float
    sigma_height: float
    bearing: float
    height_m: float  # of its class
    sigma_height_rel: float


def jacobian(inverse_depth: Floats, bearing: Floats) -> Floats:
    """(N, 6) derivatives of the boxes' bottom slopes by `STATES` and by the road's vertical curvature."""
    z = 1.0 / np.maximum(inverse_depth, _MIN_INVERSE_DEPTH)
    beyond = np.maximum(np.abs(bearing) - _ROAD_HALF_WIDTH_M * inverse_depth, 0.0)
    banks = beyond * (bearing > 0.0), beyond * (bearing < 0.0)
    return np.column_stack([inverse_depth, -np.ones(len(z)), bearing, *banks, 0.5 * z])


def own_variance(camera_height_m: float, sigma_height_rel: Floats, aside_m: Floats) -> Floats:
    """(N, 2) variances of the vehicles' own errors: of H from size and ground (m^2), of the curvature (1/m^2)."""
    below_m2 = (
        _SIGMA_OFFSET_M**2 + np.square(_SIGMA_CROWN_RAD * aside_m) + np.square(_SIGMA_BANK_PER_M * np.square(aside_m))
    )
    of_height = np.square(camera_height_m * sigma_height_rel) + below_m2
    return np.column_stack([of_height, np.full(len(of_height), _SIGMA_CURVATURE_PER_M**2)])


def marginalise_own_errors(information: Floats, right: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Reduces normal equations (N, 6, 6), (N, 6) to the `STATES`, (N, 5, 5), (N, 5), by the Schur complement.

    `variance` (N, 2) is of errors in the columns `_OWN_COLUMNS` that all boxes of a vehicle share.
    """
    across = information[:, :STATES, _OWN_COLUMNS]
    own = information[:, _OWN_COLUMNS][:, :, _OWN_COLUMNS] + np.eye(2) / variance[:, None, :]
    share = across @ np.linalg.inv(own)
    reduced = information[:, :STATES, :STATES] - share @ across.transpose(0, 2, 1)
    return reduced, right[:, :STATES] - np.einsum("nij,nj->ni", share, right[:, _OWN_COLUMNS])


def measure_heights(edges: Sequence[VehicleEdge], camera: Camera, config: LocalisationConfig) -> list[BoxHeight]:
    """The boxes of one frame's CV edges relative to the optical axis; cut and hidden edges have wide sigmas."""
    seen = observe_boxes(
        np.array([edge.box_px for edge in edges]).reshape(-1, 4),
        np.array([edge.score for edge in edges]),
        tuple(edge.label for edge in edges),
        camera,
        GroundPlane(camera.height_m),
        config,
    )
    return [
        BoxHeight(
            vehicle=edges[o.row].vehicle,
            slope_bottom=o.slope_bottom,
            sigma_bottom=o.sigma_bottom,
            tan_height=o.tan_height,
            sigma_height=float(np.hypot(o.sigma_bottom, o.sigma_top)),
            bearing=o.bearing,
            height_m=o.dimensions.height_m,
            sigma_height_rel=o.dimensions.sigma_height_rel,
        )
        for o in seen
    ]


@dataclass
class _NormalEquations:
    """Summed normal equations of the boxes of one vehicle, in the columns of `jacobian`."""

    information: Floats  # (6, 6)
    right: Floats  # (6,)
    boxes: int
    samples: float  # number of independent boxes; errors within `_BOX_MEMORY_S` are correlated
    last_s: float
    class_rel: float
    aside_m: float  # of its last box


class CameraHeightEstimator:
    """Robust least squares for the camera height; `update` returns CALIBRATION_DRIFT when it has changed.

    Each vehicle is one sample, since errors of its boxes are correlated. State: H (m), d_pitch, d_roll, two banks
    (rad). Measurements: bottom slope and height of each box. Readers: the front end for the status; `estimate` has the
    height.
    """

    def __init__(self, camera: Camera, config: CameraHeightConfig, localisation: LocalisationConfig) -> None:
        self.camera, self.config, self._localisation = camera, config, localisation
        self._vehicles: OrderedDict[int, _NormalEquations] = OrderedDict()
        self._estimate = (1.0, math.inf, 0)

    @property
    def estimate(self) -> tuple[float, float, int]:
        """(ratio to the calibrated height, its 1-sigma, number of vehicles)."""
        return self._estimate

    def update(self, edges: Sequence[VehicleEdge], motion: Motion | None, t_s: float) -> tuple[Status, ...]:
        """Adds the CV edges of the motion's last frame, at `t_s`; ignores edges of other frames."""
        if motion is not None and _is_tilt_measured(motion):
            here = [edge for edge in edges if edge.frame == motion.to_frame]
            if sum(self._add(box, motion, t_s) for box in measure_heights(here, self.camera, self._localisation)):
                self._estimate = self._solve()
        ratio, sigma_rel, vehicles = self.estimate
        cfg = self.config
        has_drifted = abs(math.log(ratio)) > max(cfg.drift_rel, cfg.drift_sigma * sigma_rel)
        return (Status.CALIBRATION_DRIFT,) if vehicles >= cfg.min_vehicles and has_drifted else ()

    def _add(self, box: BoxHeight, motion: Motion, t_s: float) -> bool:
        """Adds a box to the sums; returns False if its sigma is too large."""
        cfg, ground = self.config, motion.ground
        slope = box.slope_bottom + ground.pitch_rad - ground.roll_rad * box.bearing
        if slope <= 0.0 or box.tan_height <= 0.0:
            return False
        sigma_slope = math.hypot(box.sigma_bottom, motion.pitch_sigma_rad)
        if math.hypot(sigma_slope / slope, box.sigma_height / box.tan_height) > cfg.max_sigma_box_rel:
            return False
        inverse_depth = box.tan_height / box.height_m
        (J,) = jacobian(np.array([inverse_depth]), np.array([box.bearing]))
        weight = 1.0 / (sigma_slope**2 + (self.camera.height_m / box.height_m * box.sigma_height) ** 2)
        sums = self._vehicles.pop(box.vehicle, None) or _NormalEquations(
            np.zeros((6, 6)), np.zeros(6), 0, 0.0, -math.inf, 0.0, 0.0
        )
        sums.information += weight * np.outer(J, J)
        sums.right += weight * slope * J
        sums.boxes, sums.samples = sums.boxes + 1, sums.samples + min(1.0, (t_s - sums.last_s) / _BOX_MEMORY_S)
        sums.last_s, sums.class_rel, sums.aside_m = t_s, box.sigma_height_rel, box.bearing / inverse_depth
        self._vehicles[box.vehicle] = sums
        while len(self._vehicles) > cfg.max_vehicles:
            self._vehicles.popitem(last=False)
        return True

    def _solve(self) -> tuple[float, float, int]:
        """Robust least squares (Huber) over all vehicles."""
        cfg, height_m, vehicles = self.config, self.camera.height_m, list(self._vehicles.values())
        correlated = np.array([sums.boxes / sums.samples for sums in vehicles])
        A = np.array([sums.information for sums in vehicles]) / correlated[:, None, None]
        b = np.array([sums.right for sums in vehicles]) / correlated[:, None]
        class_rel, aside_m = np.array([(sums.class_rel, sums.aside_m) for sums in vehicles]).T
        information, right = marginalise_own_errors(A, b, own_variance(height_m, class_rel, aside_m))
        spread = A[:, 0, 0] / np.sqrt(information[:, 0, 0])
        sigmas = cfg.sigma_height_rel * height_m, cfg.sigma_pitch_rad, cfg.sigma_roll_rad, BANK_RAD, BANK_RAD
        prior, expected = np.diag(1.0 / np.square(sigmas)), np.append(height_m, np.zeros(STATES - 1))
        weight, x, cov = np.ones(len(vehicles)), expected, prior
        for _ in range(ITERATIONS):
            total = prior + np.einsum("n,nij->ij", weight, information)
            cov = np.asarray(np.linalg.inv(total), dtype=np.float64)
            x = cov @ (prior @ expected + weight @ right)
            residual = np.abs(b[:, 0] - A[:, 0, :STATES] @ x) / spread
            weight = 1.0 / np.maximum(1.0, residual / cfg.gate_sigma)
        ratio = max(float(x[0]) / height_m, _MIN_RATIO)
        return ratio, math.hypot(math.sqrt(float(cov[0, 0])) / (ratio * height_m), cfg.sigma_class_rel), len(vehicles)


def _is_tilt_measured(motion: Motion) -> bool:
    """Whether the images measure the tilt; the scale may come from the car's own speed alone."""
    is_from_car_alone = SpeedSource.CAR in motion.speed_sources and SpeedSource.ROAD not in motion.speed_sources
    return not is_from_car_alone and not UNRELIABLE_TILT_STATUSES & set(motion.status)
