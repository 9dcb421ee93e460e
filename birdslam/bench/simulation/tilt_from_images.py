"""Odometry without images that reports the road's tilt as images would: with their errors of it.

`SimulatedOdometry` reports the calibrated plane; what drives has one from the images, and errs by `ground_rad` and
`roll_rad` of `OdometryNoise`.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.bench.simulation.odometry import OdometryNoise, SimulatedOdometry, Walk
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.odometry.external import WithoutImages
from birdslam.odometry.motion import Motion
from birdslam.types import SpeedReading


class TiltFromImages(WithoutImages):
    """An EgoMotion: a simulated one, that reports the road's pitch and roll as the images would, while it drives.

    `grounds` are the true ones, by frame; where one is None, none is reported again.
    """

    def __init__(
        self,
        odometry: SimulatedOdometry,
        grounds: Sequence[GroundPlane | None],
        noise: OdometryNoise,
        rng: np.random.Generator,
    ) -> None:
        self._odometry, self._grounds = odometry, grounds
        self._pitch, self._roll = Walk(noise.ground_rad, 1, rng), Walk(noise.roll_rad, 1, rng)
        self._cov = np.diag([noise.ground_rad.sigma**2, noise.roll_rad.sigma**2])
        self._reported = odometry.camera.ground

    def estimate(
        self,
        tracks: None,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: Bools | None = None,
        speeds: Sequence[SpeedReading] = (),
    ) -> Motion | None:
        """The simulated motion, with the road's tilt."""
        motion = self._odometry.estimate(tracks, frame_id, t_source_ns, vehicle_boxes_px, road_mask, speeds)
        if motion is None:
            return None
        (pitch_rad,), (roll_rad,), at = self._pitch.draw(), self._roll.draw(), self._grounds[frame_id]
        if at is not None and not motion.standstill:
            self._reported = GroundPlane(at.height_m, at.pitch_rad + float(pitch_rad), at.roll_rad + float(roll_rad))
        return msgspec.structs.replace(motion, ground=self._reported, tilt_cov=self._cov)
