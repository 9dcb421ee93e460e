"""Does the camera still stand as high as it was calibrated? A slow estimate from the vehicles on the road.

With slopes that fall from the plane of the road as the images show it (roadscale.py), each box of a vehicle of height h
gives the camera's height H, whatever the vehicle's depth (vehicleheight.py):

    slope of the bottom = (H / h) * height of the box - d_pitch + d_roll * bearing        (all at a depth of 1)

That tilt does not depend on H; the one by the boxes (horizon.py) would. What is left of its error, d_pitch and d_roll,
is common to all vehicles and grows with their distance as H does not, so that near and far ones tell them apart.

A vehicle is one sample, as good as its class is alike; the height of all of them together is not known better than
`sigma_class_rel`. So a camera that is wrong by 15 % is found within some twenty vehicles, one that is wrong by 10 %
sometimes, by 5 % never: `estimate` says what is known.
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

from birdslam.geometry.camera import Camera
from birdslam.odometry.motion import Motion
from birdslam.types import Status, VehicleEdge
from birdslam.vehicles.camera_height import Sight, sights_of
from birdslam.vehicles.localisation import LocalisationConfig

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
LOST = {Status.ODOMETRY_COASTING, Status.SCALE_CARRIED, Status.SCALE_INVALID, Status.GROUND_VIOLATED}  # a guessed tilt
ITERATIONS = 4
_LEAST_RATIO = 0.1


class HeightWatchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What vehicles say of the camera's height."""

    sigma_height_rel: Positive = 0.5  # of the calibrated height, beforehand: the vehicles are to judge it
    sigma_pitch_rad: Positive = 0.004  # of the mean tilt by the images
    sigma_roll_rad: Positive = 0.01  # of the mean tilt by the images
    sigma_class_rel: Positive = 0.04  # of the mean height of a class on a country's roads, and of a detector's boxes
    sigma_kerb_m: Positive = 0.06  # how far the road under a vehicle lies off the ego's plane
    frames_alike: Positive = 5.0  # for so many frames in a row a detector, and the tilt, err alike
    gate_sigma: Positive = 1.5  # past it a vehicle counts the less the worse it fits
    max_sigma_sight_rel: Positive = 0.2  # a box that says less is left out
    kept_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 60  # the last so many
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 8  # fewer say nothing
    drift_sigma: Positive = 2.5  # a height that is off by more is told as calibration_drift
    drift_rel: Positive = 0.08  # a smaller difference is none, however sure


@dataclass
class _Known:
    """What the boxes of one vehicle say, as sums over them of J, the derivatives by (H, d_pitch, d_roll)."""

    information: Floats  # (3, 3)
    right: Floats  # (3,)
    boxes: int
    class_rel: float


class HeightWatch:
    """step(): the CV edges of a frame and its motion; gives CALIBRATION_DRIFT when the height is another."""

    def __init__(self, camera: Camera, config: HeightWatchConfig, localisation: LocalisationConfig) -> None:
        self.camera, self.config, self._localisation = camera, config, localisation
        self._vehicles: OrderedDict[int, _Known] = OrderedDict()
        self._estimate = (1.0, math.inf, 0)

    @property
    def estimate(self) -> tuple[float, float, int]:
        """(height over the calibrated one, its 1-sigma, vehicles)."""
        return self._estimate

    def step(self, edges: Sequence[VehicleEdge], motion: Motion | None) -> tuple[Status, ...]:
        """Edges of other frames than the motion's are passed over."""
        if motion is not None and not LOST & set(motion.status):
            here = [edge for edge in edges if edge.frame == motion.to_frame]
            if sum(self._see(sight, motion) for sight in sights_of(here, self.camera, self._localisation)):
                self._estimate = self._solve()
        ratio, sigma_rel, vehicles = self.estimate
        cfg = self.config
        drifted = abs(math.log(ratio)) > max(cfg.drift_rel, cfg.drift_sigma * sigma_rel)
        return (Status.CALIBRATION_DRIFT,) if vehicles >= cfg.min_vehicles and drifted else ()

    def _see(self, sight: Sight, motion: Motion) -> bool:
        """Whether the box says enough to be taken."""
        cfg, ground = self.config, motion.ground
        slope = sight.slope_bottom + ground.pitch_rad - ground.roll_rad * sight.bearing
        if slope <= 0.0 or sight.tan_height <= 0.0:
            return False
        sigma_slope = math.hypot(sight.sigma_bottom, motion.pitch_sigma_rad)
        if math.hypot(sigma_slope / slope, sight.sigma_height / sight.tan_height) > cfg.max_sigma_sight_rel:
            return False
        J = np.array([sight.tan_height / sight.height_m, -1.0, sight.bearing])
        weight = 1.0 / (sigma_slope**2 + (self.camera.height_m / sight.height_m * sight.sigma_height) ** 2)
        known = self._vehicles.pop(sight.vehicle, None) or _Known(np.zeros((3, 3)), np.zeros(3), 0, 0.0)
        known.information += weight * np.outer(J, J)
        known.right += weight * slope * J
        known.boxes, known.class_rel = known.boxes + 1, sight.sigma_height_rel
        self._vehicles[sight.vehicle] = known
        while len(self._vehicles) > cfg.kept_vehicles:
            self._vehicles.popitem(last=False)
        return True

    def _solve(self) -> tuple[float, float, int]:
        """Least squares over all vehicles, of which each has an error of its own in proportion to J[0] (Huber)."""
        cfg, height_m, vehicles = self.config, self.camera.height_m, list(self._vehicles.values())
        alike = np.array([min(cfg.frames_alike, known.boxes) for known in vehicles])
        A = np.array([known.information for known in vehicles]) / alike[:, None, None]
        b = np.array([known.right for known in vehicles]) / alike[:, None]
        own = np.square(height_m * np.array([known.class_rel for known in vehicles])) + cfg.sigma_kerb_m**2
        share = own / (1.0 + own * A[:, 0, 0])  # Sherman-Morrison
        information = A - share[:, None, None] * A[:, :, None, 0] * A[:, None, 0, :]
        right = b - (share * b[:, 0])[:, None] * A[:, 0]
        spread = np.sqrt(A[:, 0, 0] * (1.0 + own * A[:, 0, 0]))
        prior = np.diag(1.0 / np.square([cfg.sigma_height_rel * height_m, cfg.sigma_pitch_rad, cfg.sigma_roll_rad]))
        expected = np.array([height_m, 0.0, 0.0])
        weight, x, cov = np.ones(len(vehicles)), expected, prior
        for _ in range(ITERATIONS):
            cov = np.asarray(np.linalg.inv(prior + np.tensordot(weight, information, 1)), dtype=np.float64)
            x = cov @ (prior @ expected + weight @ right)
            misfit = np.abs(b[:, 0] - A[:, 0] @ x) / spread
            weight = 1.0 / np.maximum(1.0, misfit / cfg.gate_sigma)
        ratio = max(float(x[0]) / height_m, _LEAST_RATIO)
        return ratio, math.hypot(math.sqrt(float(cov[0, 0])) / (ratio * height_m), cfg.sigma_class_rel), len(vehicles)
