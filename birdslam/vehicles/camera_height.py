"""The camera's height over the road by the boxes of vehicles, and whether it is still as calibrated.

The bottom of a box falls below the horizon by H / z (Eq. 1), its height is h / z: the vehicle's depth z drops out,

    slope of the bottom = (H / h) * height of the box - d_pitch + d_roll * bearing        (all at a depth of 1)

which is linear in the camera's height H and in its tilt, with the vehicles' heights h known by class to some per cent.
docs/vehicles.md has how well it is known.
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
from birdslam.types import SpeedSource, Status, VehicleEdge
from birdslam.vehicles.placement.localisation import LocalisationConfig, observe_boxes

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
UNRELIABLE_TILT = {Status.ODOMETRY_COASTING, Status.SCALE_CARRIED, Status.SCALE_INVALID, Status.GROUND_VIOLATED}
ITERATIONS = 4
_MIN_RATIO = 0.1


class CameraHeightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of the camera's height by vehicles, and when a difference is reported."""

    sigma_height_rel: Positive = 0.5  # prior, of the calibrated height
    sigma_pitch_rad: Positive = 0.004  # of the mean tilt by the images
    sigma_roll_rad: Positive = 0.01  # of the mean tilt by the images
    sigma_class_rel: Positive = 0.04  # of the mean height of a class on a country's roads, and of a detector's boxes
    sigma_kerb_m: Positive = 0.06  # how far the road under a vehicle lies off the ego's plane
    correlated_frames: Positive = 5.0  # so many frames in a row have the same error of detector and tilt
    gate_sigma: Positive = 1.5  # past it a vehicle is down-weighted (Huber)
    max_sigma_box_rel: Positive = 0.2  # a box that is known less well is left out
    max_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 60  # the last so many
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 8  # fewer report nothing
    drift_sigma: Positive = 2.5  # a height that is off by more is reported as calibration_drift
    drift_rel: Positive = 0.08  # a smaller difference is not reported, whatever its sigma


@dataclass(frozen=True)
class BoxHeight:
    """One box of one vehicle; slopes and bearing count from the camera's own optical axis, at a depth of 1."""

    vehicle: int
    slope_bottom: float
    sigma_bottom: float
    tan_height: float
    sigma_height: float
    bearing: float
    height_m: float  # of its class
    sigma_height_rel: float


def measure_heights(edges: Sequence[VehicleEdge], camera: Camera, config: LocalisationConfig) -> list[BoxHeight]:
    """The boxes of one frame's CV edges against the camera's own axes; cut and hidden edges have wide sigmas."""
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
    """The boxes of one vehicle as sums of normal equations, in (H, d_pitch, d_roll)."""

    information: Floats  # (3, 3)
    right: Floats  # (3,)
    boxes: int
    class_rel: float


class CameraHeightEstimator:
    """update() with the CV edges of a frame and its motion; gives CALIBRATION_DRIFT when the height has changed.

    Robust least squares over the vehicles seen last, each of which is one sample: it is as wrong in all its boxes.
    State: H (m), d_pitch, d_roll (rad). Measurements: the slope of the bottom and the height of each box. Read by the
    front end, as a status; `estimate` gives the height itself.
    """

    def __init__(self, camera: Camera, config: CameraHeightConfig, localisation: LocalisationConfig) -> None:
        self.camera, self.config, self._localisation = camera, config, localisation
        self._vehicles: OrderedDict[int, _NormalEquations] = OrderedDict()
        self._estimate = (1.0, math.inf, 0)

    @property
    def estimate(self) -> tuple[float, float, int]:
        """(height over the calibrated one, its 1-sigma, vehicles)."""
        return self._estimate

    def update(self, edges: Sequence[VehicleEdge], motion: Motion | None) -> tuple[Status, ...]:
        """Edges of other frames than the motion's are passed over."""
        if motion is not None and _tilt_is_measured(motion):
            here = [edge for edge in edges if edge.frame == motion.to_frame]
            if sum(self._add(box, motion) for box in measure_heights(here, self.camera, self._localisation)):
                self._estimate = self._solve()
        ratio, sigma_rel, vehicles = self.estimate
        cfg = self.config
        drifted = abs(math.log(ratio)) > max(cfg.drift_rel, cfg.drift_sigma * sigma_rel)
        return (Status.CALIBRATION_DRIFT,) if vehicles >= cfg.min_vehicles and drifted else ()

    def _add(self, box: BoxHeight, motion: Motion) -> bool:
        """Adds the box to the sums; False where it determines too little to be used."""
        cfg, ground = self.config, motion.ground
        slope = box.slope_bottom + ground.pitch_rad - ground.roll_rad * box.bearing
        if slope <= 0.0 or box.tan_height <= 0.0:
            return False
        sigma_slope = math.hypot(box.sigma_bottom, motion.pitch_sigma_rad)
        if math.hypot(sigma_slope / slope, box.sigma_height / box.tan_height) > cfg.max_sigma_box_rel:
            return False
        J = np.array([box.tan_height / box.height_m, -1.0, box.bearing])
        weight = 1.0 / (sigma_slope**2 + (self.camera.height_m / box.height_m * box.sigma_height) ** 2)
        sums = self._vehicles.pop(box.vehicle, None) or _NormalEquations(np.zeros((3, 3)), np.zeros(3), 0, 0.0)
        sums.information += weight * np.outer(J, J)
        sums.right += weight * slope * J
        sums.boxes, sums.class_rel = sums.boxes + 1, box.sigma_height_rel
        self._vehicles[box.vehicle] = sums
        while len(self._vehicles) > cfg.max_vehicles:
            self._vehicles.popitem(last=False)
        return True

    def _solve(self) -> tuple[float, float, int]:
        """Least squares over all vehicles, of which each has an error of its own in proportion to J[0] (Huber)."""
        cfg, height_m, vehicles = self.config, self.camera.height_m, list(self._vehicles.values())
        correlated = np.array([min(cfg.correlated_frames, sums.boxes) for sums in vehicles])
        A = np.array([sums.information for sums in vehicles]) / correlated[:, None, None]
        b = np.array([sums.right for sums in vehicles]) / correlated[:, None]
        own = np.square(height_m * np.array([sums.class_rel for sums in vehicles])) + cfg.sigma_kerb_m**2
        share = own / (1.0 + own * A[:, 0, 0])  # Sherman-Morrison
        information = (A - share[:, None, None] * A[:, :, None, 0] * A[:, None, 0, :]).reshape(-1, 9)
        right = b - (share * b[:, 0])[:, None] * A[:, 0]
        spread = np.sqrt(A[:, 0, 0] * (1.0 + own * A[:, 0, 0]))
        prior = np.diag(1.0 / np.square([cfg.sigma_height_rel * height_m, cfg.sigma_pitch_rad, cfg.sigma_roll_rad]))
        expected = np.array([height_m, 0.0, 0.0])
        weight, x, cov = np.ones(len(vehicles)), expected, prior
        for _ in range(ITERATIONS):
            cov = np.asarray(np.linalg.inv(prior + (weight @ information).reshape(3, 3)), dtype=np.float64)
            x = cov @ (prior @ expected + weight @ right)
            residual = np.abs(b[:, 0] - A[:, 0] @ x) / spread
            weight = 1.0 / np.maximum(1.0, residual / cfg.gate_sigma)
        ratio = max(float(x[0]) / height_m, _MIN_RATIO)
        return ratio, math.hypot(math.sqrt(float(cov[0, 0])) / (ratio * height_m), cfg.sigma_class_rel), len(vehicles)


def _tilt_is_measured(motion: Motion) -> bool:
    """Whether its tilt is measured: metres may be the car's own where the road is not seen."""
    by_car_alone = SpeedSource.CAR in motion.speed_sources and SpeedSource.ROAD not in motion.speed_sources
    return not by_car_alone and not UNRELIABLE_TILT & set(motion.status)
