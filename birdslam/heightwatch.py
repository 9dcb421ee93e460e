"""Does the camera still stand as high as it was calibrated? A slow estimate from the vehicles on the road.

Where the road's tilt is known from the images (roadscale.py), the box of each vehicle gives the camera's height as a
multiple of the vehicle's, whatever its depth: H / h = slope of the bottom / height of the box (vehicleheight.py). The
tilt by the images does not depend on H; that by the boxes (horizon.py) would.

A vehicle is one sample, as good as its class is alike; the height of all of them together is not known better than
`sigma_class_rel`. So a camera that is wrong by 20 % is found within some twenty vehicles, one that is wrong by 5 %
never: `ratio` and `sigma_rel` say what is known.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from birdslam.camera import Camera
from birdslam.localisation import LocalisationConfig
from birdslam.motion import Motion
from birdslam.types import Status, VehicleEdge
from birdslam.vehicleheight import Sight, sights_of

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
LOST = {Status.ODOMETRY_COASTING, Status.SCALE_CARRIED, Status.SCALE_INVALID, Status.GROUND_VIOLATED}  # a guessed tilt


class HeightWatchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What vehicles say of the camera's height."""

    sigma_class_rel: Positive = 0.04  # of the mean height of a class on a country's roads, and of a detector's boxes
    sigma_kerb_m: Positive = 0.06  # how far the road under a vehicle lies off the ego's plane
    frames_alike: Positive = 5.0  # for so many frames in a row a detector, and the tilt, err alike
    max_sigma_sight_rel: Positive = 0.2  # a box that says less is left out
    kept_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 60  # the last so many
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 8
    drift_sigma: Positive = 2.5
    drift_rel: Positive = 0.08  # a smaller difference is none, however sure


class HeightWatch:
    """step(): the CV edges of a frame and its motion; gives CALIBRATION_DRIFT when the height is another."""

    def __init__(self, camera: Camera, config: HeightWatchConfig, localisation: LocalisationConfig) -> None:
        self.camera, self.config, self._localisation = camera, config, localisation
        self._vehicles: OrderedDict[int, tuple[float, float, float]] = OrderedDict()  # log ratio, weight, its class

    @property
    def estimate(self) -> tuple[float, float, int]:
        """(height over the calibrated one, its 1-sigma, vehicles): the median of the vehicles, and what it can mean."""
        cfg = self.config
        if not self._vehicles:
            return 1.0, math.inf, 0
        ratios, weights, classes = np.array(list(self._vehicles.values())).T
        spread = 1.0 / weights + classes**2 + (cfg.sigma_kerb_m / self.camera.height_m) ** 2
        order = np.argsort(ratios)
        share = np.cumsum(1.0 / spread[order])
        middle = float(ratios[order[np.searchsorted(share, 0.5 * share[-1])]])
        of_median = 0.5 * math.pi / float((1.0 / spread).sum())  # the variance of a median
        return math.exp(middle), math.sqrt(of_median + cfg.sigma_class_rel**2), len(ratios)

    def step(self, edges: Sequence[VehicleEdge], motion: Motion | None) -> tuple[Status, ...]:
        """Edges of other frames than the motion's are passed over."""
        if motion is not None and not LOST & set(motion.status):
            for sight in sights_of(
                [edge for edge in edges if edge.frame == motion.to_frame], self.camera, self._localisation
            ):
                self._see(sight, motion)
        ratio, sigma_rel, vehicles = self.estimate
        cfg = self.config
        drifted = abs(math.log(ratio)) > max(cfg.drift_rel, cfg.drift_sigma * sigma_rel)
        return (Status.CALIBRATION_DRIFT,) if vehicles >= cfg.min_vehicles and drifted else ()

    def _see(self, sight: Sight, motion: Motion) -> None:
        cfg, ground = self.config, motion.ground
        slope = sight.slope_bottom + ground.pitch_rad - ground.roll_rad * sight.bearing
        if slope <= 0.0 or sight.tan_height <= 0.0:
            return
        variance = (math.hypot(sight.sigma_bottom, motion.pitch_sigma_rad) / slope) ** 2
        variance += (sight.sigma_height / sight.tan_height) ** 2
        if variance > cfg.max_sigma_sight_rel**2:
            return
        log_ratio = math.log(slope * sight.height_m / (sight.tan_height * self.camera.height_m))
        weight = 1.0 / (variance * cfg.frames_alike)
        mean, known, _ = self._vehicles.pop(sight.vehicle, (0.0, 0.0, 0.0))
        total = known + weight
        mean += weight / total * (log_ratio - mean)
        self._vehicles[sight.vehicle] = (mean, total, sight.sigma_height_rel)
        while len(self._vehicles) > cfg.kept_vehicles:
            self._vehicles.popitem(last=False)
